"""The measuring tools, on small cases: that they run, and that their tables say what was measured."""

import json
import re

import benchmark
import pytest
from batches import command_of, run
from measuring import ablation, confidence, scaling
from rooms import write_room


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scene"), "--seed 7 --points 40000 --panoramas 1 --width 512")


def test_benchmark_prints_ratios_of_one_run(capsys):
    assert benchmark.main(["kernels", "--points", "20000", "--rounds", "7"]) == 0
    table = capsys.readouterr().out
    assert re.search(r"\| cv2.remap, 1 thread \| \d+ \| 1.00 \| 1.00 \|", table)
    assert re.search(r"normal matrix, 2 threads \| \d+ \| \d+\.\d\d \| \d+\.\d\d \|", table)
    assert "same bits with 1 and 2 threads: yes" in table


def test_benchmark_of_a_users_files_and_its_refusals(scene, capsys):
    pano = scene / "images" / "clean_0.jpg"
    files = ["--cloud", str(scene / "cloud.ply"), "--pano", str(pano), "--rounds", "7"]
    assert benchmark.main(["kernels", *files, "--points", "20000"]) == 0
    assert "20000 points, 512 x 256 image" in capsys.readouterr().out
    assert benchmark.main(["kernels", *files, "--points", "50000"]) == 3
    assert "found 40000 points, wanted --points 50000" in capsys.readouterr().err
    assert benchmark.main(["kernels", "--rounds", "3"]) == 2
    assert benchmark.main(["kernels", "--cloud", "a.ply"]) == 2


def test_ablation_has_a_row_a_part(scene, capsys, monkeypatch):
    parts = {name: ablation.PARTS[name] for name in ("all of it", "no visibility")}
    monkeypatch.setattr(ablation, "PARTS", parts)
    assert benchmark.main(["ablation", str(scene)]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == [f"| {part}" for part in parts]
    assert rows[0].startswith("| all of it | 1/1 | 0/0 | 0/0 | 0/0 |")
    assert benchmark.main(["ablation", str(scene / "no")]) == 3


def test_scaling_measures_points_and_rooms(scene, capsys, monkeypatch):
    assert benchmark.main(["scaling", "--scene", str(scene), "--points", "50000"]) == 0  # its own process
    (row,) = capsys.readouterr().out.splitlines()[2:]
    monkeypatch.setattr(scaling, "NUM_QUERIES", 1)
    cells = row.split(" | ")
    assert (cells[:2], cells[8]) == (["| 50000 points", "50000"], "1/1")
    cloud, queries = scaling.rooms_case(1)
    assert (len(cloud.points), len(queries)) == (50_000, 1)
    assert benchmark.main(["scaling", "--points", "1000"]) == 2


def test_trials_of_a_scene_and_what_is_learnt_from_them(scene, tmp_path, capsys, monkeypatch):
    without_scene = confidence.without_scene
    monkeypatch.setattr(confidence, "without_scene", lambda *of: list(without_scene(*of))[:1])
    out = tmp_path / "trials.jsonl"
    assert benchmark.main(["confidence", "--seeds", "0", "0", "--scenes", str(scene), "--out", str(out)]) == 0
    table = capsys.readouterr().out
    assert re.search(r"\| clean \| 1 \| 1 \| 1 \| 0 \| 0 \|", table)
    assert re.search(r"\| upside down \| 1 \| \d \| 0 \| \d \| 0 \|", table)
    cases = [json.loads(line)["case"] for line in out.read_text().splitlines()]
    assert cases[:2] == ["clean", "black"]
    assert benchmark.main(["calibration", "--fit", str(out), "--check", str(out)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"share \d+\.\d+, log of the score \d+\.\d+", text)
    assert re.search(r"constant -?\d+\.\d+, log10 of the largest deviation", text)
    assert "| probability, learnt from | answers | mean stated | right |" in text
    assert "| covariance, others | right poses |" in text
    assert benchmark.main(["calibration", "--fit", str(tmp_path / "none.jsonl")]) == 3
    (tmp_path / "odd.jsonl").write_text("{}")
    assert benchmark.main(["calibration", "--check", str(tmp_path / "odd.jsonl")]) == 3


def test_fuzzing_runs_and_finds_nothing_at_once(tmp_path):
    words = ["scene.json", "-runs=20", f"-artifact_prefix={tmp_path}/"]
    done = run(command_of("tests/fuzz/fuzz_readers.py", *words))
    assert done.returncode == 0
    assert "Done 20 runs" in done.stderr
    assert list(tmp_path.iterdir()) == []
