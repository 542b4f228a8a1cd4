"""One frame, when it is known about where the camera was."""

from dataclasses import replace

import numpy as np
import pytest
import rooms

from piccolo.confidence.alternatives import Hypothesis
from piccolo.confidence.confidence import log_odds
from piccolo.evidence import verification
from piccolo.evidence.comparison import Comparison, score_pose
from piccolo.evidence.verification import CHANCE_MATCHES
from piccolo.geometry.pose import Pose, exp_so3, pose_errors
from piccolo.jobs.threads import Workers
from piccolo.localization import ladder, near
from piccolo.localization.beam import brief_query, score_briefly, score_mirror
from piccolo.localization.near import Near
from piccolo.optimize.channel_loss import CHANCE
from piccolo.walk import tracker
from piccolo.walk.frames import Frame, Motion, State
from piccolo.walk.tracker import (
    Expected,
    expect,
    find_near,
    find_places,
    predict,
    query_near,
    refine_state,
    track,
)

SEED = 1


@pytest.fixture(scope="module")
def seen():
    """A frame's query in the map of a room, and its true pose there."""
    taken, scan_map = rooms.query(SEED), rooms.scan_map(SEED)
    query = rooms.ask(rooms.as_panorama(taken.rgb), scan_map)
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
    return rooms.ask(narrow, query.scan_map)


def test_a_descent_goes_on_around_its_end_while_that_helps(seen, monkeypatch):
    query, true = seen
    asked = []
    perturb = ladder.descend_around
    monkeypatch.setattr(ladder, "descend_around", lambda *how: asked.append(how) or perturb(*how))
    end = track(query, true)
    assert pose_errors(end.pose, true)[0] < 0.02
    assert end.log_odds > 4.0
    assert len(asked) == 1
    far = track(query, _off(true, 0.6, 20.0))
    assert pose_errors(far.pose, true)[0] < 0.02
    assert track(query, _off(true, 2.0, 90.0)) is None
    assert 3 < len(asked) <= 1 + 2 * ladder.MAX_PERTURBATIONS


def test_a_camera_is_expected_by_its_motion_before_or_by_an_odometry(seen):
    _, true = seen
    before = _off(true, -0.35, 0.0)
    frame = Frame(1.0)
    assert expect(frame, [(Frame(0.5), true)], Motion()) == Expected(true, Motion().reach(0.5), true)
    walked = expect(frame, [(Frame(0.5), true), (Frame(0.0), before)], Motion())
    assert (walked.last, walked.reach) == (true, Motion().reach(0.5))
    assert pose_errors(walked.pose, _off(true, 0.35, 0.0))[0] == pytest.approx(0.0, abs=1e-9)
    slow = expect(frame, [(Frame(0.5), true), (Frame(0.0), before)], Motion(max_speed=0.01))
    assert pose_errors(slow.pose, true)[0] == pytest.approx(slow.reach)
    measured = [Frame(time, odometry=_off(true, time, 0.0)) for time in (0.5, 1.0)]
    moved = expect(measured[1], [(measured[0], true), (Frame(0.0), before)], Motion())
    assert moved.last is moved.pose
    assert pose_errors(moved.pose, _off(true, 0.5, 0.0))[0] == pytest.approx(0.0, abs=1e-9)


def _expected(last, seconds, pose=None):
    return Expected(last, Motion().reach(seconds), pose or last)


def test_a_frame_is_found_where_it_is_expected_or_near(seen):
    query, true = seen
    for off, how in ((_off(true, 0.1, 5.0), "tracked"), (_off(true, 1.6, 120.0), "near")):
        found = find_near(query, _expected(off, 1.0))
        assert (found.how, found.is_alone) == (how, True)
        assert pose_errors(found.state.pose, true)[0] < 0.02
    assert find_near(query, _expected(off, 1.0, _off(true, 0.3, 5.0))).how == "tracked"
    assert pose_errors(find_near(query, _expected(off, 10.0)).state.pose, true)[0] < 0.02
    for seconds in (1.0, 10.0):
        assert find_near(query, _expected(_off(true, 50.0, 0.0), seconds)) is None
    rgb = np.ascontiguousarray(rooms.query(SEED).rgb[:, ::-1])
    mirrored = rooms.ask(rooms.as_panorama(rgb), query.scan_map)
    assert find_near(mirrored, _expected(true, 1.0)) is None


