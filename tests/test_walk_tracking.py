"""One frame, when it is known about where the camera was."""

from dataclasses import replace

import numpy as np
import pytest
import rooms
from made_up import make_candidate
from rooms import WORKERS

from piccolo.evidence import verification
from piccolo.evidence.examine import examine
from piccolo.geometry.pose import Pose, exp_so3, pose_errors
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.probability import LOCALIZED, log_odds
from piccolo.judge.result import Result
from piccolo.localization import ladder, near
from piccolo.localization.beam import score_briefly, score_mirror
from piccolo.localization.near import Near
from piccolo.problem.method import METHOD
from piccolo.together.walk import tracker
from piccolo.together.walk.expectation import (
    Expected,
    Start,
    describe_end,
    expect,
    is_acceptable,
    list_alike,
    list_starts,
    predict,
)
from piccolo.together.walk.following import (
    Told,
    choose_end,
    choose_held,
    compute_gain,
    find_near,
    join_beside,
    refine_state,
    track,
)
from piccolo.together.walk.frames import MOST_EXPECTED, Frame, Motion, State
from piccolo.together.walk.places import find_places, list_key_states, narrow_down

SEED = 1
EFFORT = rooms.AUTO.effort


@pytest.fixture(scope="module")
def seen():
    """A frame's problem in the map of a room, and its true pose there."""
    taken, scan_map = rooms.query(SEED), rooms.scan_map(SEED)
    problem = rooms.ask(rooms.as_panorama(taken.rgb), scan_map)
    return problem, rooms.local(SEED, taken.pose)


def _off(pose, metres, degrees):
    """A pose so far from another."""
    turn = exp_so3(np.radians(degrees) * np.array([0.0, 0.0, 1.0]))
    return Pose(turn @ pose.R_cam_from_world, pose.center_world + metres * np.array([0.8, 0.6, 0.0]))


def _narrow(problem):
    """The problem of a part of the same photo."""
    panorama = rooms.as_panorama(rooms.query(SEED).rgb)
    columns = np.linspace(-0.5, 0.5, panorama.is_valid.shape[1])
    narrow = replace(panorama, is_valid=panorama.is_valid & (np.abs(columns) < 0.15))
    return rooms.ask(narrow, problem.scan_map)


def test_a_descent_goes_on_around_its_end_while_that_helps(seen):
    problem, true = seen
    workers, done = rooms.listen()
    batches = len(ladder.perturbations(METHOD, 1.0)) // ladder.PERTURBED_BATCH
    end = track(problem, true, workers)
    assert pose_errors(end.pose, true)[0] < 0.02
    assert end.log_odds > 4.0
    assert done.count(("descend", batches)) == 1
    far = track(problem, _off(true, 0.6, 20.0), workers)
    assert pose_errors(far.pose, true)[0] < 0.02
    assert track(problem, _off(true, 2.0, 90.0), workers) is None
    assert 3 < done.count(("descend", batches)) <= 1 + 2 * METHOD.most_perturbations


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
    problem, true = seen
    for off, how in ((_off(true, 0.1, 5.0), "tracked"), (_off(true, 1.6, 120.0), "near")):
        found = find_near(problem, _expected(off, 1.0), rooms.means())
        assert (found.how, found.is_alone) == (how, True)
        assert pose_errors(found.state.pose, true)[0] < 0.02
    assert find_near(problem, _expected(off, 1.0, _off(true, 0.3, 5.0)), rooms.means()).how == "tracked"
    far = find_near(problem, _expected(off, 10.0), rooms.means())
    assert pose_errors(far.state.pose, true)[0] < 0.02
    for seconds in (1.0, 10.0):
        assert find_near(problem, _expected(_off(true, 50.0, 0.0), seconds), rooms.means()) is None
    rgb = np.ascontiguousarray(rooms.query(SEED).rgb[:, ::-1])
    mirrored = rooms.ask(rooms.as_panorama(rgb), problem.scan_map)
    assert find_near(mirrored, _expected(true, 1.0), rooms.means()) is None


