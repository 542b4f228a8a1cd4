"""A narrow frame, when it is known about where the camera was; and frames beside it."""

from dataclasses import replace

import numpy as np
import pytest
import rooms
import tracked
from rooms import WORKERS

from piccolo.evidence import verification
from piccolo.evidence.examine import examine
from piccolo.geometry.pose import pose_errors
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.probability import LOCALIZED, log_odds
from piccolo.judge.result import Result
from piccolo.localization import near
from piccolo.problem.method import METHOD
from piccolo.together.walk import tracker
from piccolo.together.walk.expectation import (
    Start,
    is_acceptable,
    list_alike,
    list_starts,
)
from piccolo.together.walk.following import (
    KnownPoses,
    choose_accepted,
    compute_gain,
    find_near,
    join_beside,
    track,
)
from piccolo.together.walk.frames import MOST_EXPECTED, Frame, Motion, State
from piccolo.together.walk.places import list_key_states, narrow_down

TIER = "scene"


@pytest.fixture(scope="module")
def seen():
    return tracked.seen()


def test_a_narrow_photo_is_tracked_again_from_where_its_matches_are(seen, monkeypatch):
    problem, true = seen
    taken = tracked.narrow(problem)
    starts = []

    def stay(problem, start, workers):
        """End where it began, as in a minimum."""
        starts.append(start)
        return start, start

    monkeypatch.setattr(near, "climb_from_afar", stay)
    end = track(taken, tracked.off(true, 0.25, 4.0), WORKERS)
    assert pose_errors(starts[1], true)[0] < 0.1
    assert pose_errors(end.pose, true)[0] < 0.05
    track(problem, true, WORKERS)
    assert len(starts) == 3


def test_matches_that_put_a_narrow_photo_elsewhere_count_as_none(seen):
    taken = tracked.narrow(seen[0])
    true = seen[1]
    here = near.assess_end(taken, examine(taken, true), WORKERS)
    assert here.num_matches > METHOD.chance_matches
    for metres, degrees in ((0.25, 0.0), (0.0, 6.0)):
        elsewhere = near.assess_end(taken, examine(taken, tracked.off(true, metres, degrees)), WORKERS)
        assert elsewhere.num_matches == 0
    assert log_odds(here) > log_odds(elsewhere)
    for by_views in (seen[0], taken.by_views()):
        assert near.assess_end(by_views, examine(by_views, true), WORKERS).num_matches is None


@pytest.fixture
def follower(seen):
    """A tracker with some frames, all with the same narrow photo; and the numbers whose pictures are read."""
    problem = seen[0]
    taken = tracked.narrow(problem).given
    asked = []
    follower = tracker.Tracker(problem.scan_map, rooms.AUTO, WORKERS, Motion())
    odds = (4.0, 4.0, 4.0, MOST_EXPECTED, 4.0, 2.9)
    follower.lattice.frames.extend(Frame(0.5 * k, [State(seen[1], o)]) for k, o in enumerate(odds))
    follower.read = lambda k: asked.append(k) or taken
    return follower, asked


def test_a_narrow_photo_is_matched_with_the_frames_it_is_found_from(seen, follower, monkeypatch):
    """If these are sure by themselves; a whole photo is not."""
    problem, true = seen
    near = [
        (5, tracked.off(true, 0.6, 0.0)),
        (4, tracked.off(true, 0.5, 0.0)),
        (3, tracked.off(true, 0.4, 0.0)),
    ]
    given = []
    monkeypatch.setattr(tracker, "find_near", lambda problem, expected, *_: given.append((problem, expected)))
    taken = tracked.narrow(problem)
    for photo in (problem, taken):
        follower[0].find(photo, Frame(3.0), near)
    assert follower[1] == [4, 3]
    assert given[0][0].beside == ()
    assert given[1][0].photo is taken.photo
    for found, (_, pose) in zip(given[1][0].beside, near[1:], strict=True):
        located = verification.place_keypoints(taken, pose, WORKERS)
        expected = verification.match_beside(taken, located, WORKERS)
        np.testing.assert_array_equal(found.points, expected.points)
    assert all(expected.last is near[0][1] for _, expected in given)


