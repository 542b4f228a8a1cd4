"""One frame, when it is known about where the camera was."""

from dataclasses import replace

import numpy as np
import pytest
import rooms

from piccolo.confidence.alternatives import Hypothesis
from piccolo.confidence.confidence import log_odds
from piccolo.geometry.pose import Pose, exp_so3, pose_errors
from piccolo.jobs.threads import Workers
from piccolo.localization import refinement
from piccolo.localization.attempts import CHANCE_MATCHES, brief_query
from piccolo.localization.query import prepare_query
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.walk import tracker
from piccolo.walk.frames import State
from piccolo.walk.motion import Motion
from piccolo.walk.places import Place, descend_briefly, find_places, is_mirrored, query_near
from piccolo.walk.tracker import (
    Expected,
    Follower,
    Found,
    choose,
    expect,
    find_from,
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


def _narrow(query):
    """The query of a part of the same photo."""
    panorama = rooms.as_panorama(rooms.query(SEED).rgb)
    columns = np.linspace(-0.5, 0.5, panorama.is_valid.shape[1])
    narrow = replace(panorama, is_valid=panorama.is_valid & (np.abs(columns) < 0.15))
    return prepare_query(narrow, query.scan_map, CoarseToFineSettings(), Workers(2))


def test_a_descent_goes_on_around_its_end_while_that_helps(seen, monkeypatch):
    query, true = seen
    asked = []
    perturb = refinement.perturb_middle
    monkeypatch.setattr(
        refinement, "perturb_middle", lambda query, pose: asked.append(pose) or perturb(query, pose)
    )
    end = track(query, true)
    assert pose_errors(end.pose, true)[0] < 0.02
    assert end.log_odds > 4.0
    assert len(asked) == 1
    far = track(query, _off(true, 0.6, 20.0))
    assert pose_errors(far.pose, true)[0] < 0.02
    assert track(query, _off(true, 2.0, 90.0)) is None
    assert 3 < len(asked) <= 1 + 2 * refinement.MAX_PERTURBATIONS


def test_a_camera_is_expected_no_farther_than_its_motion_allows(seen):
    _, true = seen
    ahead = _off(true, 0.5, 0.0)
    assert expect(Follower(true, 0.0), 1.0, Motion()).holds(ahead)
    assert not expect(Follower(true, 0.0), 1.0, Motion(max_speed=1e-3)).holds(ahead)
    stands = Follower(true, 0.5, _off(true, -0.35, 0.0), 0.0)  # walked at 0.7 m/s
    assert expect(stands, 1.0, Motion(max_acceleration=2.0)).holds(true)
    assert not expect(stands, 1.0, Motion(max_acceleration=0.1)).holds(true)
    assert expect(stands, 1.0, Motion(max_acceleration=0.1, is_timed=False)).holds(true)


def test_a_frame_is_found_where_it_is_predicted_or_near(seen):
    query, true = seen
    for off, how in ((_off(true, 0.1, 5.0), "tracked"), (_off(true, 1.6, 120.0), "near")):
        found = find_from(query, Follower(off, 0.0), 1.0, Motion())
        assert (found.how, found.is_alone) == (how, True)
        assert pose_errors(found.state.pose, true)[0] < 0.02
    late = find_from(query, Follower(off, 0.0), 10.0, Motion())  # 20 m, of which 12 m are searched
    assert pose_errors(late.state.pose, true)[0] < 0.02
    for seconds in (1.0, 10.0):
        assert find_from(query, Follower(_off(true, 50.0, 0.0), 0.0), seconds, Motion()) is None
    rgb = np.ascontiguousarray(rooms.query(SEED).rgb[:, ::-1])
    mirrored = prepare_query(rooms.as_panorama(rgb), query.scan_map, CoarseToFineSettings(), Workers(2))
    assert find_from(mirrored, Follower(true, 0.0), 1.0, Motion()) is None


def test_a_pose_near_replaces_the_predicted_one_if_it_is_surer(seen):
    """At the same place it counts as tracked; elsewhere it must be the only one of its kind, or sure."""
    _, true = seen
    own = State(true, 1.0, 0.5)
    weak = State(true, 0.5, 0.5)
    beside = State(_off(true, 0.2, 0.0), 3.5, 0.5)
    elsewhere = State(_off(true, 5.0, 0.0), 3.5, 0.5)
    doubtful = State(elsewhere.pose, 2.0, 0.5)
    near = Expected(true, 9.0, true, 9.0)
    far = Expected(true, 9.0, true, 1.0)
    only = [Place(elsewhere.pose, 0.0)]
    alike = [*only, Place(true, -1.0)]
    assert choose(own, weak, only, near) == Found(own, "tracked")
    assert choose(own, beside, alike, near) == Found(beside, "tracked")
    assert choose(own, elsewhere, alike, near) == Found(own, "tracked")
    assert choose(own, elsewhere, only, near) == Found(elsewhere, "near")
    assert choose(own, elsewhere, only, far) == Found(own, "tracked")
    assert choose(None, elsewhere, alike, far) == Found(elsewhere, "near", is_alone=False)
    assert choose(None, doubtful, only, near) == Found(doubtful, "near")
    assert choose(None, doubtful, only, far) is None
    assert choose(None, doubtful, alike, near) is None


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
    rgb = np.ascontiguousarray(rooms.query(SEED).rgb[:, ::-1])
    mirrored = prepare_query(rooms.as_panorama(rgb), query.scan_map, CoarseToFineSettings(), Workers(2))
    for taken, wanted in ((query, False), (mirrored, True)):
        for some in (query_near(taken, true, 2.0), brief_query(taken)):
            assert is_mirrored(some, descend_briefly(some)) == wanted


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


def test_a_narrow_photo_is_tracked_again_from_where_its_matches_are(seen, monkeypatch):
    query, true = seen
    taken = _narrow(query)
    starts = []

    def stay(query, start):
        """End where it began, as in a minimum."""
        starts.append(start)
        return Hypothesis(start, 0.5)

    monkeypatch.setattr(tracker, "refine_on_middle_cells", stay)
    end = tracker.track(taken, _off(true, 0.25, 4.0))
    assert pose_errors(starts[1], true)[0] < 0.1
    assert pose_errors(end.pose, true)[0] < 0.05
    assert end.gain == 0.0
    assert tracker.track(query, true).gain > 0.0
    assert len(starts) == 3


def test_matches_that_put_a_narrow_photo_elsewhere_count_as_none(seen):
    taken = _narrow(seen[0])
    true = seen[1]
    here = tracker.assess_end(taken, Hypothesis(true, 0.5))
    assert here.num_matches > CHANCE_MATCHES
    beside = tracker.assess_end(taken, Hypothesis(_off(true, 0.25, 0.0), 0.5))
    assert beside.num_matches == 0
    assert log_odds(here) > log_odds(beside)
    assert tracker.assess_end(seen[0], Hypothesis(true, 0.5)).num_matches is None
    assert tracker.assess_end(replace(taken, num_parts=0), Hypothesis(true, 0.5)).num_matches is None


@pytest.mark.parametrize(
    ("odds", "score", "is_found"), [(2.0, 0.2, True), (2.0, 0.02, False), (-0.1, 0.2, False)]
)
def test_an_end_that_is_unlikely_or_explains_nothing_is_none(seen, monkeypatch, odds, score, is_found):
    query, true = seen
    monkeypatch.setattr(tracker, "descend_last", lambda query, start: State(start, odds, score))
    assert (track(query, true) is not None) == is_found
