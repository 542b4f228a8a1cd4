"""The command line of tools/export_poses.py, and which results it writes."""

import csv
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from PIL import Image
from poses import CENTER, SIZE, jpeg, lines_of, result, tilted_poses, write_results
from refusals import mutated, read_or_refused

from piccolo.api.result_files import read_results
from piccolo.apps.export import export_poses
from piccolo.apps.export.formats import FORMATS
from piccolo.apps.export.posed_images import select_results
from piccolo.judge.result_parts import Source
from piccolo.system.errors import InputError
from research.datasets.generic import _table

POSES = tilted_poses(5)
MIXED = [
    result("p/a.jpg", POSES[0]),
    result("p/b.jpg", POSES[1], "not_localized"),
    result("p/c.jpg", POSES[2], "ambiguous", cloud="b.ply"),
    result("p/d.jpg", None, "not_localized"),
    result("p/e.jpg", POSES[4], cloud="b.ply"),
]


def needed(name):
    """Options without which a format does not write poses without pictures."""
    sizes = ["--size", "64", "32"] if "size" in FORMATS[name].options else []
    sizes += ["--offset", *map(str, CENTER)] if name == "rerun" else []
    return ["--crs", "EPSG:32632"] if name in ("geojson", "gpx") else sizes


@pytest.fixture
def run(tmp_path, capsys):
    """Run the tool on results; returns exit code, stdout as JSON and stderr."""

    def call(*arguments, results=MIXED):
        paths = [write_results(tmp_path / "1.jsonl", results[:3])]
        if results[3:]:
            paths.append(write_results(tmp_path / "2.jsonl", results[3:]))
        code = export_poses.main(["--results", *map(str, [*paths, *arguments])])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return call


def test_only_localized_poses_are_written_and_the_others_counted(run, tmp_path):
    code, document, err = run("--format", "csv", "--out", tmp_path / "p.csv")
    assert (code, document["poses"]) == (0, 2)
    assert document["left_out"] == {"not_localized": 1, "ambiguous": 1, "without a pose": 1}
    assert "left out 3 of 5 results: 1 not_localized, 1 ambiguous, 1 without a pose" in err
    assert "poses in 2 clouds are assumed to be in one coordinate system" in err
    assert [line.split(",")[0] for line in lines_of(tmp_path / "p.csv")[1:]] == ["p/a.jpg", "p/e.jpg"]


def test_all_and_clouds_are_selected_in_order(run, tmp_path):
    words = ["--format", "csv", "--out", tmp_path / "p.csv"]
    code, document, err = run(*words, "--all", "--cloud", "b.ply")
    assert (code, document["poses"], document["left_out"]["other clouds"]) == (0, 2, 3)
    assert "coordinate system" not in err
    code, _, err = run(*words, "--cloud", "c.ply")
    assert (code, "found no result for c.ply, wanted one of a.ply, b.ply" in err) == (3, True)
    assert [r.pano for r in select_results(MIXED, use_all=True).results] == [
        MIXED[i].pano for i in (0, 1, 2, 4)
    ]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_writes_whole_files_and_nothing_else(run, tmp_path, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("p").mkdir()
    for picture in ("a", "e"):
        jpeg(Path("p", f"{picture}.jpg"))
    assert run("--format", name, "--images", "p", "--out", "made", *needed(name))[0] == 0
    assert {path.name for path in tmp_path.iterdir()} == {"p", "1.jsonl", "2.jsonl", "made"}
    assert Path("made").is_dir() == FORMATS[name].is_folder
    files = Path("made").rglob("*") if FORMATS[name].is_folder else [Path("made")]
    content = b"".join(path.read_bytes() for path in files)
    assert (b"a.jpg" in content) == (name not in ("tum", "kitti", "gpano"))
    assert b"p/a.jpg" not in content


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "csv", "--axes", "optical"], "--axes: not an option of the format csv"),
        (["--format", "gpano", "--offset", "1", "2", "3"], "--offset: not an option of the format gpano"),
        (["--format", "geojson"], "--crs: not given"),
        (["--format", "colmap", "--size", "100", "80"], "--size: found 100 x 80, wanted width = 2 x height"),
        (["--format", "csv", "--offset", "nan", "0", "0"], "--offset: found"),
    ],
)
def test_wrong_usage(run, tmp_path, arguments, message):
    code, document, err = run(*arguments, "--out", tmp_path / "p")
    assert (code, document) == (2, None)
    assert message in err