def test_the_problems_of_narrow_photos_asked_for_last_are_kept(follower):
    walk, asked = follower
    for k in (0, 1, 2, 3, 0, 4, 0, 1):
        assert walk.problem_of(k) is walk.problems[k]
    assert asked == [0, 1, 2, 3, 4, 1]
    assert len(walk.problems) == tracker.NUM_KEPT
    walk.read = lambda k: rooms.as_panorama(rooms.query(tracked.SEED).rgb)
    assert walk.problem_of(5) is not None
    assert 5 not in walk.problems, "it is whole"
    walk.read = lambda k: None
    assert walk.problem_of(5) is None


def test_photos_beside_support_a_narrow_photo_where_they_agree(seen):
    problem, true = seen
    taken = tracked.narrow(problem)
    here = examine(taken, true)
    alone = near.assess_end(taken, here, WORKERS).num_matches
    more = taken.photo.features(WORKERS).keypoints.take(np.arange(2 * alone))
    located = verification.Located(more, np.full(2 * alone, 2.0, np.float32), true)
    others = verification.match_located(taken.photo.features(WORKERS).keypoints, located)
    assert near.assess_end(replace(taken, beside=(others,)), here, WORKERS).num_matches > alone
    away = others._replace(points=others.points + np.float32(0.5))
    assert near.assess_end(replace(taken, beside=(away,)), here, WORKERS).num_matches == alone


@pytest.fixture(scope="module")
def confirmed(seen):
    """The problem of a narrow photo beside one that shows the same; and the pose of that, exact to 5 mm."""
    taken = tracked.narrow(seen[0])
    located = verification.place_keypoints(taken, seen[1], WORKERS)
    matches = verification.match_located(taken.photo.features(WORKERS).keypoints, located)
    exact = PoseGaussian(seen[1], np.diag(np.repeat([0.001**2, 0.005**2], 3)), np.zeros((6, 6)))
    return replace(taken, beside=(matches,)), exact


def test_a_narrow_photo_gains_where_a_sure_one_beside_confirms_its_pose(seen, confirmed):
    taken, exact = confirmed
    expected = tracked.expected(tracked.off(seen[1], 0.1, 3.0), 0.1)
    near, _ = narrow_down(taken, expected.last, expected.reach, rooms.AUTO.effort)
    for beside, gain in (((exact,), compute_gain(taken, near)), ((None,), 0.0)):
        found = find_near(taken, expected, rooms.means(), KnownPoses(beside=beside)).state
        assert found.gain == pytest.approx(gain, rel=0.01)
        assert pose_errors(found.pose, seen[1])[0] < (0.01 if gain else 0.05)
    unknown = find_near(replace(taken, beside=()), expected, rooms.means()).state
    assert unknown.gain == 0.0


def test_a_local_optimum_comes_to_the_pose_by_the_photo_beside(seen, confirmed):
    """The less likely it is right by itself, the more."""
    taken, exact = confirmed
    wrong = tracked.off(seen[1], 0.12, 1.0)
    spread = PoseGaussian(wrong, exact.own, exact.common)
    ends = []
    for odds in (-1.0, 6.0):
        joined, share = join_beside(taken, State(wrong, odds, 0.5, spread), (exact,))
        ends.append(pose_errors(joined.pose, seen[1])[0])
        assert joined.gaussian.pose is joined.pose
        assert share > 0.0
    assert ends[0] < 0.02 < ends[1] < 0.12
    bare, _ = join_beside(taken, State(wrong, 1.0, 0.5), (exact,))
    assert pose_errors(bare.pose, seen[1])[0] < 0.01
    away = State(tracked.off(seen[1], 0.5, 0.0), 1.0, 0.5, spread)
    assert join_beside(taken, away, (exact,)) == (away, 0.0)


