"""tools/evaluate.py over scenes: run, stopped, taken up again, in several processes, compared."""

import hashlib
import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
from poses import result, write_results
from rooms import write_room

from piccolo.batch.localizer import Localizer
from piccolo.judge.result_parts import Source
from piccolo.photo.panorama import picture
from piccolo.system.jobs import memory
from research.evaluation import evaluate
from research.evaluation.query_result import read_run
from research.scene import Query, read_scene, write_queries

pytestmark = pytest.mark.research

TIER = "scene"

QUICK = ["--quiet", "--preset", "paper", "max_points=20000", "num_translations=12", "num_iterations=30"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two rooms below a folder; in the second a panorama of the first, with a pose far outside."""
    root = tmp_path_factory.mktemp("all scenes")
    for seed, name in ((7, "room"), (8, "hall 2")):
        write_room(root / name, f"--seed {seed} --points 20000 --panoramas 2 --width 256")
    scene = read_scene(root / "hall 2")
    shutil.copy(root / "room" / "images" / "clean_0.jpg", root / "hall 2" / "images" / "far.jpg")
    far_pose = replace(scene.queries[0].pose, center_world=np.full(3, 99.0))
    far = Query(scene.folder / "images" / "far.jpg", "far", far_pose)
    write_queries(scene.folder, [*scene.queries, far])
    return root


def _run(scenes, out, *more):
    return evaluate.main(["--scenes", str(scenes), "--out", str(out), *QUICK, *more])


def _changed(scenes, tmp_path, change):
    """A copy of the scene `room` whose queries are changed."""
    folder = tmp_path / "room"
    shutil.copytree(scenes / "room", folder)
    document = json.loads((folder / "queries.json").read_text())
    change(folder, document["queries"])
    (folder / "queries.json").write_text(json.dumps(document))
    return folder


def test_a_run_its_tables_and_files(scenes, tmp_path, capsys):
    out = tmp_path / "run.jsonl"
    files = {name: tmp_path / f"a {name}.png" for name in ("csv", "markdown", "errors", "risk")}
    options = [word for name, path in files.items() for word in (f"--{name}", str(path))]
    assert _run(scenes, out, *options) == 0
    text = capsys.readouterr().out
    rows = read_run(out)[0]
    hall = [("hall 2", True)] * 2 + [("hall 2", False)]
    room = [("room", True)] * 2
    assert [(row.scene, row.is_in_box) for row in rows] == hall + room
    assert rows[2].position_error > 50.0
    assert "all 5 queries; correct" in text
    assert "without the 1 queries taken outside the cloud's bounding box; correct" in text
    assert files["markdown"].read_text() == text
    assert len(files["csv"].read_text().splitlines()) == 6
    assert files["errors"].read_bytes()[1:4] == files["risk"].read_bytes()[1:4] == b"PNG"
    assert json.loads(out.read_text().splitlines()[0])["result"]["settings"]["num_translations"] == 12


@pytest.mark.process
def test_a_stopped_run_is_taken_up_and_gives_the_same(scenes, tmp_path, capsys):
    whole, torn = tmp_path / "whole.jsonl", tmp_path / "torn.jsonl"
    assert _run(scenes, whole, "--variants", "clean") == 0
    lines = whole.read_text().splitlines(keepends=True)
    torn.write_text(lines[0] + lines[1][:99])
    assert _run(scenes, torn, "--variants", "clean", "--jobs", "2") == 0
    capsys.readouterr()
    first, second = ({row.key: row for row in read_run(path)[0]} for path in (whole, torn))
    assert torn.read_text().startswith(lines[0])
    assert set(first) == set(second)
    assert len(first) == 4
    for key, row in first.items():
        assert np.array_equal(row.result.pose.center_world, second[key].result.pose.center_world)
    assert evaluate.main(["--compare", str(whole), str(torn)]) == 0
    text = capsys.readouterr().out
    assert f"only in {torn}: 0 queries" in text
    assert text.rstrip().endswith("|---|---|---|---|---|")  # no query has changed


def test_other_settings_or_poses_do_not_go_into_the_same_file(scenes, tmp_path, capsys):
    def move(_, queries):
        queries[0]["center_world"][0] += 0.5

    out = tmp_path / "run.jsonl"
    assert _run(scenes / "room", out) == 0
    before = out.read_bytes()
    assert _run(scenes / "room", out, "--preset", *QUICK[2:], "solver=lbfgs") == 3
    assert "run.jsonl: made with solver adam, now solver lbfgs" in capsys.readouterr().err
    assert _run(_changed(scenes, tmp_path, move), out) == 3
    assert "made with another true pose or another scene of this name" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_results_of_localize_are_those_of_the_scene_s_cloud(scenes, tmp_path, capsys):
    queries = read_scene(scenes / "room").queries
    right = hashlib.sha256((scenes / "room" / "cloud.ply").read_bytes()).hexdigest()
    lines = tmp_path / "poses.jsonl"
    words = ["--scenes", str(scenes / "room"), "--results", str(lines)]

    def run(digest, *more, strangers=()):
        first, second = queries
        results = [result(name, first.pose) for name in strangers]
        results.append(result(first.image, first.pose, source=Source(cloud_sha256=right)))
        results.append(result(second.image, second.pose, source=Source(cloud_sha256=digest)))
        write_results(lines, results)
        return evaluate.main([*words, *more]), *capsys.readouterr()

    assert run(right)[0] == 0
    code, out, err = run("0" * 64)
    assert (code, out) == (3, "")
    assert "clean_1.jpg: found 1 of 2 results of another scan than" in err
    code, out, err = run("0" * 64, "--force")
    assert (code, "all 2 queries" in out) == (0, True)
    assert "warning: found 1 of 2 results of another scan" in err
    code, out, err = run(right, strangers=["new\nline\udcff.jpg", "NUL\0.jpg"])
    assert (code, "all 2 queries" in out) == (3, True)
    first, second = err.splitlines()
    assert r"evaluate.py: new\nline\udcff.jpg: found a result without a true pose" in first
    assert r"NUL\x00.jpg: found a result without a true pose" in second


def test_no_output_replaces_an_input_or_another_output(scenes, tmp_path, capsys):
    truth = scenes / "room" / "queries.json"
    link = tmp_path / "link.png"
    out = tmp_path / "run.png"
    before = truth.read_bytes()
    link.hardlink_to(truth)
    for run, errors, message in (
        (out, link, "found an input as the output"),
        (out, f"{tmp_path}/../{tmp_path.name}/run.png", "found the same output as --out for --errors"),
        ("-", out, "a run is read again to be resumed"),
    ):
        assert _run(scenes / "room", run, "--errors", str(errors)) == 2
        assert message in capsys.readouterr().err
    assert truth.read_bytes() == before
    assert not out.exists()


def test_refusals(scenes, tmp_path, capsys):
    odd, empty, other = (tmp_path / name for name in ("odd.json", "a", "b"))
    odd.write_text("{}")
    empty.touch()
    other.touch()
    run = ["--scenes", scenes, "--out", tmp_path / "c"]
    for code, words, message in (
        (2, ["--out", "x"], "--scenes: needed with --out and --results"),
        (2, ["--scenes", "x", "--compare", "a", "b"], "--scenes: needed with --out and --results"),
        (2, [*run, "--jobs", 0], "--jobs: found 0"),
        (2, [*run, "--max-distance", -1], "--max-distance, --max-angle: wanted numbers above 0"),
        (2, ["--compare", "a", "b", "--csv", "c"], "--csv, --risk: not with --compare"),
        (2, [*run, "--preset", "paper", "--refine-focal"], "not an option of the preset paper"),
        (3, [*run, "--variants", "nope"], "wanted some of clean, far"),
        (3, ["--scenes", odd, "--results", "a"], "wanted a queries.json"),
        (3, ["--scenes", scenes, "--results", empty], "found no result"),
        (3, ["--compare", empty, other], "no query in common"),
    ):
        assert evaluate.main(list(map(str, words))) == code
        assert message in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_what_cannot_be_read_is_named_and_the_rest_done(scenes, tmp_path, capsys):
    root = tmp_path / "scenes"
    shutil.copytree(scenes, root)
    (root / "room" / "images" / "clean_0.jpg").write_bytes(b"no picture")
    (root / "hall 2" / "cloud.ply").write_bytes(b"ply\nno cloud")
    out = tmp_path / "run.jsonl"
    assert _run(root, out) == 3
    text, err = capsys.readouterr()
    assert len(err.splitlines()) == 2
    assert "hall 2/cloud.ply: the header has no line" in err
    assert "clean_0.jpg: " in err
    assert [row.key for row in read_run(out)[0]] == [("room", "images/clean_1.jpg")]
    assert "| all | 1 |" in text


def test_any_name_that_a_file_may_have_costs_its_own_line_at_most(scenes, tmp_path, capsys):
    names = ["a\nb.jpg", os.fsdecode(b"caf\xe9.jpg")]

    def rename(folder, queries):
        for query, name in zip(queries, names, strict=True):
            (folder / query["image"]).rename(folder / name)
            query["image"] = name
        queries.append({**queries[0], "image": "z" * 5000 + ".jpg"})

    folder = _changed(scenes, tmp_path, rename)
    out = tmp_path / "run.jsonl"
    csv = tmp_path / "table.csv"
    assert _run(folder, out, "--csv", str(csv)) == 3
    text, err = capsys.readouterr()
    assert [row.key[1] for row in read_run(out)[0]] == names
    assert (err.count("\n"), "File name too long" in err) == (1, True)
    assert "| a\\nb.jpg |" in text
    cells = [line.split(",")[1] for line in csv.read_text().splitlines()[1:]]
    assert cells == ["a\\nb.jpg", "caf\\udce9.jpg"]


def test_what_the_system_did_is_no_refusal_of_a_photo_without_an_answer(scenes, tmp_path, monkeypatch):
    def refuse(_, queries):
        for query in queries:
            query["answerable"] = False

    folder = _changed(scenes, tmp_path, refuse)
    out = tmp_path / "run.jsonl"
    with monkeypatch.context() as patched:
        patched.setattr(picture, "check_memory", lambda *given: memory.check_memory(1e15, *given[1:]))
        assert _run(folder, out) == 3
    assert not out.exists()
    assert _run(folder, out) == 0


def test_a_signal_ends_a_run_after_the_photo_at_work(scenes, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run.jsonl"
    answer = Localizer.answer

    def answer_late(self, *given):
        signal.raise_signal(signal.SIGTERM)
        return answer(self, *given)

    with monkeypatch.context() as patched:
        patched.setattr(Localizer, "answer", answer_late)
        assert _run(scenes, out) == 143
    assert capsys.readouterr().err.endswith("evaluate.py: terminated\n")
    assert [row.key for row in read_run(out)[0]] == [("hall 2", "images/clean_0.jpg")]
    assert _run(scenes, out) == 0
    assert len(read_run(out)[0]) == 5


def test_walks_have_a_line_each_and_what_shows_nothing_is_refused(tmp_path, capsys):
    """Also a black frame, of which no pixel is left: it is answered, and the run goes on after it."""
    folder, out = tmp_path / "walk", tmp_path / "run.jsonl"
    words = "--walk 4 --walks 2 --frame-rate 1 --bad-frames 0.4 --rooms 1 --points 20000 --width 256"
    write_room(folder, words)
    capsys.readouterr()
    assert _run(folder, out) == 0
    text = capsys.readouterr().out
    queries = read_scene(folder).by_name
    rows = read_run(out)[0]
    assert len(rows) == len(queries)
    by_variant = {row.variant: row for row in rows}
    assert by_variant["black"].result.status == "unreadable"
    assert "no pixel is left" in by_variant["black"].result.error
    assert all(not row.has_errors for row in rows if row.variant in ("black", "mirrored", "elsewhere"))
    table = text[text.index("walks; correct: under 0.1 m and 5 deg") :].splitlines()
    names = [line.split(" | ")[0].strip("| ") for line in table[4:7]]
    assert names == ["walk clean_walk_0", "walk clean_walk_1", "all"]
    first, second, total = (int(line.split(" | ")[1]) for line in table[4:7])
    assert first + second == total == len(rows)
    before = out.read_bytes()
    assert _run(folder, out) == 0
    assert out.read_bytes() == before
    assert capsys.readouterr().out == text
