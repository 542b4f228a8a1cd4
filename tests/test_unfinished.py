"""A preparation that was killed goes on where it stood, and what it left is trusted only if it is whole."""

import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rooms

from piccolo.cli import prepare_map as prepare_command
from piccolo.cli import progress
from piccolo.cloud.settings import CloudSettings
from piccolo.coarse_to_fine.map_file import load_map
from piccolo.coarse_to_fine.open_map import CachePolicy, open_map
from piccolo.coarse_to_fine.scan_map import with_features
from piccolo.runtime import unfinished
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers
from piccolo.runtime.unfinished import NAME, Unfinished

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where parts are kept, each item at once."""
    (tmp_path / "parts").mkdir(0o700)
    monkeypatch.setattr(unfinished, "parts_folder", lambda: tmp_path / "parts")
    monkeypatch.setattr(unfinished, "EVERY_S", 0.0)
    return tmp_path / "parts"


def _squares(calls, stop=None):
    """Of a number its square in two forms; at one the process is killed."""

    def square(k):
        if k == stop:
            raise KeyboardInterrupt
        calls.append(k)
        return np.array([k * k]), np.array([[k], [-k]], np.int8)

    return square


def _collected(work, calls, stop=None, label="square", about=()):
    return Workers(1, work=work).collect(_squares(calls, stop), range(6), label, *about)


def test_what_is_done_is_not_done_again(folder):
    calls = []
    with pytest.raises(KeyboardInterrupt):
        _collected(Unfinished("a"), calls, stop=4)
    assert len(list(folder.iterdir())) == 4
    assert all(NAME.fullmatch(path.name) for path in folder.iterdir())
    found = _collected(Unfinished("a"), calls)
    assert calls == [0, 1, 2, 3, 4, 5]
    for got, expected in zip(found, _collected(None, []), strict=True):
        for own, other in zip(got, expected, strict=True):
            assert own.dtype == other.dtype
            np.testing.assert_array_equal(own, other)
    work = Unfinished("a")
    work.finish()  # nothing was begun
    assert len(list(folder.iterdir())) == 6
    _collected(Unfinished("b"), [])
    _collected(work, calls)
    work.finish()
    assert len(calls) == 6
    assert len(list(folder.iterdir())) == 6  # of another work


@pytest.mark.parametrize("other", ["key", "label", "arrays", "no key"])
def test_parts_of_other_work_are_not_taken(folder, other):
    _collected(Unfinished("a"), [], about=(np.arange(3),))
    key, label = {"key": "b", "no key": ""}.get(other, "a"), "cube" if other == "label" else "square"
    calls = []
    _collected(Unfinished(key), calls, label=label, about=(np.arange(4 if other == "arrays" else 3),))
    assert calls == list(range(6))


@pytest.mark.parametrize("damage", ["cut", "flipped", "renamed", "empty", "gone", "unreadable"])
def test_damaged_parts_are_made_anew(folder, damage):
    _collected(Unfinished("a"), [])
    paths = sorted(folder.iterdir(), key=lambda path: int(path.stem.rsplit("-", 1)[1]))
    content = paths[2].read_bytes()
    if damage == "flipped":
        content = content[:-3] + bytes([content[-3] ^ 1]) + content[-2:]
    elif damage == "renamed":
        content = paths[3].read_bytes()
    elif damage == "cut":
        content = content[:-1]
    paths[2].write_bytes(b"" if damage == "empty" else content)
    if damage in ("gone", "unreadable"):
        paths[2].unlink()
    if damage == "unreadable":
        paths[2].mkdir()
    calls = []
    found = _collected(Unfinished("a"), calls)
    assert calls == [2, 3, 4, 5]
    assert [int(square[0]) for square, _ in found] == [0, 1, 4, 9, 16, 25]


def test_parts_are_written_every_few_seconds_only(folder, monkeypatch):
    monkeypatch.setattr(unfinished, "EVERY_S", 5.0)
    clock = iter(np.arange(0.0, 1000.0, 2.0))  # two looks at it an item, three where a part is written
    monkeypatch.setattr(unfinished.time, "monotonic", lambda: next(clock))
    _collected(Unfinished("a"), [])
    assert 1 <= len(list(folder.iterdir())) <= 3


def test_a_map_is_the_same_with_parts_of_every_stage(folder, tmp_path, monkeypatch):
    """Killed in each stage in turn: each time the stages before are not done again."""
    room = rooms.write_room(tmp_path / "room", "--seed 3 --points 30000 --panoramas 1 --width 512")
    stages = []

    def prepared(stop=None, cache=None):
        stages.clear()

        def show(values, total, label):
            stages.append((label, total))
            if label == stop:
                raise KeyboardInterrupt
            return values

        workers = Workers(2, show)
        policy = CachePolicy(cache is not None, cache)
        found = open_map([room / "cloud.ply"], CloudSettings(up="z"), policy, workers, Stopwatch())
        return with_features(found, workers)

    whole = prepared()
    assert not list(folder.iterdir())
    labels = ["read cloud.ply", "find free space", "render views", "find features", "sort features"]
    assert list(dict.fromkeys(label for label, _ in stages)) == labels
    for before, stop in pairwise(labels):
        with pytest.raises(KeyboardInterrupt):
            prepared(stop, tmp_path / "cache")
        assert {label for label, total in stages if total != 0} == {before, stop}
    again = prepared(None, tmp_path / "cache")
    assert {label for label, total in stages if total != 0} == {"sort features"}
    assert not list(folder.iterdir())
    for name in ("centers", "sparse", "wide_features", "wide_seen", "warnings"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
    for own, other in zip(
        (*again.octree, *again.local_features), (*whole.octree, *whole.local_features), strict=True
    ):
        np.testing.assert_array_equal(own, other)
    prepared(None, tmp_path / "cache")
    assert stages == []


KILLED = """
import sys
from pathlib import Path
from piccolo.runtime import unfinished
folder = Path(sys.argv.pop(1))
unfinished.EVERY_S, unfinished.parts_folder = 0.0, lambda: folder
from piccolo.cli.prepare_map import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_killed_command_goes_on_and_leaves_nothing(folder, tmp_path, number):
    room = rooms.write_room(tmp_path / "room", "--seed 3 --points 30000 --panoramas 1 --width 512")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    out = tmp_path / "a.map"
    command = ["--cloud", str(room / "cloud.ply"), "--out", str(out), "--name", str(number)]
    killed = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(folder), *command], env=env, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120.0
    while len(list(folder.glob("*.part"))) < 12 and killed.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    killed.send_signal(number)
    assert killed.wait(60) in (-signal.SIGKILL, 130, 143)
    assert not out.exists()
    assert len(list(folder.glob("*.part"))) >= 12
    assert prepare_command.main([*command, "--quiet"]) == 0
    assert list(folder.iterdir()) == []
    resumed = out.read_bytes()
    out.unlink()
    assert prepare_command.main([*command, "--quiet"]) == 0
    assert out.read_bytes() == resumed
    assert load_map(out).scan_names == (str(number),)


def test_progress_says_step_and_time_left(capsys, monkeypatch):
    monkeypatch.setattr(progress, "DELAY", 0.0)
    show = progress.progress_bar(is_quiet=False)
    for label, title in (("find features", "prepare, 3 of 4: find features: "), ("write", "write: ")):
        shown = show(iter([1, 2]), 2, label)
        next(shown)
        time.sleep(0.2)
        next(shown)
        assert list(shown) == []
        printed = capsys.readouterr().err
        assert title in printed
        assert " left" in printed
    assert list(show(iter([1]), None, "read")) == [1]
    assert "read: 0 in 00:00" in capsys.readouterr().err
