"""The measuring tools, on small cases: that they run, and that their tables say what was measured."""

import json
import re

import ablation
import benchmark
import benchmark_scaling as growth
import calibrate_confidence as calibrate
import evaluate_confidence as trials
import fuzz_readers
import numpy as np
import pytest

from piccolo.cli import make_room
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.geometry.pose_error import is_correct, pose_errors
from piccolo.scenes.scene import read_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    arguments = [
        "--out",
        str(folder),
        "--seed",
        "7",
        "--points",
        "40000",
        "--panoramas",
        "1",
        "--width",
        "512",
    ]
    assert make_room.main([*arguments, "--panoramas", "1", "--size", "4.5", "3.5", "2.5", "--quiet"]) == 0
    return folder


def test_benchmark_prints_ratios_of_one_run(capsys):
    assert benchmark.main(["--points", "20000", "--rounds", "7"]) == 0
    table = capsys.readouterr().out
    assert re.search(r"\| cv2.remap, 1 thread \| \d+ \| 1.00 \| 1.00 \|", table)
    assert re.search(r"normal matrix, 2 threads \| \d+ \| \d+\.\d\d \| \d+\.\d\d \|", table)
    assert "same bits with 1 and 2 threads: yes" in table


def test_benchmark_of_a_users_files_and_its_refusals(scene, capsys):
    pano = scene / "images" / "clean_0.jpg"
    files = ["--cloud", str(scene / "cloud.ply"), "--pano", str(pano), "--rounds", "7"]
    assert benchmark.main([*files, "--points", "20000"]) == 0
    assert "20000 points, 512 x 256 image" in capsys.readouterr().out
    assert benchmark.main([*files, "--points", "50000"]) == 3
    assert "found 40000 points, wanted --points 50000" in capsys.readouterr().err
    for wrong in (["--rounds", "3"], ["--cloud", "a.ply"]):
        with pytest.raises(SystemExit):
            benchmark.main(wrong)


def test_ablation_has_a_row_a_part(scene, capsys):
    assert ablation.main([str(scene)]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == [
        *(f"| {part}" for part in ablation.SETTINGS),
        "| no local normalisation",
        "| no visibility",
    ]
    assert rows[0].startswith("| all of it | 1/1 | 0/0 | 0/0 | 0/0 |")
    assert ablation.main([str(scene / "no")]) == 3


def test_growth_measures_points_and_rooms_in_processes_of_their_own(scene, capsys):
    assert growth.main(["--scene", str(scene), "--points", "30000", "50000", "--rooms", "1"]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[:2] for row in rows] == [
        ["| 30000 points", "30000"],
        ["| 50000 points", "50000"],
        ["| 1 rooms", "50000"],
    ]
    assert all(row.split(" | ")[5] in ("1/1", "6/6") for row in rows)
    with pytest.raises(SystemExit):
        growth.main(["--points", "1000"])


def test_truth_is_read_and_a_pose_judged(tmp_path):
    entry = {"image": "images/a.jpg", "variant": "clean", "center_world": [1, 2, 3]}
    entry["R_cam_from_world"] = np.eye(3).tolist()
    (tmp_path / "queries.json").write_text(json.dumps({"queries": [entry]}))
    pose = read_scene(tmp_path).queries[0].pose
    near = Pose(
        exp_so3(np.array([0.0, 0.0, np.radians(4.9)])), pose.center_world + np.array([0.0, 0.09, 0.0])
    )
    distance, angle = pose_errors(near, pose)
    assert distance == pytest.approx(0.09)
    assert np.degrees(angle) == pytest.approx(4.9)
    assert is_correct(near, pose)
    assert not is_correct(Pose(near.R_cam_from_world, pose.center_world + np.array([0.0, 0.11, 0.0])), pose)
    assert not is_correct(None, pose)
    (tmp_path / "queries.json").write_text("{}")
    with pytest.raises(InputError, match=r"wanted a queries\.json with true poses"):
        read_scene(tmp_path)


def test_trials_of_a_scene_and_what_is_learnt_from_them(scene, tmp_path, capsys):
    out = tmp_path / "trials.jsonl"
    assert trials.main(["--seeds", "0", "0", "--scenes", str(scene), "--out", str(out)]) == 0
    table = capsys.readouterr().out
    assert re.search(r"\| clean \| 1 \| 1 \| 1 \| 0 \| 0 \|", table)
    assert re.search(r"\| upside down \| 1 \| \d \| 0 \| \d \| 0 \|", table)
    cases = [json.loads(line)["case"] for line in out.read_text().splitlines()]
    assert cases[:2] == ["clean", "black"]
    assert calibrate.main(["--fit", str(out), "--check", str(out)]) == 0
    told = capsys.readouterr().out
    assert re.search(r"bias -?\d+\.\d+, weights (-?\d+\.\d+, ){3}-?\d+\.\d+", told)
    assert "| covariance, others | right poses |" in told
    assert calibrate.main(["--fit", str(tmp_path / "none.jsonl")]) == 3
    (tmp_path / "odd.jsonl").write_text("{}")
    assert calibrate.main(["--check", str(tmp_path / "odd.jsonl")]) == 3


def test_fuzzing_finds_nothing_in_a_second_and_knows_every_format(tmp_path, capsys):
    assert {"ply", "las", "e57", "pcd", "npz", "panorama", "map"} <= set(fuzz_readers.READERS)
    found = tmp_path / "found"
    assert fuzz_readers.main(["--reader", "scene", "--seconds", "1", "--crashes", str(found)]) == 0
    assert re.search(r"scene: \d+ inputs, ok", capsys.readouterr().out)
    assert list(found.iterdir()) == []
    with pytest.raises(SystemExit):
        fuzz_readers.main(["--reader", "doc", "--crashes", str(found)])


def test_a_reader_that_breaks_is_found(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"")
    monkeypatch.setitem(fuzz_readers.READERS, "scene", ((".json",), lambda path: 1 // 0))
    with pytest.raises(ZeroDivisionError):
        fuzz_readers.try_file("scene", tmp_path / "a")