def test_bad_input(run, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    for arguments, message in (
        (["--format", "colmap", "--out", tmp_path / "full"], "found a folder that is not empty"),
        (["--format", "colmap", "--out", tmp_path / "full" / "x"], "found a file, wanted a folder"),
        (["--format", "colmap", "--out", tmp_path / "no" / "x"], "found no folder"),
        (["--format", "csv", "--out", tmp_path / "full"], "found a folder, wanted a file name"),
        (["--format", "colmap", "--out", tmp_path / "x"], "p/a.jpg: cannot be read (No such file"),
        (["--format", "gpano", "--out", tmp_path / "x"], "p/a.jpg"),
        (["--format", "csv", "--images", "q", "--out", tmp_path / "x"], "is not in the folder --images q"),
    ):
        code, document, err = run(*arguments)
        assert (code, document) == (3, None), arguments
        assert message in err
    for results, message in (
        ([], "found no result, wanted JSON lines"),
        (MIXED[3:4], "there is no pose to write"),
    ):
        code, _, err = run("--format", "csv", "--out", tmp_path / "x", results=results)
        assert (code, message in err) == (3, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.jsonl", "2.jsonl", "full"]


def test_two_results_of_one_picture_are_refused_where_the_name_is_the_key(run, tmp_path):
    results = [MIXED[0], replace(MIXED[0], cloud="b.ply")]
    out = tmp_path / "out"
    code, _, err = run("--format", "opensfm", "--size", "64", "32", "--out", out, results=results)
    assert code == 3
    assert "p/a.jpg: has two results (clouds a.ply, b.ply); choose one with --cloud" in err
    assert run("--format", "csv", "--out", out, results=results)[1]["poses"] == 2


STRANGE = {
    "p/new\nline.jpg": {"colmap", "potree"},
    "p/a\ttab.jpg": {"colmap", "potree"},
    "p/\udcff.jpg": {"colmap", "csv", "nerfstudio", "opensfm", "potree", "geojson", "rerun"},
    "p/b c.jpg": {"colmap"},
    'p/q".jpg': {"potree"},
    f"p/{'x' * 5000}.jpg": set(),
    "=cmd|' !A1.jpg": {"colmap"},
}  # names, and the formats that can't hold them


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "gpano"])
def test_a_name_costs_at_most_its_own_picture(run, tmp_path, name):
    results = [result(pano, POSES[0]) for pano in ("p/a.jpg", *STRANGE)]
    out = tmp_path / "out"
    if not FORMATS[name].is_folder:
        out.touch()
    code, document, err = run("--format", name, "--out", out, *needed(name), results=results)
    left_out = [pano for pano, formats in STRANGE.items() if name in formats]
    assert code == bool(left_out)
    assert document["poses"] == len(results) - len(left_out)
    assert sum(document["left_out"].values()) == len(left_out)
    assert err.count("left out") == len(document["left_out"])
    text = (out / "images.txt" if out.is_dir() else out).read_text(encoding="latin-1")
    holders = "nerfstudio", "opensfm", "csv", "potree", "geojson", "gpx", "rerun"  # Rerun's paths have b\\ c
    assert ("b c" in text.replace("\\", "")) == (name in holders)


def test_names_in_a_table_are_no_formulas_and_come_back(run, tmp_path):
    names = ["=cmd|' !A1.jpg", "+1.jpg", "-1.jpg", "@a.jpg", "'a.jpg", "p/=a.jpg", 'two\nlines, "q".jpg']
    results = [result(name, POSES[0], cloud="=b.ply") for name in names]
    assert run("--format", "csv", "--out", tmp_path / "poses.csv", results=results)[0] == 0
    with (tmp_path / "poses.csv").open(newline="") as file:
        cells = [row["image"] for row in csv.DictReader(file)]
    assert cells == [*(f"'{name}" for name in names[:5]), *names[5:]]
    assert [row["image"] for row in _table(tmp_path / "poses.csv")] == names


def test_a_picture_stored_turned_is_left_out(run, tmp_path):
    (tmp_path / "p").mkdir()
    for name, orientation, size in (("a", 1, (64, 32)), ("b", 6, (32, 64)), ("c", 3, (64, 32))):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.new("RGB", size).save(tmp_path / "p" / f"{name}.jpg", exif=exif)
    results = [result(tmp_path / "p" / f"{n}.jpg", POSES[0]) for n in "abc"]
    for name in ("nerfstudio", "opensfm", "colmap"):
        words = ["--format", name, "--out", tmp_path / name]
        code, document, err = run(*words, results=results)
        assert (code, document["poses"]) == (1, 1)
        assert "b.jpg: found it stored rotated (EXIF orientation 6), wanted it upright" in err
        words = ["--format", name, "--out", tmp_path / f"{name}-sized", "--size", "64", "32"]
        assert run(*words, results=results)[1]["poses"] == 3


