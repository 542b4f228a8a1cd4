"""The measuring tools, on small cases: that they run, and that their tables say what was measured."""

import datetime
import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from types import SimpleNamespace

import cv2
import numba
import numpy as np
import pytest
from batches import ROOT, command_of, run
from rooms import write_room

from piccolo.geometry.pose import Pose
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.result import Result
from piccolo.localization.paper import PaperSettings
from piccolo.photo.panorama import read_panorama
from piccolo.problem.method import METHOD
from research.evaluation.query_result import QueryResult
from research.measuring import benchmark, confidence, page, sensitivity, speed
from research.scene import Query, read_scene, write_queries
from research.synthetic.world import cut_photo, write_photo

pytestmark = pytest.mark.research

TIER = "process"

DAMAGE = "20% hidden by objects", "half of the sphere masked"
TITLES = {name: text.splitlines()[0].removeprefix("## ") for name, text in page.PARTS.items()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scene"), "--seed 7 --points 40000 --panoramas 1 --width 512")


def table_of(page, title):
    """The rows of a section's table by their first cell, each a dict by column."""
    lines = page.split(f"## {title}\n")[1].split("\n## ")[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line[:1] == "|"]
    head, _, *rows = rows
    return {cells[0]: dict(zip(head[1:], cells[1:], strict=True)) for cells in rows}


def test_the_page_of_a_scene_says_what_was_measured(scene, tmp_path, monkeypatch):
    small = PaperSettings(num_translations=4, num_iterations=5, max_points=5000)
    monkeypatch.setattr(page, "PAPER_SETTINGS", small)
    damage = page.damage_trial

    def make_all(*given):
        """Make all kinds of damage, of which some are localized."""
        made = list(damage(*given))
        assert [trial.case for trial in made if trial.true_pose is None] == ["mirrored"]
        return [trial for trial in made if trial.case in DAMAGE]

    monkeypatch.setattr(page, "damage_trial", make_all)
    monkeypatch.setattr(page, "DAMAGED_SCANS", {"scan thinned to 5%": confidence.thin_points})
    monkeypatch.setattr(speed, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    out = tmp_path / "page.md"
    sizes = ["--damaged", "1", "--photos", "0", "--points", "20000", "--rooms"]
    assert benchmark.main(["all", "--scenes", str(scene), *sizes, "--quiet", "--out", str(out)]) == 0
    text = out.read_text()
    assert len(text.splitlines()) <= 200
    commit = run(["git", "-C", str(ROOT), "describe", "--always", "--abbrev=12"]).stdout.strip()
    assert f"Measured on {datetime.datetime.now(datetime.UTC).date()} at commit {commit or 'unknown'}" in text
    assert f"NumPy {np.__version__}, Numba {numba.__version__}, OpenCV {cv2.__version__};\n" in text
    row = table_of(text, TITLES["panoramas"])[f"{scene.name}, clean"]
    assert row["queries"] == row["right"] == row["localized"] == "1"
    assert row["wrong of these"] == "0"
    assert 0.0 < float(row["mm"]) < 20.0
    assert 0.0 < float(row["deg"]) < 0.5
    damaged = table_of(text, TITLES["damage"])
    assert {row["queries"] for row in damaged.values()} == {"1"}
    assert [damaged[name]["right"] for name in ("as taken", DAMAGE[0])] == 2 * ["1"]
    assert [damaged["another place"][column] for column in ("right", "localized", "mm")] == ["0", "0", "-"]
    assert set(damaged) == {"as taken", *DAMAGE, "another place", "scan thinned to 5%"}
    paper = table_of(text, TITLES["paper"])
    longer = float(paper["preset paper"]["s"])
    shorter = float(paper["default method"]["s"])
    rounded = 0.005  # [s] at most
    stated = float(re.search(r"The preset takes (\d+\.\d) times as long", text)[1])
    assert stated >= (longer - rounded) / (shorter + rounded) - 0.05
    assert stated <= (longer + rounded) / (shorter - rounded) + 0.05
    confidences = table_of(text, "Confidences")
    assert sum(int(row["answers"]) for row in confidences.values()) == 1 + len(damaged)
    assert f"0 of {1 + len(damaged)} were localized and are not right." in text
    sizes = table_of(text, TITLES["size"])
    assert [row["points"] for row in sizes.values()] == ["20,000"]
    assert re.fullmatch("[01]/1", sizes[f"{scene.name}, resampled"]["right"])
    speeds = table_of(text, TITLES["kernels"])
    assert speeds["cv2.remap"]["of cv2.remap"] == "1.00"
    assert float(speeds["loss"]["of cv2.remap"]) > 0.0


def test_the_times_of_two_methods_are_compared_by_their_medians():
    seconds = (("paper", 3.0), ("paper", 2.0), ("paper", 9.0), ("default", 0.5), ("default", 0.3))
    rows = [SimpleNamespace(variant=variant, seconds=s) for variant, s in seconds]
    assert page.time_ratio(rows) == pytest.approx(7.5)


def test_sizes_are_those_asked_for(scene):
    points, _, queries = speed.scene_case(read_scene(scene), 50_000, 1)  # more than it has
    assert (len(points), len(queries)) == (50_000, 1)
    points, _, queries = speed.rooms_case(1, 1)
    assert (len(points), len(queries)) == (50_000, 1)


def test_parts_of_the_page_and_its_refusals(scene, tmp_path, capsys):
    assert benchmark.main(["all", "--scenes", str(scene), "--only", "kernels"]) == 0
    text = capsys.readouterr().out
    assert [line for line in text.splitlines() if line.startswith("## ")] == [
        "## Kernels against `cv2.remap`"
    ]
    assert "40,000 points, 512 x 256 image" in text
    assert benchmark.main(["all", "--scenes", str(scene / "no")]) == 3
    write_queries(tmp_path, [])
    assert benchmark.main(["all", "--scenes", str(tmp_path)]) == 3
    assert "found no queries, wanted pictures with true poses" in capsys.readouterr().err
    assert benchmark.main(["all", "--scenes", str(scene), "--photos", "-1"]) == 2


def test_photos_are_cut_with_their_focal_length_as_it_is_and_in_exif(scene, monkeypatch, capsys):
    given = []

    def localize(photo):
        given.append(read_panorama(photo).focal_prior.source)
        return Result("not_localized", 0.0, "a.ply", "a.jpg")

    monkeypatch.setattr(page.piccolo, "open_scan", lambda *_, **__: SimpleNamespace(localize=localize))
    assert benchmark.main(["all", "--scenes", str(scene), "--only", "photos", "--photos", "1"]) == 0
    assert given == ["`focal_px`", "EXIF"]
    rows = table_of(capsys.readouterr().out, TITLES["photos"])
    assert [row["queries"] for row in rows.values()] == ["1", "1"]


def test_photos_of_a_scene_come_with_their_calibrations(tmp_path, capsys):
    write_room(tmp_path, "--seed 7 --points 40000 --panoramas 1 --width 512 --variants clean")
    (query,) = read_scene(tmp_path).queries
    path = tmp_path / "images" / "a.jpg"
    photo = cut_photo(read_panorama(query.image).rgb, query.pose, 70.0, np.random.default_rng(3))
    write_photo(photo, path)
    camera = {"format": "piccolo-camera/1", "model": "SIMPLE_PINHOLE", "width": 1024, "height": 768}
    (tmp_path / "cameras").mkdir()
    params = {"params": [photo.focal_px, 512, 384]}
    (tmp_path / "cameras" / "a.camera.json").write_text(json.dumps(camera | params))
    write_queries(tmp_path, [Query(path, "own", photo.pose)])
    assert benchmark.main(["all", "--scenes", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert [line for line in text.splitlines() if line.startswith("## ")] == [
        "## Phone photos",
        "## Confidences",
    ]
    assert table_of(text, TITLES["photos"])[f"{tmp_path.name}, own photos"]["right"] == "1"


def test_wrong_answers_are_listed():
    pose = Pose(np.eye(3), np.zeros(3))
    found = Pose(np.eye(3), np.array([0.5, 0.0, 0.0]))
    result = Result("localized", 0.95, "a.ply", "a.jpg", found, None, None, (), None, {"search": 1.0}, {})
    rows = [QueryResult("", "a.jpg", "night", None, pose, result)] * 25
    assert page.row_cells(rows) == ("25", "0", "25", "25", "0", "-", "-", "1.00")
    for std, is_outside in ((0.1, True), (0.25, False)):  # [m]
        known = replace(result, covariance=PoseCovariance(std**2 * np.eye(6), ""))
        assert page.is_outside(QueryResult("", "", "", None, pose, known)) == is_outside
    first, second, *_, last = page.wrong_lines(rows).splitlines()
    assert first == "25 of 25 were localized and are not right."
    assert second == "- night, a.jpg: 0.50 m off; confidence 0.950"
    assert last == "- and 5 more"


def test_trials_of_a_scene_and_what_is_learnt_from_them(scene, tmp_path, capsys, monkeypatch):
    without_scene = confidence.make_sceneless
    monkeypatch.setattr(confidence, "make_sceneless", lambda *of: list(without_scene(*of))[:1])
    out = tmp_path / "trials.jsonl"
    assert benchmark.main(["confidence", "--seeds", "0", "0", "--scenes", str(scene), "--out", str(out)]) == 0
    table = capsys.readouterr().out
    assert re.search(r"\| clean \| 1 \| 1 \| 1 \| 0 \| 0 \|", table)
    assert re.search(r"\| upside down \| 1 \| \d \| 0 \| \d \| 0 \|", table)
    cases = [json.loads(line)["case"] for line in out.read_text().splitlines()]
    assert cases[:2] == ["clean", "black"]
    assert benchmark.main(["calibration", "--fit", str(out), "--check", str(out)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"ratio \d+\.\d+, log of the score \d+\.\d+", text)
    assert re.search(r"constant -?\d+\.\d+, log10 of the largest deviation", text)
    assert "| probability, learnt from | answers | mean stated | fraction right |" in text
    assert "| covariance, others | right poses |" in text
    assert re.search(r"\| clean \| 0\.25 \| 1 \| 0\.9\d \| 1\.00 \| 1 \| 0 \| \d+\.\d+ \| \d+\.\d+ \|", text)
    assert benchmark.main(["calibration", "--fit", str(tmp_path / "none.jsonl")]) == 3
    (tmp_path / "odd.jsonl").write_text("{}")
    assert benchmark.main(["calibration", "--check", str(tmp_path / "odd.jsonl")]) == 3


def test_numbers_of_the_method_are_moved_one_at_a_time(scene, capsys, monkeypatch):
    """Each trial is localized once, whatever the numbers are then."""
    localize = sensitivity.localize_trial
    found = {}
    moved = []

    def localize_once(scan_map, trial, workers, method):
        moved.append(method)
        if trial.case not in found:
            found[trial.case] = localize(scan_map, trial, workers, method)
        return found[trial.case]

    monkeypatch.setattr(sensitivity, "localize_trial", localize_once)
    assert benchmark.main(["sensitivity", "--scenes", str(scene), "--most", "1", "--quiet"]) == 0
    head, _, before, *rows = capsys.readouterr().out.strip().splitlines()
    assert head == "| number | right | localized | wrong of these | median [mm] | changed |"
    assert re.fullmatch(r"\| as they are \| [12] \| [12] \| 0 \| \d+\.\d\d \| 0 \|", before)
    names = [field.name for field in fields(METHOD)]
    told = [f"{name} x {factor}" for name in names for factor in (0.8, 1.2)]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == told
    by_run = list(zip(moved[::2], moved[1::2], strict=True))  # a panorama, and a photo
    assert all(run == again for run, again in by_run)
    changes = [[n for n in names if getattr(run, n) != getattr(METHOD, n)] for run, _ in by_run]
    assert changes == [[], *([name] for name in names for _ in range(2))]


def test_a_number_is_moved_by_a_fifth_and_a_whole_one_by_one_at_least():
    assert sensitivity.move(METHOD, "sure_odds", 1.2).sure_odds == pytest.approx(3.6)
    assert sensitivity.move(METHOD, "candidates_per_start", 0.8).candidates_per_start == 1
    assert sensitivity.move(METHOD, "enough_matches", 1.2).enough_matches == 48


def test_fuzzing_runs_and_finds_nothing_at_once(tmp_path):
    words = ["scene.json", "-runs=20", f"-artifact_prefix={tmp_path}/"]
    done = run(command_of("tests/fuzz/fuzz_readers.py", *words))
    assert done.returncode == 0
    assert "Done 20 runs" in done.stderr
    assert list(tmp_path.iterdir()) == []
