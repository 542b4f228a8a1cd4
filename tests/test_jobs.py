"""Batches in several processes: the same files, whoever is killed."""

import argparse
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest
from batches import PAPER, start_localize, untimed, wait_for_lines, workers_of

from piccolo.api.result_files import read_results
from piccolo.batch.localizer import Localizer
from piccolo.cli import execution, localize, settings_given
from piccolo.judge.result import Result
from piccolo.system.jobs.memory import memory_taken
from piccolo.system.jobs.threads import num_cores

TIER = "process"

pytestmark = pytest.mark.usefixtures("searched_once")


@pytest.fixture(scope="module")
def many(scene, tmp_path_factory, searched_once):
    """A list that names two dozen panoramas, and their results by one process."""
    folder = tmp_path_factory.mktemp("many")
    panos = [str(scene / "images" / f"clean_{k % 3}.jpg") for k in range(24)]
    (folder / "list.txt").write_text("\n".join(panos))
    out = folder / "poses.jsonl"
    assert localize.main(_words(scene, f"@{folder / 'list.txt'}", "--out", str(out), "--jobs", "1")) < 2
    return f"@{folder / 'list.txt'}", untimed(out)


def _words(scene, pano, *more):
    return ["--cloud", str(scene / "cloud.ply"), "--pano", pano, "--quiet", *PAPER, *more]


def test_several_processes_write_the_same_files(scene, tmp_path, capsys):
    bad = tmp_path / os.fsdecode(b"bad\n\xe9.jpg")
    bad.write_bytes(b"\xff\xd8\xff nothing more")
    table = tmp_path / "priors.csv"
    table.write_text("name,height\nclean_1.jpg,1.5\nclean_9.jpg,1\n")
    found = []
    for jobs in ("1", "2"):
        folder = tmp_path / jobs
        pictures = [folder / "overlays", folder / "changes"]
        for path in pictures:
            path.mkdir(parents=True)
        words = ["--cloud", str(scene / "cloud.ply"), "--pano", str(bad), str(scene / "images")]
        words += ["--out", str(folder / "out"), "--overlay", str(pictures[0]), "--priors", str(table)]
        words += ["--occlusion-mask", str(pictures[1]), "--max-memory", "8"]
        words += ["--cache", str(scene.parent / "maps")]
        assert localize.main([*words, "--jobs", jobs]) == 3
        err = re.sub(r" in [0-9.]+ s", "", capsys.readouterr().err)
        lines = [line for line in err.splitlines() if re.search("clean|bad|names", line)]
        files = {path.name: path.read_bytes() for folder_ in pictures for path in folder_.iterdir()}
        found.append((untimed(folder / "out"), files, lines))
    assert found[0] == found[1]
    assert len(found[0][1]) == 3


class Deadly(Localizer):
    """Localizes; one photo kills the process at work on it."""

    def answer(self, scan, others, task):
        if task.photo.path.name == "deadly.jpg":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().answer(scan, others, task)


def test_a_photo_that_kills_its_processes_is_a_line_that_says_so(scene, tmp_path, monkeypatch, capsys):
    deadly = tmp_path / "deadly.jpg"
    deadly.write_bytes((scene / "images" / "clean_0.jpg").read_bytes())
    monkeypatch.setattr(settings_given, "Localizer", Deadly)
    panos = tmp_path / "list.txt"
    names = [str(scene / "images" / "clean_1.jpg"), str(deadly), str(scene / "images" / "clean_2.jpg")]
    panos.write_text("\n".join(names))
    out = tmp_path / "poses.jsonl"
    assert localize.main(_words(scene, f"@{panos}", "--out", str(out), "--jobs", "2")) == 3
    error = f"{deadly}: each of 2 processes at work on it was killed by SIGKILL"
    assert capsys.readouterr().err == f"localize.py: {error}\n"
    results = read_results([out])
    assert [result.pano for result in results] == names
    assert [result.status == "failed" for result in results] == [False, True, False]
    assert results[1].error == error
    monkeypatch.undo()
    assert localize.main(_words(scene, f"@{panos}", "--out", str(out), "--jobs", "1")) < 2  # it once more
    results = read_results([out])
    assert [result.pano for result in results] == names
    assert "failed" not in {result.status for result in results}


