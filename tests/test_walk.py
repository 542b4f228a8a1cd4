"""A walk through a room, in Python."""

import json

import cv2
import numpy as np
import pytest
import rooms
from walks import NUM_FRAMES, SEED, assert_right, list_frames, write_walk

import piccolo
from piccolo.geometry.pose import pose_errors
from piccolo.judge.result import nothing_found
from piccolo.photo.photo import Photo
from piccolo.together.walk import tracker as tracker_module

TIER = "scene"


@pytest.fixture
def folder():
    return write_walk()


@pytest.fixture
def queries(folder):
    return list_frames(folder)


@pytest.fixture
def scan():
    return rooms.scan(SEED)


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
    assert_right([results[k] for k in good], [queries[k] for k in good])
    assert [result.walk.frame for result in results] == list(range(len(queries)))
    assert [result.walk.time for result in results] == [q.time for q in queries]
    assert results[0].walk.how == "alone"
    assert results[0].walk.alone.status == "localized"
    assert {results[k].walk.how for k in good[1:]} <= {"tracked", "near"}
    assert all(result.walk.gap is None for result in results)
    assert all(results[k].covariance is not None for k in good)
    assert piccolo.Result.from_json(results[0].to_json()).to_json() == results[0].to_json()


def test_photos_in_any_order_are_each_searched_in_the_whole_scan(scan, queries):
    some = [queries[k] for k in (5, 0, 7, 2)]
    results = scan.localize_walk([q.image for q in some], gravity="known")
    assert_right(results, some)
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
    assert_right(live, queries)
    assert [result.walk.time for result in live] == [float(k) for k in range(len(queries))]
    assert live[1].pano == str(queries[1].image)
    assert live[1].source.pano_sha256 is not None
    assert [frame.is_key for frame in walk.tracker.frames] == [k % 2 == 0 for k in range(NUM_FRAMES)]
    assert min(len(frame.states) for frame in walk.tracker.frames[::2]) > 1
    results = walk.finish()
    assert_right(results, queries)
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


def test_frames_come_back_from_their_lines(scan, folder, queries):
    walk = scan.track(gravity="known")
    again = scan.track(gravity="known")
    for k, query in enumerate(queries[:3]):
        path = query.image if k != 1 else folder / "walk.mp4"  # no picture
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
    near = piccolo.Prior(near=tuple(queries[1].pose.center_world), radius=0.7)
    ends, lines = [], []
    for num_threads, num_kept in ((2, 0), (1, 2)):
        walk = rooms.scan(SEED, num_threads).track(gravity="known", prior=near)
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
