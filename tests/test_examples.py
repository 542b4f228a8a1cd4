"""The examples of folder, API page and docstrings, run in the folder of a made-up room."""

import csv
import doctest
import json
import runpy
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import piccolo
from research.synthetic import make_room

ROOT = Path(__file__).resolve().parents[1]
SCAN, PHOTO = "room/cloud.ply", "room/images/clean_0.jpg"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("examples")
    size = ["--points", "100000", "--panoramas", "2", "--width", "1024"]
    assert make_room.main(["--out", str(path / "room"), "--seed", "4", *size, "--quiet"]) == 0
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


def test_own_arrays(run):
    assert "array: localized at (2.6" in run("own_arrays.py", SCAN, PHOTO).out


def test_api_page(folder, monkeypatch):
    monkeypatch.chdir(folder)
    page = str(ROOT / "docs" / "API.md")
    failures, tried = doctest.testfile(page, module_relative=False, optionflags=FLAGS)
    assert failures == 0
    assert tried > 20


PUBLIC = ["piccolo", "piccolo.opening", "piccolo.scan", "piccolo.report.build", "piccolo.geometry.pose"]


@pytest.mark.parametrize("name", PUBLIC)
def test_docstrings(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    known = {"piccolo": piccolo, "open_scan": piccolo.open_scan}
    failures, tried = doctest.testmod(import_module(name), extraglobs=known, optionflags=FLAGS)
    assert failures == 0
    assert tried > 0