def test_other_ends_make_a_narrow_photo_less_sure(seen):
    near = State(tracked.off(seen[1], 0.05, 0.0), 1.0)
    far = State(tracked.off(seen[1], 0.2, 0.0), 1.5)
    best = State(seen[1], 2.0)
    assert choose_accepted([near, best]) == best
    weighed = choose_accepted([near, best, far])
    assert (weighed.pose, weighed.log_odds) == (seen[1], pytest.approx(2.0 - np.log1p(np.exp(1.5))))


def test_a_narrow_photo_is_tracked_from_what_others_tell_within_reach(seen):
    true = seen[1]
    expected = tracked.expected(true, 1.0)
    near = tracked.off(true, 0.3, 10.0)
    away = tracked.off(true, 9.0, 0.0)
    alike = [tracked.off(true, 0.2 * k, 0.0) for k in range(1, 7)]
    starts = list_starts(expected, 0.0, alike, True, [away, near])
    assert starts == [Start(pose, False) for pose in (true, near, *alike[:4])]
    assert list_starts(expected, 0.0, alike, False, [near]) == [Start(true, False), Start(alike[0], False)]


def test_all_places_where_a_narrow_photo_was_not_found_are_as_likely_as_none(seen):
    """Views do not tell them apart; of one that is sure they are less likely, of a whole photo they count."""
    problem, true = seen
    own = [State(true, 1.6, 0.5)]
    unsure = Result()
    sure = Result(LOCALIZED)
    rough = [s.log_odds for s in list_key_states(tracked.narrow(problem), own, rooms.means(), unsure)[1:]]
    assert len(rough) > 3
    assert np.logaddexp.reduce(rough) <= -3.0 + 1e-9
    views = [s.log_odds for s in list_key_states(tracked.narrow(problem), own, rooms.means())[1:]]
    assert np.logaddexp.reduce(views) > -2.0
    assert [s.log_odds for s in list_key_states(problem, own, rooms.means(), unsure)] == [
        s.log_odds for s in list_key_states(problem, own, rooms.means())
    ]
    assert max(s.log_odds for s in list_key_states(problem, own, rooms.means(), sure)[1:]) <= 1.6 - 11.0


@pytest.mark.parametrize(
    ("metres", "degrees", "probability", "is_asked"),
    [(0.1, 70.0, 0.5, True), (0.1, 10.0, 0.5, False), (2.5, 10.0, 0.5, True), (0.1, 70.0, 0.95, False)],
)
def test_a_frame_that_shows_more_of_a_doubtful_place_is_searched(
    seen, metres, degrees, probability, is_asked
):
    """The photo shows 54 degrees; at 70 it shows something else, 2.5 m on too."""
    problem, true = seen
    taken = tracked.narrow(problem).given
    shown = taken.is_valid & (np.abs(np.linspace(-0.5, 0.5, len(taken.is_valid)))[:, None] < 0.15)
    narrow = rooms.ask(replace(taken, is_valid=shown), problem.scan_map)
    walk = tracker.Tracker(problem.scan_map, rooms.AUTO, WORKERS, Motion())
    odds = float(np.log(probability / (1.0 - probability)))
    walk.lattice.add(Frame(0.0, [State(true, odds, 0.5)], is_key=True, departed=true))
    pose = tracked.off(true, metres, degrees)
    frame = Frame(1.0, [State(pose, 2.0, 0.5)], key=0, arrived=pose)
    assert walk._is_doubtful(narrow, frame) == is_asked
    assert not walk._is_doubtful(problem, frame), "it is whole"


@pytest.mark.parametrize(("odds", "is_narrow"), [(3.5, True), (2.0, True), (3.5, False)])
def test_a_narrow_photo_is_tried_last_where_views_do_not_expect_it(seen, odds, is_narrow):
    true = seen[1]
    elsewhere = tracked.off(true, 1.0, 0.0)
    expected = tracked.expected(true, 2.0)
    starts = list_starts(expected, -9.0, list_alike(expected, [(elsewhere, 0.0)]), is_narrow)
    assert starts == [Start(elsewhere, False), *([Start(true, True)] if is_narrow else [])]
    assert is_acceptable(State(true, odds, 0.5), expected, True) == (odds > 3.0)
