"""One frame, when it is known about where the camera was."""

import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, exp_so3, pose_errors
from piccolo.jobs.threads import Workers
from piccolo.localization.comparison import score_pose
from piccolo.localization.query import prepare_query
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.walk import tracker as tracker_module
from piccolo.walk.frames import Motion, State
from piccolo.walk.tracker import (
    Follower,
    find_everywhere,
    find_near,
    follow,
    predict,
    track,
    track_on,
)

SEED = 1


@pytest.fixture(scope="module")
def seen():
    """A frame's query in the map of a room, and its true pose there."""
    taken, scan_map = rooms.query(SEED), rooms.scan_map(SEED)
    query = prepare_query(rooms.as_panorama(taken.rgb), scan_map, CoarseToFineSettings(), Workers(2))
    return query, rooms.local(SEED, taken.pose)


def _off(pose, metres, degrees):
    """A pose so far from another."""
    turn = exp_so3(np.radians(degrees) * np.array([0.0, 0.0, 1.0]))
    return Pose(turn @ pose.R_cam_from_world, pose.center_world + metres * np.array([0.8, 0.6, 0.0]))


def test_a_descent_that_stopped_short_goes_on_farther_around(seen):
    query, true = seen
    short = score_pose(query, _off(true, 0.12, 2.5))
    end = track_on(query, short)
    assert end.score > 1.2 * short.score
    assert pose_errors(end.pose, true)[0] < 0.02
    best = track(query, true, 0.2)
    assert track_on(query, best).score >= best.score


def test_a_frame_that_explains_less_than_the_one_before_is_looked_for_farther_around(seen, monkeypatch):
    query, true = seen
    asked = []
    monkeypatch.setattr(tracker_module, "track_on", lambda query, end: asked.append(end) or end)
    best = track(query, true, 0.2)
    for usual, num_asked in ((1.0, 0), (1.05, 0), (1.3, 1), (2.0, 0)):  # as much; a little less; less; lost
        asked.clear()
        before = State(true, 5.0, usual * best.score)
        follow(query, Follower(before, 0.0, None, 0.0), 0.5, Motion())
        assert len(asked) == num_asked, usual
    follow(query, Follower(State(true, 5.0, best.score), 0.0, None, 0.0), 1.0, Motion())  # farther away
    assert len(asked) == 1


def test_a_frame_is_found_near_and_everywhere(seen):
    query, true = seen
    for found in (find_near(query, _off(true, 0.8, 40.0), 1.5, 0.3), find_everywhere(query, 0.3)):
        assert pose_errors(max(found, key=lambda h: h.score).pose, true)[0] < 0.02
    assert find_near(query, _off(true, 50.0, 0.0), 1.0, 0.3) == []
    assert find_everywhere(query, 2.0) == []


def test_a_camera_goes_on_as_it_went_but_no_farther_than_it_can(seen):
    _, true = seen
    ahead = predict(true, _off(true, -0.4, -10.0), 0.5, 9.0)
    distance, angle = pose_errors(ahead, _off(true, 0.2, 5.0))
    assert (distance, np.degrees(angle)) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert np.linalg.norm(
        predict(true, _off(true, -4.0, 0.0), 1.0, 0.5).center_world - true.center_world
    ) == (pytest.approx(0.5))
