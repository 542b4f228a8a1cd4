"""What a release rests on: one version, libraries that are declared, types that others' programs see."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest
import yaml

import piccolo
from piccolo.apps.service.description import describe_service

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
NAME = re.compile(r"[\w-]+")
IMPORTED = {"opencv-python-headless": "cv2", "pillow": "PIL"}  # by their names on the index
WITH_NUMBA = "llvmlite"


def _names(requirements):
    return {NAME.match(line)[0] for line in requirements if not line.startswith("#")}


BASE = _names((ROOT / "requirements.txt").read_text().splitlines())
EXTRAS = {name for extra in PROJECT["project"]["optional-dependencies"].values() for name in _names(extra)}


def test_one_version_is_told_everywhere():
    version = piccolo.__version__
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "piccolo.__version__"}
    assert re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE) == [version]
    assert describe_service()["info"]["version"] == version
    newest = re.search(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    assert newest == "Unreleased" or re.fullmatch(rf"{re.escape(version)} - \d{{4}}-\d\d-\d\d", newest)


def test_libraries_that_are_imported_are_declared_and_the_other_way_round():
    imported = set()
    for path in (ROOT / "piccolo").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(node.module.partition(".")[0])
    libraries = imported - sys.stdlib_module_names - EXTRAS
    assert libraries == {IMPORTED.get(name, name) for name in BASE} | {WITH_NUMBA}


def test_each_base_package_has_a_reason_and_all_are_locked():
    reasons = (ROOT / "docs" / "DECISIONS.md").read_text()
    assert {name for name in BASE if f"**{name}**" not in reasons} == set()
    locked = _names((ROOT / "requirements.lock").read_text().splitlines())
    assert (BASE | EXTRAS | _names(PROJECT["dependency-groups"]["dev"])) - locked == set()


def test_hooks_before_a_commit_are_commands_of_ci():
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    words = (ROOT / ".ci" / "run").read_text().replace("(", " ").replace(")", " ").split()
    entries = [hook["entry"].split() for repository in config["repos"] for hook in repository["hooks"]]
    assert entries
    for program, target in entries:
        assert program == "make"
        assert target in words


def test_public_names_are_not_those_of_modules():
    """A module would take the place of the name when it is imported."""
    modules = {path.stem for path in (ROOT / "piccolo").iterdir()}
    assert "open_scan" in dir(piccolo)
    assert not modules & set(piccolo.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'open_scam'"):
        _ = piccolo.open_scam


CONSUMER = """
from typing import assert_type

import piccolo


def locate(scan: piccolo.Scan, photo: str) -> piccolo.Pose | None:
    result = scan.localize(photo)
    assert_type(result, piccolo.Result)
    assert_type(result.confidence, float)
    return result.pose


scan = piccolo.open_scan("scan.ply")
assert_type(scan, piccolo.Scan)
assert_type(locate(scan, "photo.jpg"), piccolo.Pose | None)
locate(scan, 7)  # type: ignore[arg-type]
scan.localise("photo.jpg")  # type: ignore[attr-defined]
"""


@pytest.fixture
def installed(tmp_path):
    """The Python of an environment in which the package is installed, beside the libraries of this one."""
    sources = tmp_path / "sources"
    shutil.copytree(ROOT / "piccolo", sources / "piccolo", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "requirements.txt", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    venv.create(tmp_path / "env", symlinks=True)
    python = next(tmp_path.glob("env/bin/python"))
    (packages,) = tmp_path.glob("env/lib/python*/site-packages")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--no-index", "--target", packages, sources], check=True)
    (packages / "libraries.pth").write_text("\n".join(p for p in sys.path if p.endswith("site-packages")))
    return python


@pytest.mark.process
def test_a_program_that_uses_the_installed_package_is_checked_by_its_types(installed, tmp_path):
    (tmp_path / "program").mkdir()
    (tmp_path / "program" / "consumer.py").write_text(CONSUMER)
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", installed, "consumer.py"]
    done = subprocess.run(command, cwd=tmp_path / "program", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
