"""The measuring tools, on small cases: that they run, and that their tables say what was measured."""

import json
import re

import ablation
import benchmark
import benchmark_scaling
import calibrate_confidence
import evaluate_confidence
import fuzz_readers
import pytest
from rooms import write_room


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scene"), "--seed 7 --points 40000 --panoramas 1 --width 512")


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
    assert benchmark.main(["--rounds", "3"]) == benchmark.main(["--cloud", "a.ply"]) == 2


def test_ablation_has_a_row_a_part(scene, capsys):
    assert ablation.main([str(scene)]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == [f"| {part}" for part in ablation.PARTS]
    assert rows[0].startswith("| all of it | 1/1 | 0/0 | 0/0 | 0/0 |")
    assert ablation.main([str(scene / "no")]) == 3


def test_scaling_measures_points_and_rooms_in_processes_of_their_own(scene, capsys):
    assert benchmark_scaling.main(["--scene", str(scene), "--points", "30000", "50000", "--rooms", "1"]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    expected = [["| 30000 points", "30000"], ["| 50000 points", "50000"], ["| 1 rooms", "50000"]]
    assert [row.split(" | ")[:2] for row in rows] == expected
    assert all(row.split(" | ")[8] in ("1/1", "6/6") for row in rows)
    assert benchmark_scaling.main(["--points", "1000"]) == 2


def test_trials_of_a_scene_and_what_is_learnt_from_them(scene, tmp_path, capsys):
    out = tmp_path / "trials.jsonl"
    assert evaluate_confidence.main(["--seeds", "0", "0", "--scenes", str(scene), "--out", str(out)]) == 0
    table = capsys.readouterr().out
    assert re.search(r"\| clean \| 1 \| 1 \| 1 \| 0 \| 0 \|", table)
    assert re.search(r"\| upside down \| 1 \| \d \| 0 \| \d \| 0 \|", table)
    cases = [json.loads(line)["case"] for line in out.read_text().splitlines()]
    assert cases[:2] == ["clean", "black"]
    assert calibrate_confidence.main(["--fit", str(out), "--check", str(out)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"share \d+\.\d+, log of the score \d+\.\d+, log of the matches \d+\.\d+", text)
    assert re.search(r"constant -?\d+\.\d+, log10 of the largest deviation", text)
    assert "| probability, learnt from | answers | mean stated | right |" in text
    assert "| covariance, others | right poses |" in text
    assert calibrate_confidence.main(["--fit", str(tmp_path / "none.jsonl")]) == 3
    (tmp_path / "odd.jsonl").write_text("{}")
    assert calibrate_confidence.main(["--check", str(tmp_path / "odd.jsonl")]) == 3


def test_fuzzing_finds_nothing_in_a_second_and_knows_every_format(tmp_path, capsys):
    assert {"ply", "las", "e57", "pcd", "npz", "panorama", "map"} <= set(fuzz_readers.READERS)
    found = tmp_path / "found"
    assert fuzz_readers.main(["--reader", "scene", "--seconds", "1", "--crashes", str(found)]) == 0
    assert re.search(r"scene: \d+ inputs, ok", capsys.readouterr().out)
    assert list(found.iterdir()) == []
    with pytest.raises(SystemExit):
        fuzz_readers.main(["--reader", "doc", "--crashes", str(found)])


def test_maps_and_caches_are_fuzzed_by_hand(tmp_path, capfd):
    how = ["--reader", "maps", "caches", "--seed", "5", "--count", "40", "--crashes", str(tmp_path)]
    assert fuzz_readers.main(how) == 0
    maps, caches = capfd.readouterr().out.splitlines()
    assert re.fullmatch(
        r"maps: 40 mutations of seed 5, \d+ MB:( \d+ (refused|read|read and localized);)+", maps
    )
    assert re.fullmatch(
        r"caches: 40 mutations of seed 5, \d+ MB:( \d+ (compiled code|map made anew|map harmless);)+", caches
    )


def test_a_reader_that_breaks_is_found(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"")
    monkeypatch.setitem(fuzz_readers.READERS, "scene", ((".json",), lambda path: 1 // 0))
    with pytest.raises(ZeroDivisionError):
        fuzz_readers.try_file("scene", tmp_path / "a")
