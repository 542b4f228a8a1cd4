"""One frame, when it is known about where the camera was."""

import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, exp_so3, pose_errors
from piccolo.jobs.threads import Workers
from piccolo.localization.query import prepare_query
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.walk import tracker as tracker_module
from piccolo.walk.frames import State
from piccolo.walk.motion import Motion
from piccolo.walk.places import find_places, is_mirrored
from piccolo.walk.tracker import (
    SURE_ODDS,
    Follower,
    Found,
    find_from,
    find_near,
    follow,
    predict,
    refine_state,
    track,
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


def test_a_descent_goes_on_around_an_end_that_is_not_sure(seen, monkeypatch):
    query, true = seen
    asked = []
    perturb = tracker_module.perturb_middle
    monkeypatch.setattr(
        tracker_module, "perturb_middle", lambda query, pose: asked.append(pose) or perturb(query, pose)
    )
    end = track(query, true)
    assert pose_errors(end.pose, true)[0] < 0.02
    assert end.log_odds > SURE_ODDS
    assert not asked
    assert track(query, _off(true, 2.0, 90.0)) is None
    assert len(asked) == 1


def test_a_frame_is_followed_no_farther_than_its_motion_allows(seen):
    query, true = seen
    behind = Follower(_off(true, -0.3, 0.0), 0.0)
    assert follow(query, behind, 1.0, Motion()).pose.center_world == pytest.approx(
        true.center_world, abs=0.02
    )
    assert follow(query, Follower(_off(true, -0.2, 0.0), 0.0), 1.0, Motion(max_speed=1e-3)) is not None
    assert follow(query, Follower(_off(true, -0.4, 0.0), 0.0), 1.0, Motion(max_speed=1e-3)) is None
    turned = Follower(true, 0.5, _off(true, -0.35, 0.0), 0.0)  # walked at 0.7 m/s, and stands
    assert follow(query, turned, 1.0, Motion(max_acceleration=2.0)) is not None
    assert follow(query, turned, 1.0, Motion(max_acceleration=0.1)) is None


def test_a_frame_is_found_near_a_pose(seen):
    query, true = seen
    near = Follower(_off(true, 0.8, 40.0), 0.0)
    found = find_near(query, near, 1.0, Motion())
    assert (found.how, found.is_alone) == ("near", True)
    assert pose_errors(found.state.pose, true)[0] < 0.02
    assert find_near(query, near, 10.0, Motion()) is None, "too far to look around"
    assert find_near(query, Follower(_off(true, 50.0, 0.0), 0.0), 1.0, Motion()) is None


def test_a_better_pose_near_replaces_one_that_is_not_sure(seen, monkeypatch):
    """It counts as tracked at the same place; elsewhere it must be the only one of its kind."""
    query, true = seen
    follower = Follower(true, 0.0)
    own = State(true, 1.0, 0.5)
    beside, elsewhere = _off(true, 0.2, 0.0), _off(true, 5.0, 0.0)
    cases = (
        (None, own, "tracked"),
        (Found(State(beside, 0.5, 0.5), "near"), own, "tracked"),  # no better
        (Found(State(beside, 3.5, 0.5), "near", is_alone=False), beside, "tracked"),
        (Found(State(elsewhere, 3.5, 0.5), "near", is_alone=False), own, "tracked"),
        (Found(State(elsewhere, 3.5, 0.5), "near"), elsewhere, "near"),
    )
    monkeypatch.setattr(tracker_module, "follow", lambda *_: own)
    for near, wanted, how in cases:
        monkeypatch.setattr(tracker_module, "find_near", lambda *_, near=near: near)
        found = find_from(query, follower, 1.0, Motion())
        assert (found.state if wanted is own else found.state.pose) is wanted
        assert found.how == how
    monkeypatch.setattr(tracker_module, "follow", lambda *_: None)
    assert find_from(query, follower, 1.0, Motion()) is near


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
    assert not is_mirrored(query)
    taken = rooms.query(SEED)
    rgb = np.ascontiguousarray(taken.rgb[:, ::-1])
    mirrored = prepare_query(
        rooms.as_panorama(rgb), query.scan_map, CoarseToFineSettings(gravity="known"), Workers(2)
    )
    assert is_mirrored(mirrored, true)
    assert is_mirrored(mirrored)


def test_a_rough_place_is_refined_or_dropped(seen):
    query, true = seen
    best = track(query, true)
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
