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
from piccolo.walk.frames import State
from piccolo.walk.motion import Motion
from piccolo.walk.places import find_places, is_mirror_image, is_mirrored
from piccolo.walk.tracker import (
    Follower,
    find_near,
    follow,
    predict,
    refine_state,
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
        follow(query, Follower(true, usual * best.score, 0.0), 0.5, Motion())
        assert len(asked) == num_asked, usual


def test_a_frame_is_found_near_if_it_scores_as_the_one_before(seen):
    query, true = seen
    near = Follower(_off(true, 0.8, 40.0), 0.3, 0.0)
    found = find_near(query, near, 1.0, Motion())
    assert pose_errors(found[0].pose, true)[0] < 0.02
    assert find_near(query, near._replace(score=3.0), 1.0, Motion()) == []
    assert find_near(query, near, 10.0, Motion()) == []  # too far to look around
    assert find_near(query, Follower(_off(true, 50.0, 0.0), 0.3, 0.0), 1.0, Motion()) == []


def test_the_places_that_look_like_a_photo(seen):
    """Its own is the best, in a heading that was not asked; others in the room are behind."""
    query, true = seen
    places = find_places(query, true)
    assert pose_errors(places[0].pose, true)[0] < 0.1
    assert max(place.behind for place in places[1:]) < places[0].behind <= 0.0
    off = _off(true, 1.0, 90.0)
    assert find_places(query, off)[0].behind == 0.0  # what explains more than the pose given
    assert pose_errors(find_places(query, off)[0].pose, true)[0] < 0.1


def test_a_mirrored_photo_is_told_near_a_pose_and_anywhere(seen):
    query, true = seen
    assert not is_mirrored(query, true)
    assert not is_mirror_image(query)
    taken = rooms.query(SEED)
    rgb = np.ascontiguousarray(taken.rgb[:, ::-1])
    mirrored = prepare_query(
        rooms.as_panorama(rgb), query.scan_map, CoarseToFineSettings(gravity="known"), Workers(2)
    )
    assert is_mirrored(mirrored, true)
    assert is_mirror_image(mirrored)


def test_a_rough_place_is_refined_or_dropped(seen):
    query, true = seen
    best = track(query, true, 0.2)
    own = State(best.pose, 5.0, best.score)
    wrong = State(_off(true, 1.5, 120.0), 5.0)
    assert refine_state(query, [own, wrong], wrong) == [own]
    elsewhere = State(_off(true, 1.5, 120.0), 5.0, 0.2)
    rough = State(_off(true, 0.1, 3.0), 5.0)
    first, second = refine_state(query, [elsewhere, rough], rough)
    assert pose_errors(first.pose, true)[0] < 0.02
    assert first.log_odds > elsewhere.log_odds
    assert second is elsewhere


def test_a_camera_goes_on_as_it_went_but_no_farther_than_it_can(seen):
    _, true = seen
    ahead = predict(true, _off(true, -0.4, -10.0), 0.5, 9.0)
    distance, angle = pose_errors(ahead, _off(true, 0.2, 5.0))
    assert (distance, np.degrees(angle)) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert np.linalg.norm(
        predict(true, _off(true, -4.0, 0.0), 1.0, 0.5).center_world - true.center_world
    ) == (pytest.approx(0.5))