def test_a_signal_ends_all_and_the_same_command_goes_on(scene, many, tmp_path):
    out, temporary = tmp_path / "poses.jsonl", tmp_path / "temporary"
    temporary.mkdir()
    words = _words(scene, many[0], "--out", str(out), "--jobs", "2", "--cache", "none")
    options = {"env": {**os.environ, "TMPDIR": str(temporary)}, "start_new_session": True}
    with start_localize(words, **options) as process:
        wait_for_lines(process, out, 2)
        os.killpg(process.pid, signal.SIGTERM)
        err = process.stderr.read()
        assert process.wait() == 143
    assert "the same command continues from here" in err
    assert "Traceback" not in err
    assert list(temporary.iterdir()) == []
    text = out.read_text()
    assert 2 <= text.count("\n") < 24
    assert text.endswith("\n")
    assert localize.main([*words, "--jobs", "1"]) < 2
    assert untimed(out) == many[1]


def test_a_killed_process_costs_nothing_and_a_killed_parent_leaves_whole_lines(scene, many, tmp_path):
    out = tmp_path / "poses.jsonl"
    words = _words(scene, many[0], "--out", str(out), "--jobs", "2")
    with start_localize(words) as process:
        wait_for_lines(process, out, 2)
        os.kill(workers_of(process)[0], signal.SIGKILL)
        wait_for_lines(process, out, 9)
        workers = workers_of(process)
        process.kill()
        process.stderr.read()  # until all have ended that had it open
    assert 1 <= len(workers) <= 2
    assert not any(Path(f"/proc/{id_}/exe").exists() for id_ in workers)
    assert localize.main([*words, "--jobs", "1"]) < 2
    assert untimed(out) == many[1]


def test_names_on_standard_input_are_answered_as_they_come(scene):
    name = str(scene / "images" / "clean_1.jpg")
    words = _words(scene, "-", "--jobs", "2")
    with start_localize(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        for word in (name, "missing.jpg", name):
            process.stdin.write(word + "\n")
            process.stdin.flush()
            found = Result.from_json(process.stdout.readline())
            assert (found.pano, found.status == "unreadable") == (word, word != name)
        process.send_signal(signal.SIGINT)  # while it waits for a name
        assert process.wait(timeout=60) == 130
        assert "Fatal" not in process.stderr.read()


def test_as_many_processes_as_are_worth_it_and_fit():
    most = num_cores()

    def wanted(num_left, jobs=None, threads=None):
        return execution.count_jobs(argparse.Namespace(jobs=jobs, threads=threads), num_left)

    assert [wanted(count) for count in (1, 15, 16, 31, None)] == [1, 1, min(2, most), min(3, most), 1]
    assert wanted(100 * most) == most
    given = wanted(1000, threads=2), wanted(3, jobs=8), wanted(None, jobs=8), wanted(0, jobs=2)
    assert given == (1, 3, 8, 2)
    assert execution.count_in_memory(1.5e9, 4.6e9) == 3
    assert execution.count_in_memory(1.5e9, 1e8) == 1
    assert execution.count_fitting(argparse.Namespace(jobs=None), 1) == 1
    assert execution.count_fitting(argparse.Namespace(jobs=8), 8) == 8
    arguments = argparse.Namespace(jobs=2, threads=None, max_memory=5.5, dask=None)
    localizer = Localizer((), None, None, None, None)
    share = execution.share_of_a_job(arguments, localizer, 2)
    assert share.num_threads == max(1, most // 2)
    assert share.max_memory == pytest.approx((5.5 - memory_taken() / 1e9) / 2.0, rel=0.01)