def test_a_frame_gains_by_the_few_places_within_reach(seen):
    problem, true = seen
    own = find_near(problem, _expected(true, 0.1), rooms.means()).state
    near, _ = narrow_down(problem, true, Motion().reach(0.1), EFFORT)
    share = len(near.scan_map.sparse) / len(problem.scan_map.sparse)
    assert 0.0 < own.gain == pytest.approx(min(-np.log(share), 3.0))
    all_places = find_near(problem, _expected(true, 60.0), rooms.means())  # are within reach
    assert all_places.state.gain == 0.0
    assert find_near(_narrow(problem), _expected(true, 0.1), rooms.means()).state.gain == 0.0


@pytest.mark.parametrize(
    ("behind", "at", "how", "is_alone"),
    [
        (-1.0, "expected", "tracked", False),  # it looks as a copy does: what was expected is taken
        (-9.0, "expected", "tracked", True),
        (1.0, "expected", "tracked", False),
        (9.0, "elsewhere", "near", True),  # it looks better than a copy can
    ],
)
def test_another_place_is_taken_if_it_looks_better_than_a_copy(seen, behind, at, how, is_alone):
    true = seen[1]
    elsewhere = _off(true, 3.0, 0.0)
    expected = _expected(true, 2.0)
    alike = list_alike(expected, [(elsewhere, min(behind, 0.0))])
    first = list_starts(expected, min(-behind, 0.0), alike, False)[0]
    found = describe_end(State(first.pose, 3.5, 0.5), expected, alike)
    assert is_acceptable(found.state, expected, first.must_be_sure)
    assert found.state.pose is {"expected": true, "elsewhere": elsewhere}[at]
    assert (found.how, found.is_alone) == (how, is_alone)


def test_the_best_place_near_is_tried_if_nothing_is_found_where_it_was_expected(seen):
    true = seen[1]
    elsewhere = _off(true, 3.0, 0.0)
    expected = _expected(true, 2.0)
    alike = list_alike(expected, [(elsewhere, 0.0), (_off(true, 2.0, 0.0), -1.0)])
    assert list_starts(expected, 0.0, alike, False) == [Start(true, False), Start(elsewhere, False)]
    for odds, is_sure in ((3.5, True), (2.0, False)):
        assert is_acceptable(State(elsewhere, odds, 0.5), expected, False) == is_sure
        assert not is_acceptable(State(elsewhere, odds, 0.5), _expected(true, 1.0), False), "out of reach"
        assert is_acceptable(State(true, odds, 0.5), expected, False), "it was expected"
    assert list_alike(_expected(true, 1.0), [(elsewhere, 0.0)]) == []


def test_the_places_that_look_like_a_photo(seen):
    """Its own is the best, in a heading that was not asked; others in the room are behind."""
    problem, true = seen
    places = find_places(problem, true, rooms.means())
    assert pose_errors(places[0][0], true)[0] < 0.1
    assert max(behind for _, behind in places[1:]) < places[0][1] <= 0.0
    off = _off(true, 1.0, 90.0)
    pose, behind = find_places(problem, off, rooms.means())[0]
    assert behind == 0.0  # what explains more than the pose given
    assert pose_errors(pose, true)[0] < 0.1


def test_a_mirrored_photo_is_told_near_a_pose_and_anywhere(seen):
    problem, true = seen
    rgb = np.ascontiguousarray(rooms.query(SEED).rgb[:, ::-1])
    mirrored = rooms.ask(rooms.as_panorama(rgb), problem.scan_map)
    for taken, wanted in ((problem, False), (mirrored, True)):
        for some, effort in (narrow_down(taken, true, 2.0, EFFORT), (taken, EFFORT.brief())):
            own = score_briefly(some, effort, WORKERS)
            assert (score_mirror(some, effort, WORKERS) > own) == wanted


def test_a_rough_place_is_refined_or_dropped(seen):
    problem, true = seen
    best = track(problem, true, WORKERS)
    own = State(best.pose, 5.0, best.score)
    wrong = State(_off(true, 1.5, 120.0), 5.0)
    assert refine_state(problem, [own, wrong], wrong, WORKERS) == [own]
    elsewhere = State(_off(true, 1.5, 120.0), 5.0, 0.2)
    rough = State(_off(true, 0.1, 3.0), 5.0)
    first, second = refine_state(problem, [elsewhere, rough], rough, WORKERS)
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
    problem, true = seen
    taken = _narrow(problem)
    starts = []

    def stay(problem, start, workers):
        """End where it began, as in a minimum."""
        starts.append(start)
        return start, start

    monkeypatch.setattr(near, "climb_from_afar", stay)
    end = track(taken, _off(true, 0.25, 4.0), WORKERS)
    assert pose_errors(starts[1], true)[0] < 0.1
    assert pose_errors(end.pose, true)[0] < 0.05
    track(problem, true, WORKERS)
    assert len(starts) == 3


