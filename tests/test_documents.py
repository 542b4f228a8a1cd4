"""Commands and Python of README, docs/, docstrings, examples/ and `make demo`, run as they are written."""

import csv
import doctest
import hashlib
import json
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from batches import main_of

import piccolo
from piccolo.api.opening import Cloud
from piccolo.apps.export.formats import FORMATS as EXPORTS
from piccolo.cloud.stream import FORMATS
from piccolo.photo.photo import Photo, Prior
from piccolo.system.kernels.jit import COMPILE_TIME
from research.synthetic import make_room

TIER = "process"

ROOT = Path(__file__).resolve().parents[1]
NUMBER = r"-?\d+(?:\.\d+)?"
README = (ROOT / "README.md").read_text()
TOOLS = (ROOT / "docs" / "TOOLS.md").read_text()


def _tools_commands():
    """The blocks of commands that begin with a made room."""
    blocks = re.findall(r"(?:^    (?:python|mkdir) .*\n)+", TOOLS, flags=re.MULTILINE)
    return [block.strip().splitlines() for block in blocks if "make_room" in block]


def _expanded(word):
    return sorted(map(str, Path().glob(word)))


def _run_all(commands, folder, monkeypatch, capsys):
    """Run commands as a shell would do it in a folder, but in this process; returns what they print."""
    monkeypatch.chdir(folder)
    for command in commands:
        program, *words = shlex.split(command.partition(" > ")[0].strip().removeprefix("python "))
        words = [name for word in words for name in (_expanded(word) if "*" in word else [word])]
        if program == "mkdir":
            Path(*words).mkdir()
        else:
            assert main_of(program)(words) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_readme_python_prints_what_it_says():
    lines = re.search(r"^    import piccolo\n(?:    .*\n)+", README, flags=re.MULTILINE)[0]
    command = [sys.executable, "-c", textwrap.dedent(lines)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pose, document = done.stdout.splitlines()
    assert f"prints `{pose}`" in README
    assert json.loads(document)["status"] == "localized"


def test_readme_command_prints_and_writes_what_it_says(tmp_path, monkeypatch, capsys):
    (command,) = re.findall(r"^    (python localize.py .*) > pose.json$", README, flags=re.MULTILINE)
    command = command.replace("examples/", f"{shlex.quote(str(ROOT))}/examples/")
    out = _run_all([command], tmp_path, monkeypatch, capsys)
    result = json.loads(out)
    shown = re.search(r"^    {\"status\".*\n(?:     .*\n)+", README, flags=re.MULTILINE)[0].replace("\n", "")
    for name, value in json.loads(shown).items():
        if name == "alternatives":
            assert value[0]["center_world"] == pytest.approx(result[name][0]["center_world"], abs=1e-4)
        else:
            assert value == pytest.approx(result[name], abs=5e-3), name
    assert (tmp_path / "overlay.png").read_bytes().startswith(b"\x89PNG")


def test_readme_has_the_lines_and_times_of_the_program(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    words = ["--cloud", "examples/flat/cloud.ply", "--pano", "examples/flat/images/living_room.jpg"]
    assert main_of("localize.py")(words) == 0
    printed = capsys.readouterr().err
    shown = re.search(
        r"^    (examples/.*\n)    (  conf.*\n)    (  one .*\n)", README, flags=re.MULTILINE
    ).groups()
    for line in shown:
        begin = re.split(r"[-\d.]+", line)[0]
        (own,) = (found for found in printed.splitlines(keepends=True) if found.startswith(begin))
        assert re.split(NUMBER, own) == re.split(NUMBER, line)
        numbers, wanted = ([float(x) for x in re.findall(NUMBER, text)] for text in (own, line))
        if line is shown[0]:
            del numbers[-1], wanted[-1]  # seconds
        assert numbers == pytest.approx(wanted, rel=0.02, abs=0.01)
    assert f"The first photo waits {COMPILE_TIME}, on one core" in README


def test_room_runs_as_written(tmp_path, monkeypatch, capsys):
    room, _ = _tools_commands()
    assert "| all | 2 | 2 | 1.000 |" in _run_all(room, tmp_path, monkeypatch, capsys)
    assert (tmp_path / "room" / "risk.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "room" / "poses.csv").read_text().splitlines()) == 3


def test_pipeline_runs_as_written(tmp_path, monkeypatch, capsys):
    _, pipeline = _tools_commands()
    printed = _run_all(pipeline, tmp_path, monkeypatch, capsys)
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 2
    assert '"fits": true' in printed
    assert '"status": "aligned"' in printed
    assert "| default.jsonl | 2 | 2 | 1.000 |" in printed
    assert (tmp_path / "aligned" / "room.map").stat().st_size > 100_000
    assert len((tmp_path / "paper.jsonl").read_text().splitlines()) == 2


FLAT = ROOT / "examples" / "flat"


def _digests():
    return {path: hashlib.sha256(path.read_bytes()).digest() for path in FLAT.rglob("*") if path.is_file()}


def test_demo_localizes_every_picture_and_leaves_the_sample_unchanged(tmp_path, monkeypatch, capsys):
    checkout = tmp_path / "a checkout"  # with a space
    (checkout / "demo").mkdir(parents=True)
    (checkout / "examples").symlink_to(ROOT / "examples")
    for name in ("pose.json", "poses.jsonl", "overlay.png", "plan.png"):
        (checkout / "demo" / name).write_text("of an earlier run\n")
    before = _digests()
    recipe = re.search(r"^demo:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1]
    commands = re.findall(r"^\t\$\(BIN\)/python (.*)", recipe, flags=re.MULTILINE)
    printed = _run_all(commands, checkout, monkeypatch, capsys)
    names = [query["image"] for query in json.loads((FLAT / "queries.json").read_text())["queries"]]
    assert len(names) == 5
    for name in names:
        assert f"| flat | {name} | localized |" in printed
    assert "| all | 5 | 5 | 1.000 |" in printed
    for name in ("pose.json", "overlay.png", "poses.jsonl", "plan.png", "report/index.html"):
        assert (checkout / "demo" / name).stat().st_size > 1000, name
    assert _digests() == before


SCAN, PHOTO = "room/cloud.ply", "room/images/clean_0.jpg"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("examples")
    words = "--seed 4 --points 100000 --panoramas 2 --width 1024 --quiet"
    assert make_room.main(["--out", str(path / "room"), *words.split()]) == 0
    return path


@pytest.fixture
def run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capsys.readouterr()

    return run


def _true_centers(folder):
    queries = json.loads((folder / "room" / "queries.json").read_text())["queries"]
    return [np.array(query["center_world"]) for query in queries]


def test_one_photo(run, folder):
    status, center, *_ = run("localize_one.py", SCAN, PHOTO).out.splitlines()
    assert status.startswith("localized")
    found = json.loads(center.removeprefix("center_world [m] "))
    assert np.linalg.norm(found - _true_centers(folder)[0]) < 0.01


def test_a_folder_with_priors_goes_on_after_a_damaged_photo(run, folder):
    (folder / "photos").mkdir()
    for name in ("clean_0.jpg", "clean_1.jpg"):
        (folder / "photos" / name).write_bytes((folder / "room" / "images" / name).read_bytes())
    (folder / "photos" / "a.jpg").write_bytes(b"damaged")
    (folder / "priors.csv").write_text("name,x,y,z,radius\nclean_0.jpg,2.5,3,1.2,0.8\n")
    printed = run("localize_folder.py", SCAN, "photos", "priors.csv")
    rows = list(csv.DictReader(printed.out.splitlines()))
    assert [row["name"] for row in rows] == ["clean_0.jpg", "clean_1.jpg"]
    for row, center in zip(rows, _true_centers(folder), strict=True):
        assert np.linalg.norm([float(row[axis]) for axis in "xyz"] - center) < 0.01
    assert "a.jpg" in printed.err


@pytest.mark.parametrize("name", ["localize_one.py", "localize_folder.py", "own_arrays.py"])
def test_without_arguments_examples_say_which_are_wanted(run, name):
    with pytest.raises(SystemExit, match=rf"python examples/{name} scan\.ply"):
        run(name)


def test_own_arrays(run):
    assert "array: localized at (2.6" in run("own_arrays.py", SCAN, PHOTO).out


def test_api_page(folder, monkeypatch):
    monkeypatch.chdir(folder)
    page = str(ROOT / "docs" / "API.md")
    failures, tried = doctest.testfile(page, module_relative=False, optionflags=FLAGS)
    assert failures == 0
    assert tried > 20


PUBLIC = [
    "piccolo",
    "piccolo.api.opening",
    "piccolo.api.scan",
    "piccolo.apps.report.build",
    "piccolo.geometry.pose",
]


@pytest.mark.parametrize("name", PUBLIC)
def test_docstrings(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    known = {"piccolo": piccolo, "open_scan": piccolo.open_scan}
    failures, tried = doctest.testmod(import_module(name), extraglobs=known, optionflags=FLAGS)
    assert failures == 0
    assert tried > 0


@pytest.mark.parametrize(("kind", "own"), [(Cloud, {"source"}), (Photo, {"picture"}), (Prior, set())])
def test_the_options_are_named_and_explained(kind, own):
    names = {field.name for field in fields(kind)}
    page = (ROOT / "docs/API.md").read_text()
    told = re.split(r"\n\n|`help", page.partition(f"`help(piccolo.{kind.__name__})`")[2], maxsplit=1)[0]
    assert sorted(re.findall(r"`([a-z_]+)`", told)) == sorted(names - own)
    explained = kind.__doc__.partition("Parameters")[2].partition("Raises")[0]
    headings = re.findall(r"^    ([a-z_, ]+)$", explained, flags=re.MULTILINE)
    assert sorted(re.findall(r"\w+", " ".join(headings))) == sorted(names)


def test_the_table_of_formats_names_what_is_read():
    section = (ROOT / "docs/USAGE.md").read_text().partition("## Scans")[2].partition("##")[0]
    named = set(re.findall(r"`(\.[a-z0-9]+)`", section.partition("Colours go")[0]))
    assert named == {suffix for form in FORMATS for suffix in form.suffixes}


def test_the_table_of_exports_says_what_each_format_holds():
    section = (ROOT / "docs/CONVENTIONS.md").read_text().partition("## Exports")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.) \| (.) \| (.) \| (.) \|", section, flags=re.MULTILINE)
    options = "faces", "points", "offset"
    held = [
        (name, form.cameras != "spheres", *(option in form.options for option in options))
        for name, form in EXPORTS.items()
    ]
    assert sorted((name, *(mark == "+" for mark in marks)) for name, *marks in rows) == sorted(held)
