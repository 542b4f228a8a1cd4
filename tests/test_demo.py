"""The commands of `make demo`: every picture of the sample flat is localized, its files stay unchanged."""

import hashlib
import json
import re
import shlex
from pathlib import Path

import pytest
from batches import main_of

ROOT = Path(__file__).resolve().parents[1]
FLAT = ROOT / "examples" / "flat"
RECIPE = re.search(r"^demo:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1]


def _digests():
    return {path: hashlib.sha256(path.read_bytes()).digest() for path in FLAT.rglob("*") if path.is_file()}


def _run_demo():
    """Run the recipe's Python commands as a shell would do it, but in this process."""
    for line in re.findall(r"^\t\$\(BIN\)/python (.*)", RECIPE, flags=re.MULTILINE):
        program, *words = shlex.split(line)
        assert main_of(program)(words) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("a checkout")  # with a space
    (path / "examples").symlink_to(ROOT / "examples")
    (path / "demo").mkdir()
    for name in ("pose.json", "poses.jsonl", "overlay.png", "plan.png"):
        (path / "demo" / name).write_text("of an earlier run\n")
    return path


def test_demo_localizes_every_picture_and_leaves_the_sample_unchanged(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = _digests()
    _run_demo()
    printed = capsys.readouterr().out
    names = [query["image"] for query in json.loads((FLAT / "queries.json").read_text())["queries"]]
    assert len(names) == 5
    for name in names:
        assert f"| flat | {name} | localized |" in printed
    assert "| all | 5 | 5 | 1.000 |" in printed
    for name in ("pose.json", "overlay.png", "poses.jsonl", "plan.png", "report/index.html"):
        assert (folder / "demo" / name).stat().st_size > 1000, name
    assert _digests() == before
