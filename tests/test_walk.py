"""A walk through a room, in Python and on the command line."""

import json
import re
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import rooms
from batches import untimed

import piccolo
from piccolo.batch.jobs import steps_file
from piccolo.cli import localize as localize_command
from piccolo.errors import InputError
from piccolo.export.formats import tum_lines
from piccolo.geometry.pose import Pose, carry, pose_errors, yaw_rotation
from piccolo.jobs import memory
from piccolo.jobs.threads import Workers
from piccolo.judge.result import nothing_found
from piccolo.panorama import picture
from piccolo.photo import Photo
from piccolo.result_files import read_results
from piccolo.scan_walk import Walk
from piccolo.together.walk import tracker as tracker_module
from research.synthetic.walk_frames import writing_video
from research.synthetic.world import free_position, photograph

NUM_FRAMES, STEP_S = 8, 0.5


class Taken(NamedTuple):
    image: Path
    pose: Pose
    time: float


def _walk_through(world):
    """Poses from one free place of a room to the farthest of some others, turning a little."""
    rng, room = np.random.default_rng(4), world.rooms[0]
    start, *others = (free_position(room, rng, (1.4, 1.5)) for _ in range(12))
    end = max(others, key=lambda place: np.linalg.norm(place - start))
    end = start + (end - start) / np.linalg.norm(end - start) * 1.6
    shares = np.linspace(0.0, 1.0, NUM_FRAMES)
    return [Pose(yaw_rotation(0.3 + 0.8 * s), start + s * (end - start)) for s in shares]


