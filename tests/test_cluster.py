"""Batches on a Dask cluster: the same files, whichever worker is killed; on 127.0.0.1 only."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest
from batches import PAPER, ROOT, start_localize, untimed, wait_for_lines, workers_of

from piccolo.cli import localize
from piccolo.system.jobs import cluster
from research.evaluation import evaluate

TIER = "process"

pytestmark = pytest.mark.usefixtures("searched_once")

PANOS = [f"images/clean_{k % 3}.jpg" for k in range(12)]


def _dask(log, *words):
    """A part of a cluster, which sees piccolo, at work in another folder."""
    log.parent.mkdir(exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "dask", *words, "--host", "127.0.0.1", "--no-dashboard"]
    with log.open("w") as file:
        options = {"cwd": log.parent, "env": environment, "stdout": file, "stderr": subprocess.STDOUT}
        return subprocess.Popen(command, **options)


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    """The file of a scheduler, and the process that has begun two workers."""
    folder = tmp_path_factory.mktemp("elsewhere")
    file = folder / "scheduler.json"
    begun = [_dask(folder / "log" / "s", "scheduler", "--port", "0", "--scheduler-file", str(file))]
    while not file.exists() or not file.read_text().endswith("}"):
        assert begun[0].poll() is None
        time.sleep(0.05)
    words = "worker", "--scheduler-file", str(file), "--nworkers", "2", "--nthreads", "1"
    begun.append(_dask(folder / "log" / "w", *words, "--local-directory", str(folder)))
    yield file, begun[1]
    for process in reversed(begun):
        process.terminate()
        process.wait()


@pytest.fixture
def scheduler(machines):
    return machines[0]


def test_a_cluster_loses_a_worker_is_interrupted_and_goes_on(scene, machines, tmp_path, monkeypatch):
    """However fast it is, it can't come to its end: it waits for names on standard input."""
    monkeypatch.chdir(scene)
    names = ["missing.jpg", *PANOS]
    whole, out = tmp_path / "whole.jsonl", tmp_path / "poses.jsonl"
    words = ["--cloud", "cloud.ply", "--quiet", *PAPER]
    assert localize.main([*words, "--pano", *names, "--out", str(whole), "--jobs", "1"]) == 3
    words += ["--out", str(out)]
    dask = ["--pano", "-", "--dask", str(machines[0])]
    with start_localize([*words, *dask], stdin=subprocess.PIPE, start_new_session=True) as process:
        process.stdin.writelines(f"{name}\n" for name in names[:4])
        wait_for_lines(process, out, 2)
        workers = workers_of(machines[1])
        assert len(workers) == 2
        os.kill(workers[0], signal.SIGKILL)
        process.stdin.writelines(f"{name}\n" for name in names[4:8])
        wait_for_lines(process, out, 8)
        os.killpg(process.pid, signal.SIGINT)
        err = process.stderr.read()
        assert process.wait() == 130
    assert "ended by Ctrl-C after 8 results; the same command continues from here" in err
    assert "Traceback" not in err
    assert localize.main([*words, "--pano", *names, "--jobs", "1"]) == 3
    assert untimed(out) == untimed(whole)


@pytest.fixture
def unshared(monkeypatch):
    """Let workers have none of the files."""
    monkeypatch.setattr(cluster.Cluster, "has_files", lambda *_: False)


@pytest.mark.parametrize("shared", [True, False])
def test_workers_elsewhere_open_the_scan_or_are_sent_it(
    scene, scheduler, tmp_path, monkeypatch, request, shared
):
    monkeypatch.chdir(scene)
    preset = ["--gravity", "known"]
    words = ["--cloud", "cloud.ply", "--pano", "missing.jpg", *PANOS[:3], "--quiet", *preset]
    whole, out = tmp_path / "whole.jsonl", tmp_path / "poses.jsonl"
    assert localize.main([*words, "--out", str(whole), "--jobs", "1"]) == 3
    if not shared:
        request.getfixturevalue("unshared")
    assert localize.main([*words, "--out", str(out), "--dask", str(scheduler)]) == 3
    assert untimed(out) == untimed(whole)
    assert list(scheduler.parent.rglob("*.piccolo-map")) == []  # what was sent is gone
    if not shared:
        paper = [*(word for word in words if word not in preset), *PAPER]
        assert localize.main([*paper, "--overwrite", "--out", str(out), "--dask", str(scheduler)]) == 3


def test_an_evaluation_on_a_cluster_gives_the_same(scene, scheduler, tmp_path, monkeypatch, request, capsys):
    monkeypatch.chdir(scene.parent)
    words = ["--scenes", scene.name, "--quiet", *PAPER]
    outs = [tmp_path / name for name in ("whole.jsonl", "run.jsonl")]
    for out, more in zip(outs, ([], ["--dask", str(scheduler)]), strict=True):
        assert evaluate.main([*words, "--out", str(out), *more]) == 0
    assert untimed(outs[0]) == untimed(outs[1])
    request.getfixturevalue("unshared")
    assert evaluate.main([*words, "--out", str(tmp_path / "c"), "--dask", str(scheduler)]) == 3
    assert "not all workers can read" in capsys.readouterr().err


def test_a_cluster_that_is_none_is_told_in_one_line(scene, tmp_path, monkeypatch, capsys):
    words = ["--cloud", str(scene / "cloud.ply"), "--pano", str(scene / "images"), "--quiet"]
    damaged = tmp_path / "scheduler.json"
    damaged.write_text("{}")
    monkeypatch.setattr(cluster, "TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent, socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
        closed.close()
        silent_port = silent.getsockname()[1]
        for address in (f"127.0.0.1:{silent_port}", f"tcp://127.0.0.1:{port}", "127.0.0.1:x", str(damaged)):
            assert localize.main([*words, "--dask", address]) == 3
            err = capsys.readouterr().err
            assert err.startswith(f"localize.py: --dask {address}: no scheduler answers there within")
            assert err.count("\n") == 1
    for more, message in (
        (["--jobs", "2"], "--jobs: not with --dask x"),
        (["--mask", "a.png"], "--mask a.png: wanted an absolute path"),
    ):
        assert localize.main([*words, "--dask", "x", *more]) == 2
        assert message in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert localize.main([*words, "--dask", "x"]) == 3
    err = capsys.readouterr().err
    assert "--dask: needs distributed" in err
    assert "pip install 'piccolo-localize[cluster]'" in err