def test_one_png_among_jpegs_is_left_out_of_gpano(run, tmp_path):
    (tmp_path / "p").mkdir()
    jpeg(tmp_path / "p" / "a.jpg")
    Image.new("RGB", SIZE).save(tmp_path / "p" / "b.png")
    results = [result(tmp_path / "p" / name, POSES[0]) for name in ("a.jpg", "b.png", "gone.jpg")]
    code, document, err = run("--format", "gpano", "--out", tmp_path / "out", results=results)
    assert (code, document["poses"], len(document["left_out"])) == (1, 1, 2)
    assert "b.png: no JPEG" in err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.jpg"]


def test_results_of_another_content_of_the_cloud_are_refused(run, tmp_path):
    cloud = tmp_path / "a.ply"
    cloud.write_bytes(b"a scan")
    right, wrong = (hashlib.sha256(content).hexdigest() for content in (b"a scan", b"another"))
    sources = [Source(cloud_sha256=digest) for digest in (right, wrong, None)]
    panos = [f"{k}.jpg" for k in range(3)]
    results = [result(p, POSES[0], cloud=str(cloud), source=s) for p, s in zip(panos, sources, strict=True)]
    words = ["--format", "csv", "--out", tmp_path / "p.csv", "--cloud", cloud]
    code, _, err = run(*words, results=results)
    assert code == 3
    assert f"1.jpg: found 1 of 3 results of another scan than {cloud}, the first of {cloud}" in err
    code, document, err = run(*words, "--force", results=results)
    assert (code, document["poses"]) == (0, 3)
    assert "found 1 of 3 results of another scan" in err
    assert (
        "poses in 3 clouds are assumed to be in one coordinate system" in run(*words[:4], results=results)[2]
    )


def test_damaged_results_are_refused_with_file_and_line(tmp_path):
    path = tmp_path / "r.jsonl"
    for damaged in ("{", "[" * 100_000, json.dumps({**json.loads(MIXED[0].to_json()), "pano": "\ud800.jpg"})):
        path.write_text(MIXED[0].to_json() + "\n\n" + damaged + "\n")
        with pytest.raises(InputError, match=r"r\.jsonl, line 3: ") as caught:
            read_results([path])
        assert "\n" not in str(caught.value)


@given(st.data())
@settings(max_examples=100)
def test_any_damage_of_results_is_refused_or_harmless(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("damaged") / "r.jsonl"
    content = (MIXED[0].to_json() + "\n").encode() * 2
    path.write_bytes(mutated(data.draw, st.integers, content))
    results, _ = read_or_refused(lambda p: read_results([p]), path)
    for r in results or []:
        R = r.best_pose.R_cam_from_world if r.best_pose else np.eye(3)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)


TEXTS = [name for name, form in FORMATS.items() if not form.is_folder and name != "rerun"]


@pytest.mark.parametrize("name", TEXTS)
def test_poses_on_stdout_are_those_of_a_file_and_the_report_goes_to_stderr(tmp_path, capsys, name):
    write_results(tmp_path / "r.jsonl", MIXED)
    arguments = ["--results", str(tmp_path / "r.jsonl"), "--format", name, *needed(name), "--out"]
    assert export_poses.main([*arguments, str(tmp_path / "file")]) == 0
    capsys.readouterr()
    assert export_poses.main([*arguments, "-"]) == 0
    out, err = capsys.readouterr()
    assert out == (tmp_path / "file").read_text()
    assert json.loads(err.splitlines()[-1])["poses"] == 2
    assert export_poses.main([*arguments, "-", "--quiet"]) == 0
    assert capsys.readouterr() == (out, "")
    if "offset" in FORMATS[name].options and name not in ("nerfstudio", "tum"):
        assert export_poses.main([*arguments, "-", "--offset", "1", "2", "3"]) == 3
        assert "--offset: nothing can be written beside -" in capsys.readouterr().err


def test_no_picture_of_the_results_is_replaced(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("p").mkdir()
    jpeg(Path("p", "d.jpg"))
    Path("link.csv").symlink_to("p/d.jpg")
    for out in ("p/d.jpg", "link.csv", tmp_path / "1.jsonl"):
        code, _, err = run("--format", "csv", "--out", out)
        assert (code, "found an input as the output, wanted another name" in err) == (2, True)