def test_a_frame_gains_by_the_few_places_within_reach(seen):
    query, true = seen
    own = find_near(query, _expected(true, 0.1)).state
    share = len(query_near(query, true, Motion().reach(0.1)).scan_map.sparse) / len(query.scan_map.sparse)
    assert 0.0 < own.gain == pytest.approx(min(-np.log(share), 3.0))
    assert find_near(query, _expected(true, 60.0)).state.gain == 0.0, "all places are within reach"
    assert find_near(_narrow(query), _expected(true, 0.1)).state.gain == 0.0


@pytest.mark.parametrize(
    ("behind", "at", "how", "is_alone"),
    [
        (-1.0, "expected", "tracked", False),  # it looks as a copy does: what was expected is taken
        (-9.0, "expected", "tracked", True),
        (1.0, "expected", "tracked", False),
        (9.0, "elsewhere", "near", True),  # it looks better than a copy can
    ],
)
def test_another_place_is_taken_if_it_looks_better_than_a_copy(seen, monkeypatch, behind, at, how, is_alone):
    query, true = seen
    elsewhere = _off(true, 3.0, 0.0)

    monkeypatch.setattr(tracker, "list_places", lambda *_: [(elsewhere, min(behind, 0.0))])
    monkeypatch.setattr(tracker, "log_behind", lambda *_: min(-behind, 0.0))
    monkeypatch.setattr(tracker, "track", lambda query, start: State(start, 3.5, 0.5))
    found = find_near(query, _expected(true, 2.0))
    assert found.state.pose is {"expected": true, "elsewhere": elsewhere}[at]
    assert (found.how, found.is_alone) == (how, is_alone)


def test_the_best_place_near_is_tried_if_nothing_is_found_where_it_was_expected(seen, monkeypatch):
    query, true = seen
    elsewhere = _off(true, 3.0, 0.0)
    monkeypatch.setattr(tracker, "list_places", lambda *_: [(elsewhere, 0.0)])
    monkeypatch.setattr(tracker, "log_behind", lambda *_: 0.0)
    monkeypatch.setattr(
        tracker, "track", lambda query, start: None if start is true else State(start, odds, 0.5)
    )
    odds = 3.5
    assert find_near(query, _expected(true, 2.0)).state.pose is elsewhere
    assert find_near(query, _expected(true, 1.0)) is None, "it is out of reach"
    odds = 2.0
    assert find_near(query, _expected(true, 2.0)) is None, "it is not sure"


def test_the_places_that_look_like_a_photo(seen):
    """Its own is the best, in a heading that was not asked; others in the room are behind."""
    query, true = seen
    places = find_places(query, true)
    assert pose_errors(places[0][0], true)[0] < 0.1
    assert max(behind for _, behind in places[1:]) < places[0][1] <= 0.0
    off = _off(true, 1.0, 90.0)
    pose, behind = find_places(query, off)[0]
    assert behind == 0.0  # what explains more than the pose given
    assert pose_errors(pose, true)[0] < 0.1


def test_a_mirrored_photo_is_told_near_a_pose_and_anywhere(seen):
    query, true = seen
    rgb = np.ascontiguousarray(rooms.query(SEED).rgb[:, ::-1])
    mirrored = rooms.ask(rooms.as_panorama(rgb), query.scan_map)
    for taken, wanted in ((query, False), (mirrored, True)):
        for some in (query_near(taken, true, 2.0), brief_query(taken)):
            assert (score_mirror(some) > score_briefly(some)) == wanted


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
        return start, start

    monkeypatch.setattr(near, "climb_from_afar", stay)
    end = tracker.track(taken, _off(true, 0.25, 4.0))
    assert pose_errors(starts[1], true)[0] < 0.1
    assert pose_errors(end.pose, true)[0] < 0.05
    tracker.track(query, true)
    assert len(starts) == 3


def test_matches_that_put_a_narrow_photo_elsewhere_count_as_none(seen):
    taken = _narrow(seen[0])
    true = seen[1]
    here = near.assess_end(taken, Hypothesis(true, 0.5))
    assert here.num_matches > CHANCE_MATCHES
    for metres, degrees in ((0.25, 0.0), (0.0, 6.0)):
        elsewhere = near.assess_end(taken, Hypothesis(_off(true, metres, degrees), 0.5))
        assert elsewhere.num_matches == 0
    assert log_odds(here) > log_odds(elsewhere)
    assert near.assess_end(seen[0], Hypothesis(true, 0.5)).num_matches is None
    assert near.assess_end(taken.by_views(), Hypothesis(true, 0.5)).num_matches is None