def test_matches_that_put_a_narrow_photo_elsewhere_count_as_none(seen):
    taken = _narrow(seen[0])
    true = seen[1]
    here = near.assess_end(taken, examine(taken, true), WORKERS)
    assert here.num_matches > METHOD.chance_matches
    for metres, degrees in ((0.25, 0.0), (0.0, 6.0)):
        elsewhere = near.assess_end(taken, examine(taken, _off(true, metres, degrees)), WORKERS)
        assert elsewhere.num_matches == 0
    assert log_odds(here) > log_odds(elsewhere)
    for by_views in (seen[0], taken.by_views()):
        assert near.assess_end(by_views, examine(by_views, true), WORKERS).num_matches is None


@pytest.mark.parametrize(
    ("odds", "score", "is_found"), [(2.0, 0.2, True), (2.0, 0.02, False), (-0.1, 0.2, False)]
)
def test_an_end_that_is_unlikely_or_explains_nothing_is_none(odds, score, is_found):
    probability = 1.0 / (1.0 + np.exp(-odds))
    worse = Near(make_candidate(1.0, 0.5), None, 0.1 * probability)
    found = choose_end([Near(make_candidate(0.0, score), None, probability), worse])
    assert (found is not None) == is_found
    if is_found:
        assert (found.pose.center_world[0], found.score) == (0.0, score)


@pytest.fixture
def follower(seen):
    """A tracker with some frames, all with the same narrow photo; and the numbers whose pictures are read."""
    problem = seen[0]
    taken = _narrow(problem).given
    asked = []
    follower = tracker.Tracker(problem.scan_map, rooms.AUTO, WORKERS, Motion())
    odds = (4.0, 4.0, 4.0, MOST_EXPECTED, 4.0, 2.9)
    follower.lattice.frames.extend(Frame(0.5 * k, [State(seen[1], o)]) for k, o in enumerate(odds))
    follower.read = lambda k: asked.append(k) or taken
    return follower, asked


def test_a_narrow_photo_is_matched_with_the_frames_it_is_found_from(seen, follower, monkeypatch):
    """If these are sure by themselves; a whole photo is not."""
    problem, true = seen
    near = [(5, _off(true, 0.6, 0.0)), (4, _off(true, 0.5, 0.0)), (3, _off(true, 0.4, 0.0))]
    given = []
    monkeypatch.setattr(tracker, "find_near", lambda problem, expected, *_: given.append((problem, expected)))
    taken = _narrow(problem)
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
    walk.read = lambda k: rooms.as_panorama(rooms.query(SEED).rgb)
    assert walk.problem_of(5) is not None
    assert 5 not in walk.problems, "it is whole"
    walk.read = lambda k: None
    assert walk.problem_of(5) is None


def test_photos_beside_support_a_narrow_photo_where_they_agree(seen):
    problem, true = seen
    taken = _narrow(problem)
    here = examine(taken, true)
    alone = near.assess_end(taken, here, WORKERS).num_matches
    more = taken.photo.seen(WORKERS).keypoints.take(np.arange(2 * alone))
    located = verification.Located(more, np.full(2 * alone, 2.0, np.float32), true)
    others = verification.match_located(taken.photo.seen(WORKERS).keypoints, located)
    assert near.assess_end(replace(taken, beside=(others,)), here, WORKERS).num_matches > alone
    away = others._replace(points=others.points + np.float32(0.5))
    assert near.assess_end(replace(taken, beside=(away,)), here, WORKERS).num_matches == alone


@pytest.fixture(scope="module")
def confirmed(seen):
    """The problem of a narrow photo beside one that shows the same; and the pose of that, exact to 5 mm."""
    taken = _narrow(seen[0])
    located = verification.place_keypoints(taken, seen[1], WORKERS)
    matches = verification.match_located(taken.photo.seen(WORKERS).keypoints, located)
    exact = PoseGaussian(seen[1], np.diag(np.repeat([0.001**2, 0.005**2], 3)), np.zeros((6, 6)))
    return replace(taken, beside=(matches,)), exact


