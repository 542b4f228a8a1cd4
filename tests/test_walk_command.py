"""A walk on the command line: what is written, how a stopped one goes on, and refusals."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import rooms
from batches import untimed
from walks import SEED, assert_right, list_frames, run_localize, write_walk

from piccolo.api.result_files import read_results
from piccolo.api.scan_walk import Walk
from piccolo.apps.export.formats import tum_lines
from piccolo.batch.jobs import steps_file
from piccolo.cli import localize
from piccolo.geometry.pose import Pose, carry, yaw_rotation
from piccolo.photo.panorama import picture
from piccolo.system.errors import InputError
from piccolo.system.jobs import memory
from research.synthetic.walk_frames import writing_video

TIER = "scene"


@pytest.fixture
def folder():
    return write_walk()


@pytest.fixture
def queries(folder):
    return list_frames(folder)


def test_a_walk_is_done_again_from_a_frame_that_was_missing_or_failed(queries, tmp_path, monkeypatch, capsys):
    late = tmp_path / "late.png"
    out = tmp_path / "a.jsonl"
    frames = [str(queries[0].image), str(late), str(queries[1].image)]
    command = ["--walk", "--pano", *frames, "--times", "order", "--out", str(out)]
    assert run_localize(*command) == 3
    assert "late.png" in capsys.readouterr().err
    assert [r.status for r in read_results([out])] == ["localized", "unreadable", "localized"]
    before = out.read_bytes()
    assert run_localize(*command) == 3
    assert out.read_bytes() == before  # nothing is left to do
    late.write_bytes(queries[2].image.read_bytes())
    with monkeypatch.context() as patched:
        patched.setattr(picture, "check_memory", _short_at(late))
        assert run_localize(*command) == 3
    results = read_results([out])
    assert [r.status for r in results] == ["localized", "failed", "localized"]
    assert "may be used" in results[1].error
    assert run_localize(*command, "--min-confidence", "0.7") == 3
    prepared = []
    prepare = Walk.prepare
    monkeypatch.setattr(Walk, "prepare", lambda self, *a: prepared.append(a[1]) or prepare(self, *a))
    assert run_localize(*command) == 0
    assert prepared == frames[1:]
    assert [r.status for r in read_results([out])] == ["localized"] * 3


def _short_at(path):

    def check(num_bytes, purpose, advice):
        memory.check_memory(1e15 if purpose.startswith(str(path)) else num_bytes, purpose, advice)

    return check


def test_odometry_leads_to_where_frames_without_a_view_end(queries, tmp_path, capsys):
    """The camera goes too far between frames to be tracked without; on the command line, too."""
    some = [queries[k] for k in (0, 5, 7)]
    moved = Pose(yaw_rotation(2.0), np.array([50.0, -3.0, 7.0]))
    odometry = [carry(q.pose, queries[0].pose, moved) for q in some]
    frames = [q.image for q in some]
    scan = rooms.scan(SEED)
    results = scan.localize_walk(frames, odometry=odometry, gravity="known")
    assert_right(results, some)
    assert [r.walk.how for r in results] == ["alone", "tracked", "tracked"]
    for name, few in (("odometry", odometry[:1]), ("times", [0.0])):
        with pytest.raises(InputError, match=rf"^`{name}`: found 1 of 3 frames, wanted one of each frame$"):
            scan.localize_walk(frames, **{name: few})
    lines = tum_lines([(f"{k}", pose) for k, pose in enumerate(odometry)], "optical")
    (tmp_path / "odometry.tum").write_text("\n".join(lines))
    out = tmp_path / "a.jsonl"
    words = ["--walk", "--pano", *map(str, frames), "--odometry", str(tmp_path / "odometry.tum")]
    assert run_localize(*words, "--out", str(out)) == 0
    assert [r.walk.how for r in read_results([out])] == ["alone", "tracked", "tracked"]
    before = out.read_bytes()
    assert run_localize(*words[:-2], "--out", str(out)) == 3  # the results are of another walk
    assert "use --overwrite to start again" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert run_localize(*words[:-2], "--out", str(out), "--overwrite") == 0


def test_odometry_has_the_clock_by_which_frames_are_named(queries, tmp_path):
    """As data sets of TUM: the trajectory begins before the walk; times in results count from its begin."""
    some = [queries[k] for k in (0, 5, 7)]
    clock = 1311868164.0
    frames = [tmp_path / f"{clock + q.time:.6f}.png" for q in some]
    for frame, query in zip(frames, some, strict=True):
        frame.write_bytes(query.image.read_bytes())
    moved = Pose(yaw_rotation(2.0), np.array([50.0, -3.0, 7.0]))
    odometry = [(q.time, carry(q.pose, queries[0].pose, moved)) for q in queries]
    odometry = [(-9.0, Pose(yaw_rotation(1.0), np.zeros(3))), *odometry]
    lines = tum_lines([(f"{clock + time:.6f}", pose) for time, pose in odometry], "optical")
    (tmp_path / "odometry.tum").write_text("\n".join(lines))
    words = ["--walk", "--pano", *map(str, frames), "--times", "names", "--max-speed", "9"]
    out = tmp_path / "a.jsonl"
    assert run_localize(*words, "--odometry", str(tmp_path / "odometry.tum"), "--out", str(out)) == 0
    results = read_results([out])
    assert_right(results, some)
    assert [r.walk.how for r in results] == ["alone", "tracked", "tracked"]
    assert [r.walk.time for r in results] == [0.0, 2.5, 3.5]


@pytest.mark.parametrize("place", ["1e30", "nan"])
def test_an_odometry_that_is_none_is_refused(queries, tmp_path, capsys, place):
    (tmp_path / "big.tum").write_text(f"0 {place} 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    frames = [str(q.image) for q in queries[:2]]
    assert run_localize("--walk", "--pano", *frames, "--odometry", str(tmp_path / "big.tum")) == 3
    err = capsys.readouterr().err
    assert "big.tum, 0: found a position" in err
    assert err.count("\n") == 1


def test_a_video_of_an_unknown_camera_is_refused_once(queries, tmp_path, capsys):
    """And the same command with a camera begins anew; a walk whose other frames can be read goes on."""
    with writing_video(tmp_path / "a.mp4", 4.0, (320, 180)) as add:
        for k in range(24):
            add(np.full((180, 320, 3), 20 + 9 * k, np.uint8))
    out = tmp_path / "a.jsonl"
    words = ["--video", str(tmp_path / "a.mp4"), "--out", str(out)]
    assert run_localize(*words) == 3
    err = capsys.readouterr().err
    assert err.count("found a picture of 320 x 180") == err.count("\n") == 1
    assert "the other 11 frames seem no better" in err
    assert not out.exists()
    assert not steps_file(out).exists()
    frames = [tmp_path / f"{k}.png" for k in range(5)]
    for frame in frames[:-1]:
        cv2.imwrite(str(frame), np.zeros((24, 32, 3), np.uint8))
    frames[-1].write_bytes(queries[0].image.read_bytes())
    assert run_localize("--walk", "--pano", *map(str, frames), "--out", str(out)) == 3
    assert [r.status for r in read_results([out])] == ["unreadable"] * 4 + ["localized"]


def _times(folder, queries):
    lines = ["name,time", *(f"{q.image.name},{q.time + 100.0}" for q in queries)]
    (folder / "times.csv").write_text("\n".join(lines))
    return str(folder / "times.csv")


def test_a_walk_that_was_stopped_goes_on_where_it_stood(folder, queries, tmp_path, monkeypatch, capsys):
    walk = ["--walk", "--pano", str(folder / "images"), "--times", _times(folder, queries), "--out"]
    whole = tmp_path / "whole.jsonl"
    stopped = tmp_path / "stopped.jsonl"
    assert run_localize(*walk, str(whole)) == 0
    assert_right(read_results([whole]), queries)
    assert not steps_file(whole).exists()

    def killed(self, show):
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(Walk, "finish", killed)
        assert run_localize(*walk, str(stopped)) != 0
    kept = steps_file(stopped)
    lines = kept.read_bytes().splitlines(keepends=True)
    assert len(lines) == 1 + len(queries)
    step = json.loads(lines[1])[0]
    kept.write_bytes(lines[0] + json.dumps([step, '{"blank": 3}']).encode() + b"\n")
    assert run_localize(*walk, str(stopped)) == 3
    assert f"{kept}: found a damaged line (ValidationError)" in capsys.readouterr().err
    kept.write_bytes(b"".join(lines[:-2]) + lines[-2][:30])
    added = []
    prepare = Walk.prepare
    monkeypatch.setattr(Walk, "prepare", lambda self, *a: added.append(a[1]) or prepare(self, *a))
    assert run_localize(*walk, str(stopped)) == 0
    assert added == [str(q.image) for q in queries[-2:]]
    assert untimed(stopped) == untimed(whole)
    assert run_localize(*walk, str(stopped)) == 0
    assert len(added) == 2


def test_a_video_is_a_walk(folder, queries, tmp_path):
    """A frame every second, named by its time."""
    video = folder / "walk.mp4"
    out = tmp_path / "video.jsonl"
    assert run_localize("--video", str(video), "--every", "1", "--out", str(out)) == 0
    results = read_results([out])
    assert_right(results, queries[: 2 * len(results) : 2])
    assert [r.pano for r in results] == [f"{video}#t={k}.000" for k in range(len(results))]
    assert len(results) == (len(queries) + 1) // 2


def test_chapters_are_one_walk_and_a_time_lapse_says_what_it_needs(folder, queries, tmp_path, capsys):
    """Of a time lapse the second frame is farther than a person walks in a tenth of a second."""
    for name, taken in (("1.mp4", queries[0]), ("2.mp4", queries[-1])):
        with writing_video(tmp_path / name, 10.0, (rooms.WIDTH, rooms.WIDTH // 2)) as add:
            add(cv2.imread(str(taken.image))[..., ::-1])
    out = tmp_path / "out.jsonl"
    words = [
        "--cloud",
        str(rooms.map_path(SEED)),
        "--gravity",
        "known",
        "--video",
        *(str(tmp_path / name) for name in ("1.mp4", "2.mp4")),
        "--out",
        str(out),
    ]
    assert localize.main([*words]) == 1
    (speed,) = re.findall(
        r"2.mp4#t=0.000: alone it is localized 1.6 m from .* --max-speed (\d+)\n", capsys.readouterr().err
    )
    assert localize.main([*words, "--overwrite", "--max-speed", speed]) == 0
    assert "time lapse" not in capsys.readouterr().err
    results = read_results([out])
    assert_right(results, [queries[0], queries[-1]])
    assert [r.walk.time for r in results] == [0.0, 0.1]
    assert [r.pano for r in results] == [f"{word}#t=0.000" for word in words[5:7]]


REFUSED = [
    ("--video a.mp4 b.mp4 a.mp4", 3, "a.mp4: found it twice, wanted each chapter once"),
    ("--video a.mp4 --pano a.jpg", 2, "wanted --walk with --pano, or --video"),
    ("--walk", 2, "wanted --walk with --pano, or --video alone"),
    ("", 2, "the following arguments are required: --pano"),
    ("--walk --pano -", 2, "--walk: found names on stdin, wanted files or folders"),
    ("--pano a.jpg --max-speed 2", 2, "--max-speed: only with --walk or --video"),
    ("--walk --pano a.jpg --max-speed 0", 2, "--max-speed: found 0.0, wanted"),
    ("--pano a.jpg --every 1", 2, "--every: only with --video"),
    ("--walk --pano a.jpg --every 1", 2, "--every: only with --video"),
    ("--video a.mp4 --every nan", 2, "--every: found nan, wanted at least 0.01"),
    ("--walk --pano a.jpg --jobs 2", 2, "--jobs: not with a walk"),
    ("--video a.mp4 --times order", 2, "--times: not with a video"),
    ("--walk --pano a.jpg --preset paper", 2, "not an option of the preset paper"),
    ("--pano a.jpg --odometry a.tum", 2, "--odometry: only with --walk"),
    ("--walk --pano a.jpg --times order --odometry none.tum", 3, "none.tum: cannot be read (No such file or"),
    ("--walk --pano a.jpg --times none.csv", 3, "none.csv"),
    ("--video none.mp4", 3, "none.mp4: no such file, wanted a video that PyAV reads"),
    ("--video broken.mp4", 3, "wanted a video that PyAV reads, such as MP4"),
]


@pytest.mark.parametrize(("words", "code", "text"), REFUSED)
def test_wrong_words_are_one_line(words, code, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("broken.mp4").write_bytes(b"no video" * 100)
    assert run_localize(*words.split()) == code
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1 or code == 2