@pytest.mark.parametrize(
    ("odds", "score", "is_found"), [(2.0, 0.2, True), (2.0, 0.02, False), (-0.1, 0.2, False)]
)
def test_an_end_that_is_unlikely_or_explains_nothing_is_none(seen, monkeypatch, odds, score, is_found):
    query, true = seen
    probability = 1.0 / (1.0 + np.exp(-odds))
    seen_there = Comparison(np.array([CHANCE + (1.0 - CHANCE) * score]), np.ones(1), np.ones(1), 1.0)
    monkeypatch.setattr(tracker, "refine_near", lambda _, start: Near(start, seen_there, None, probability))
    assert (track(query, true) is not None) == is_found


@pytest.fixture
def follower(seen):
    """A tracker with some frames, all with the same narrow photo; and the numbers whose pictures are read."""
    query = seen[0]
    taken = _narrow(query).given
    asked = []
    follower = tracker.Tracker(query.scan_map, query.settings, Workers(2), Motion())
    odds = (4.0, 4.0, 4.0, tracker.MOST_EXPECTED, 4.0, 2.9)
    follower.lattice.frames.extend(Frame(0.5 * k, [State(seen[1], o)]) for k, o in enumerate(odds))
    follower.read = lambda k: asked.append(k) or taken
    return follower, asked


def test_a_narrow_photo_is_matched_with_the_frames_it_is_found_from(seen, follower, monkeypatch):
    """If these are sure by themselves; a whole photo is not."""
    query, true = seen
    near = [(5, _off(true, 0.6, 0.0)), (4, _off(true, 0.5, 0.0)), (3, _off(true, 0.4, 0.0))]
    given = []
    monkeypatch.setattr(tracker, "find_near", lambda query, expected: given.append((query, expected)))
    monkeypatch.setattr(tracker, "place_keypoints", lambda *given: given)
    monkeypatch.setattr(tracker, "match_beside", lambda own, other: (own, *other))
    taken = _narrow(query)
    for photo in (query, taken):
        follower[0].find(photo, Frame(3.0), near)
    assert follower[1] == [4, 3]
    assert given[0][0].beside == ()
    assert [own is taken for own, _, _ in given[1][0].beside] == [True, True]
    poses = [pose for _, _, pose in given[1][0].beside]
    assert poses[0] is near[1][1]
    assert poses[1] is near[2][1]
    assert all(expected.last is near[0][1] for _, expected in given)


def test_the_queries_of_narrow_photos_asked_for_last_are_kept(seen, follower):
    """Each is as new: what was found with it before has no part in what is found later."""
    walk, asked = follower
    for k in (0, 1, 2, 3, 0, 4, 0, 1):
        query = walk.query_of(k)
        assert query.cache.comparisons == {}
        score_pose(query, seen[1])
    assert asked == [0, 1, 2, 3, 4, 1]
    assert len(walk.queries) == tracker.NUM_QUERIES
    walk.read = lambda k: rooms.as_panorama(rooms.query(SEED).rgb)
    assert walk.query_of(5) is not None
    assert 5 not in walk.queries, "it is whole"
    walk.read = lambda k: None
    assert walk.query_of(5) is None


def test_photos_beside_support_a_narrow_photo_where_they_agree(seen):
    query, true = seen
    taken = _narrow(query)
    here = Hypothesis(true, 0.5)
    alone = near.assess_end(taken, here).num_matches
    more = taken.photo.seen().keypoints.take(np.arange(2 * alone))
    located = verification.Located(more, np.full(2 * alone, 2.0, np.float32), true)
    others = verification.match_located(taken.photo.seen().keypoints, located)
    assert near.assess_end(replace(taken, beside=(others,)), here).num_matches > alone
    away = others._replace(points=others.points + np.float32(0.5))
    assert near.assess_end(replace(taken, beside=(away,)), here).num_matches == alone


@pytest.mark.parametrize(("odds", "is_narrow"), [(3.5, True), (2.0, True), (3.5, False)])
def test_a_narrow_photo_is_tried_last_where_views_do_not_expect_it(seen, monkeypatch, odds, is_narrow):
    query, true = seen
    elsewhere = _off(true, 1.0, 0.0)
    taken = _narrow(query) if is_narrow else query
    monkeypatch.setattr(tracker, "list_places", lambda *_: [(elsewhere, 0.0)])
    monkeypatch.setattr(tracker, "log_behind", lambda *_: -9.0)
    monkeypatch.setattr(
        tracker, "track", lambda query, start: State(start, odds, 0.5) if start is true else None
    )
    found = find_near(taken, _expected(true, 2.0))
    assert (found is not None) == (odds > 3.0 and is_narrow)