def test_a_narrow_photo_gains_where_a_sure_one_beside_confirms_its_pose(seen, confirmed):
    taken, exact = confirmed
    expected = _expected(_off(seen[1], 0.1, 3.0), 0.1)
    near, _ = narrow_down(taken, expected.last, expected.reach, EFFORT)
    for beside, gain in (((exact,), compute_gain(taken, near)), ((None,), 0.0)):
        found = find_near(taken, expected, rooms.means(), Told(beside=beside)).state
        assert found.gain == pytest.approx(gain, rel=0.01)
        assert pose_errors(found.pose, seen[1])[0] < (0.01 if gain else 0.05)
    unknown = find_near(replace(taken, beside=()), expected, rooms.means()).state
    assert unknown.gain == 0.0


def test_a_local_optimum_comes_to_the_pose_by_the_photo_beside(seen, confirmed):
    """The less likely it is right by itself, the more."""
    taken, exact = confirmed
    wrong = _off(seen[1], 0.12, 1.0)
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
    away = State(_off(seen[1], 0.5, 0.0), 1.0, 0.5, spread)
    assert join_beside(taken, away, (exact,)) == (away, 0.0)


def test_other_ends_make_a_narrow_photo_less_sure(seen):
    near, far = State(_off(seen[1], 0.05, 0.0), 1.0), State(_off(seen[1], 0.2, 0.0), 1.5)
    best = State(seen[1], 2.0)
    assert choose_held([near, best]) == best
    weighed = choose_held([near, best, far])
    assert (weighed.pose, weighed.log_odds) == (seen[1], pytest.approx(2.0 - np.log1p(np.exp(1.5))))


def test_a_narrow_photo_is_tracked_from_what_others_tell_within_reach(seen):
    true = seen[1]
    expected = _expected(true, 1.0)
    near, away = _off(true, 0.3, 10.0), _off(true, 9.0, 0.0)
    alike = [_off(true, 0.2 * k, 0.0) for k in range(1, 7)]
    starts = list_starts(expected, 0.0, alike, True, [away, near])
    assert starts == [Start(pose, False) for pose in (true, near, *alike[:4])]
    assert list_starts(expected, 0.0, alike, False, [near]) == [Start(true, False), Start(alike[0], False)]


def test_all_places_where_a_narrow_photo_was_not_found_are_as_likely_as_none(seen):
    """Views do not tell them apart; of one that is sure they are less likely, of a whole photo they count."""
    problem, true = seen
    own = [State(true, 1.6, 0.5)]
    unsure, sure = Result(), Result(LOCALIZED)
    rough = [s.log_odds for s in list_key_states(_narrow(problem), own, rooms.means(), unsure)[1:]]
    assert len(rough) > 3
    assert np.logaddexp.reduce(rough) <= -3.0 + 1e-9
    views = [s.log_odds for s in list_key_states(_narrow(problem), own, rooms.means())[1:]]
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
    taken = _narrow(problem).given
    shown = taken.is_valid & (np.abs(np.linspace(-0.5, 0.5, len(taken.is_valid)))[:, None] < 0.15)
    narrow = rooms.ask(replace(taken, is_valid=shown), problem.scan_map)
    walk = tracker.Tracker(problem.scan_map, rooms.AUTO, WORKERS, Motion())
    odds = float(np.log(probability / (1.0 - probability)))
    walk.lattice.add(Frame(0.0, [State(true, odds, 0.5)], is_key=True, departed=true))
    pose = _off(true, metres, degrees)
    frame = Frame(1.0, [State(pose, 2.0, 0.5)], key=0, arrived=pose)
    assert walk._is_doubtful(narrow, frame) == is_asked
    assert not walk._is_doubtful(problem, frame), "it is whole"


@pytest.mark.parametrize(("odds", "is_narrow"), [(3.5, True), (2.0, True), (3.5, False)])
def test_a_narrow_photo_is_tried_last_where_views_do_not_expect_it(seen, odds, is_narrow):
    true = seen[1]
    elsewhere = _off(true, 1.0, 0.0)
    expected = _expected(true, 2.0)
    starts = list_starts(expected, -9.0, list_alike(expected, [(elsewhere, 0.0)]), is_narrow)
    assert starts == [Start(elsewhere, False), *([Start(true, True)] if is_narrow else [])]
    assert is_acceptable(State(true, odds, 0.5), expected, True) == (odds > 3.0)