@pytest.fixture(scope="module")
def building(tmp_path_factory):
    """A scan of a room, frames and a video of a walk through it; the folder, and the frames."""
    folder = tmp_path_factory.mktemp("walk") / "a b"
    (folder / "images").mkdir(parents=True)
    world = rooms.room(3)[0]
    frames = []
    with writing_video(folder / "walk.mp4", 1 / STEP_S, (rooms.WIDTH, rooms.WIDTH // 2)) as add:
        for k, pose in enumerate(_walk_through(world)):
            rgb = photograph(world.rooms[0], pose, rooms.WIDTH, Workers(2))
            path = folder / "images" / f"{k:02}.png"
            cv2.imwrite(str(path), rgb[..., ::-1])
            add(rgb)
            frames.append(Taken(path, pose, STEP_S * k))
    return folder, frames


@pytest.fixture
def queries(building):
    return building[1]


@pytest.fixture
def scan():
    return rooms.scan(3)


def _assert_right(results, queries):
    assert [result.status for result in results] == ["localized"] * len(queries)
    errors = [pose_errors(r.pose, q.pose) for r, q in zip(results, queries, strict=True)]
    assert max(distance for distance, _ in errors) < 0.03
    assert np.degrees(max(angle for _, angle in errors)) < 0.5


def test_a_walk_with_bad_frames_between_keeps_within_a_prior(scan, queries):
    frames = [cv2.imread(str(q.image))[..., ::-1].copy() for q in queries]
    noise = np.random.default_rng(0).integers(0, 255, frames[0].shape, dtype=np.uint8)
    frames[3], frames[4] = np.ascontiguousarray(frames[3][:, ::-1]), noise
    x, y, z = np.mean([q.pose.center_world for q in queries], axis=0)
    prior = piccolo.Prior(near=(x, y, z), radius=2.0)
    results = scan.localize_walk(frames, times=[q.time for q in queries], gravity="known", prior=prior)
    bad = {3, 4}
    assert all(results[k].status != "localized" for k in bad)
    good = [k for k in range(len(queries)) if k not in bad]
    _assert_right([results[k] for k in good], [queries[k] for k in good])
    assert [result.walk.frame for result in results] == list(range(len(queries)))
    assert [result.walk.time for result in results] == [q.time for q in queries]
    assert results[0].walk.how == "alone"
    assert results[0].walk.alone.status == "localized"
    assert {results[k].walk.how for k in good[1:]} <= {"tracked", "near"}
    assert all(result.walk.gap is None for result in results)
    assert all(results[k].covariance is not None for k in good)
    assert piccolo.Result.from_json(results[0].to_json()).to_json() == results[0].to_json()


def test_a_walk_is_done_again_from_a_frame_that_was_missing_or_failed(queries, tmp_path, monkeypatch, capsys):
    late, out = tmp_path / "late.png", tmp_path / "a.jsonl"
    frames = [str(queries[0].image), str(late), str(queries[1].image)]
    command = ["--walk", "--pano", *frames, "--times", "order", "--out", str(out)]
    assert _command(*command) == 3
    assert "late.png" in capsys.readouterr().err
    assert [r.status for r in read_results([out])] == ["localized", "unreadable", "localized"]
    before = out.read_bytes()
    assert _command(*command) == 3
    assert out.read_bytes() == before  # nothing is left to do
    late.write_bytes(queries[2].image.read_bytes())
    with monkeypatch.context() as patched:
        patched.setattr(picture, "check_memory", _short_at(late))
        assert _command(*command) == 3
    results = read_results([out])
    assert [r.status for r in results] == ["localized", "failed", "localized"]
    assert "may be used" in results[1].error
    assert _command(*command, "--min-confidence", "0.7") == 3
    prepared, prepare = [], Walk.prepare
    monkeypatch.setattr(Walk, "prepare", lambda self, *a: prepared.append(a[1]) or prepare(self, *a))
    assert _command(*command) == 0
    assert prepared == frames[1:]
    assert [r.status for r in read_results([out])] == ["localized"] * 3


def _short_at(path):

    def check(num_bytes, purpose, advice):
        memory.check_memory(1e15 if purpose.startswith(str(path)) else num_bytes, purpose, advice)

    return check


def test_photos_in_any_order_are_each_searched_in_the_whole_scan(scan, queries):
    some = [queries[k] for k in (5, 0, 7, 2)]
    results = scan.localize_walk([q.image for q in some], gravity="known")
    _assert_right(results, some)
    assert [(r.walk.how, r.walk.alone.status) for r in results] == [("alone", "localized")] * 4
    motion = results[0].settings["walk"]
    assert (motion["max_speed"], motion["is_timed"]) == (5.0, False)


def test_a_camera_is_searched_everywhere_as_soon_as_it_may_be_elsewhere(scan, queries, tmp_path, monkeypatch):
    """The first frame can't be read; the second is searched, and as it is lost, again 2.3 m and 6.3 m on."""
    localize = tracker_module.localize
    monkeypatch.setattr(tracker_module, "localize", lambda *_: nothing_found())
    walk = scan.track(motion=piccolo.Motion(max_speed=1.0), gravity="known")
    walk.add(tmp_path / "missing.jpg", 0.0)
    noise = np.random.default_rng(1).integers(0, 255, (256, 512, 3), dtype=np.uint8)
    searched = [walk.add(noise, time).walk.alone is not None for time in range(1, 10)]
    assert searched == [k in (1, 4, 8) for k in range(1, 10)]
    monkeypatch.setattr(tracker_module, "localize", localize)
    assert walk.add(queries[0].image, 14.0).status == "localized"


def test_live_results_need_no_times_and_after_some_way_a_frame_is_compared_with_all_places(
    scan, queries, monkeypatch
):
    monkeypatch.setattr(tracker_module, "BETWEEN_KEYS", 0.4)  # [m] the camera goes 0.23 at a time
    walk = scan.track(motion=piccolo.Motion(max_speed=0.3), gravity="known")
    live = [walk.add(q.image) for q in queries]
    _assert_right(live, queries)
    assert [result.walk.time for result in live] == [float(k) for k in range(len(queries))]
    assert live[1].pano == str(queries[1].image)
    assert live[1].source.pano_sha256 is not None
    assert [frame.is_key for frame in walk.tracker.frames] == [k % 2 == 0 for k in range(NUM_FRAMES)]
    assert min(len(frame.states) for frame in walk.tracker.frames[::2]) > 1
    results = walk.finish()
    _assert_right(results, queries)
    assert results[0].walk.alone is not None
    assert all(r.walk.alone is None for r in results[1:])


def test_a_key_frame_that_nobody_departs_from_is_followed_from_where_it_was_tracked_to(scan, queries):
    """As narrow photos in a corridor: a frame was tracked, then compared with the map, and not believed."""
    walk = scan.track(gravity="known")
    for query in queries[:3]:
        walk.add(query.image, query.time)
    last = walk.tracker.frames[-1]
    last.is_key = True
    last.departed = None
    result = walk.add(queries[3].image, queries[3].time)
    assert result.walk.how == "tracked"
    assert pose_errors(result.pose, queries[3].pose)[0] < 0.03


def test_odometry_leads_to_where_frames_without_a_view_end(scan, queries, tmp_path, capsys):
    """The camera goes too far between frames to be tracked without; on the command line, too."""
    some = [queries[k] for k in (0, 5, 7)]
    moved = Pose(yaw_rotation(2.0), np.array([50.0, -3.0, 7.0]))
    odometry = [carry(q.pose, queries[0].pose, moved) for q in some]
    frames = [q.image for q in some]
    results = scan.localize_walk(frames, odometry=odometry, gravity="known")
    _assert_right(results, some)
    assert [r.walk.how for r in results] == ["alone", "tracked", "tracked"]
    for name, few in (("odometry", odometry[:1]), ("times", [0.0])):
        with pytest.raises(InputError, match=rf"^`{name}`: found 1 of 3 frames, wanted one of each frame$"):
            scan.localize_walk(frames, **{name: few})
    lines = tum_lines([(f"{k}", pose) for k, pose in enumerate(odometry)], "optical")
    (tmp_path / "odometry.tum").write_text("\n".join(lines))
    out = tmp_path / "a.jsonl"
    words = ["--walk", "--pano", *map(str, frames), "--odometry", str(tmp_path / "odometry.tum")]
    assert _command(*words, "--out", str(out)) == 0
    assert [r.walk.how for r in read_results([out])] == ["alone", "tracked", "tracked"]
    before = out.read_bytes()
    assert _command(*words[:-2], "--out", str(out)) == 3  # the results are of another walk
    assert "use --overwrite to start again" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert _command(*words[:-2], "--out", str(out), "--overwrite") == 0


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
    assert _command(*words, "--odometry", str(tmp_path / "odometry.tum"), "--out", str(out)) == 0
    results = read_results([out])
    _assert_right(results, some)
    assert [r.walk.how for r in results] == ["alone", "tracked", "tracked"]
    assert [r.walk.time for r in results] == [0.0, 2.5, 3.5]


@pytest.mark.parametrize("place", ["1e30", "nan"])
def test_an_odometry_that_is_none_is_refused(queries, tmp_path, capsys, place):
    (tmp_path / "big.tum").write_text(f"0 {place} 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    frames = [str(q.image) for q in queries[:2]]
    assert _command("--walk", "--pano", *frames, "--odometry", str(tmp_path / "big.tum")) == 3
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
    assert _command(*words) == 3
    err = capsys.readouterr().err
    assert err.count("found a picture of 320 x 180") == err.count("\n") == 1
    assert "the other 11 frames seem no better" in err
    assert not out.exists()
    assert not steps_file(out).exists()
    frames = [tmp_path / f"{k}.png" for k in range(5)]
    for frame in frames[:-1]:
        cv2.imwrite(str(frame), np.zeros((24, 32, 3), np.uint8))
    frames[-1].write_bytes(queries[0].image.read_bytes())
    assert _command("--walk", "--pano", *map(str, frames), "--out", str(out)) == 3
    assert [r.status for r in read_results([out])] == ["unreadable"] * 4 + ["localized"]


def _command(*words):
    cloud = ["--cloud", str(rooms.map_path(3)), "--gravity", "known", "--quiet"]
    return localize_command.main([*cloud, *words])


def _times(folder, queries):
    lines = ["name,time", *(f"{q.image.name},{q.time + 100.0}" for q in queries)]
    (folder / "times.csv").write_text("\n".join(lines))
    return str(folder / "times.csv")


def test_a_walk_that_was_stopped_goes_on_where_it_stood(building, tmp_path, monkeypatch, capsys):
    folder, queries = building
    walk = ["--walk", "--pano", str(folder / "images"), "--times", _times(folder, queries), "--out"]
    whole, stopped = tmp_path / "whole.jsonl", tmp_path / "stopped.jsonl"
    assert _command(*walk, str(whole)) == 0
    _assert_right(read_results([whole]), queries)
    assert not steps_file(whole).exists()

    def killed(self, show):
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(Walk, "finish", killed)
        assert _command(*walk, str(stopped)) != 0
    kept = steps_file(stopped)
    lines = kept.read_bytes().splitlines(keepends=True)
    assert len(lines) == 1 + len(queries)
    step = json.loads(lines[1])[0]
    kept.write_bytes(lines[0] + json.dumps([step, '{"blank": 3}']).encode() + b"\n")
    assert _command(*walk, str(stopped)) == 3
    assert f"{kept}: found a damaged line (ValidationError)" in capsys.readouterr().err
    kept.write_bytes(b"".join(lines[:-2]) + lines[-2][:30])
    added = []
    prepare = Walk.prepare
    monkeypatch.setattr(Walk, "prepare", lambda self, *a: added.append(a[1]) or prepare(self, *a))
    assert _command(*walk, str(stopped)) == 0
    assert added == [str(q.image) for q in queries[-2:]]
    assert untimed(stopped) == untimed(whole)
    assert _command(*walk, str(stopped)) == 0
    assert len(added) == 2


def test_frames_come_back_from_their_lines(scan, building):
    walk = scan.track(gravity="known")
    again = scan.track(gravity="known")
    for k, query in enumerate(building[1][:3]):
        path = query.image if k != 1 else building[0] / "walk.mp4"  # no picture
        walk.add(path, query.time, "name", query.pose)
        text = walk.last_to_json()
        again.restore(text, Photo(path))
        assert again.last_to_json() == text
    assert again.blanks[1].error == walk.blanks[1].error is not None


@pytest.mark.parametrize("shown", [0.33, 1.0])
def test_a_walk_goes_on_with_the_same_bits(queries, tmp_path, shown):
    """Narrow frames are matched with those before, which are read again; with any number of threads."""
    is_hidden = abs(np.linspace(-1.0, 1.0, rooms.WIDTH)) > shown
    cv2.imwrite(str(tmp_path / "mask.png"), np.uint8(255) * np.tile(is_hidden, (rooms.WIDTH // 2, 1)))
    ends, lines = [], []
    for num_threads, num_kept in ((2, 0), (1, 2)):
        walk = rooms.scan(3, num_threads).track(gravity="known")
        for k, query in enumerate(queries[:4]):
            photo = Photo(query.image, mask=tmp_path / "mask.png")
            if k < num_kept:
                walk.restore(lines[k], photo)
            else:
                walk.add(photo, query.time, query.image.name)
            lines.append(walk.last_to_json())
        ends.append([{**json.loads(result.to_json()), "seconds": None} for result in walk.finish()])
    assert ends[0] == ends[1]
    assert [(end["status"], end["walk"]["how"]) for end in ends[0]].count(("localized", "tracked")) >= 2


def test_a_video_is_a_walk(building, tmp_path):
    """A frame every second, named by its time."""
    folder, queries = building
    video = folder / "walk.mp4"
    out = tmp_path / "video.jsonl"
    assert _command("--video", str(video), "--every", "1", "--out", str(out)) == 0
    results = read_results([out])
    _assert_right(results, queries[: 2 * len(results) : 2])
    assert [r.pano for r in results] == [f"{video}#t={k}.000" for k in range(len(results))]
    assert len(results) == (len(queries) + 1) // 2


def test_chapters_are_one_walk_and_a_time_lapse_says_what_it_needs(building, tmp_path, capsys):
    """Of a time lapse the second frame is farther than a person walks in a tenth of a second."""
    _, queries = building
    for name, taken in (("1.mp4", queries[0]), ("2.mp4", queries[-1])):
        with writing_video(tmp_path / name, 10.0, (rooms.WIDTH, rooms.WIDTH // 2)) as add:
            add(cv2.imread(str(taken.image))[..., ::-1])
    out = tmp_path / "out.jsonl"
    words = [
        "--cloud",
        str(rooms.map_path(3)),
        "--gravity",
        "known",
        "--video",
        *(str(tmp_path / name) for name in ("1.mp4", "2.mp4")),
        "--out",
        str(out),
    ]
    assert localize_command.main([*words]) == 1
    (speed,) = re.findall(
        r"2.mp4#t=0.000: alone it is localized 1.6 m from .* --max-speed (\d+)\n", capsys.readouterr().err
    )
    assert localize_command.main([*words, "--overwrite", "--max-speed", speed]) == 0
    assert "time lapse" not in capsys.readouterr().err
    results = read_results([out])
    _assert_right(results, [queries[0], queries[-1]])
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
    assert _command(*words.split()) == code
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1 or code == 2
