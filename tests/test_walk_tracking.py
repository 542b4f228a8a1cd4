"""One frame, when it is known about where the camera was."""

import numpy as np
import pytest
import rooms
import tracked
from made_up import make_candidate
from rooms import WORKERS

from piccolo.geometry.pose import pose_errors
from piccolo.localization import ladder
from piccolo.localization.beam import score_briefly, score_mirror
from piccolo.localization.near import Near
from piccolo.problem.method import METHOD
from piccolo.together.walk.expectation import (
    ExpectedFrame,
    Start,
    describe_end,
    expect,
    is_acceptable,
    list_alike,
    list_starts,
    predict,
)
from piccolo.together.walk.following import (
    choose_end,
    find_near,
    refine_state,
    track,
)
from piccolo.together.walk.frames import Frame, Motion, State
from piccolo.together.walk.places import find_places, narrow_down

TIER = "scene"


@pytest.fixture
def seen():
    return tracked.seen()


def test_a_descent_goes_on_around_its_end_while_that_helps(seen):
    problem, true = seen
    workers, done = rooms.listen()
    batches = len(ladder.perturbations(METHOD, 1.0)) // ladder.PERTURBED_BATCH
    end = track(problem, true, workers)
    assert pose_errors(end.pose, true)[0] < 0.02
    assert end.log_odds > 4.0
    assert done.count(("descend", batches)) == 1
    far = track(problem, tracked.off(true, 0.6, 20.0), workers)
    assert pose_errors(far.pose, true)[0] < 0.02
    assert track(problem, tracked.off(true, 2.0, 90.0), workers) is None
    assert 3 < done.count(("descend", batches)) <= 1 + 2 * METHOD.most_perturbations


def test_a_camera_is_expected_by_its_motion_before_or_by_an_odometry(seen):
    _, true = seen
    before = tracked.off(true, -0.35, 0.0)
    frame = Frame(1.0)
    assert expect(frame, [(Frame(0.5), true)], Motion()) == ExpectedFrame(true, Motion().reach(0.5), true)
    walked = expect(frame, [(Frame(0.5), true), (Frame(0.0), before)], Motion())
    assert (walked.last, walked.reach) == (true, Motion().reach(0.5))
    assert pose_errors(walked.pose, tracked.off(true, 0.35, 0.0))[0] == pytest.approx(0.0, abs=1e-9)
    slow = expect(frame, [(Frame(0.5), true), (Frame(0.0), before)], Motion(max_speed=0.01))
    assert pose_errors(slow.pose, true)[0] == pytest.approx(slow.reach)
    measured = [Frame(time, odometry=tracked.off(true, time, 0.0)) for time in (0.5, 1.0)]
    moved = expect(measured[1], [(measured[0], true), (Frame(0.0), before)], Motion())
    assert moved.last is moved.pose
    assert pose_errors(moved.pose, tracked.off(true, 0.5, 0.0))[0] == pytest.approx(0.0, abs=1e-9)


def test_a_frame_is_found_where_it_is_expected_or_near(seen):
    problem, true = seen
    for off, how in ((tracked.off(true, 0.1, 5.0), "tracked"), (tracked.off(true, 1.6, 120.0), "near")):
        found = find_near(problem, tracked.expected(off, 1.0), rooms.means())
        assert (found.how, found.is_alone) == (how, True)
        assert pose_errors(found.state.pose, true)[0] < 0.02
    assert (
        find_near(problem, tracked.expected(off, 1.0, tracked.off(true, 0.3, 5.0)), rooms.means()).how
        == "tracked"
    )
    far = find_near(problem, tracked.expected(off, 10.0), rooms.means())
    assert pose_errors(far.state.pose, true)[0] < 0.02
    for seconds in (1.0, 10.0):
        assert (
            find_near(problem, tracked.expected(tracked.off(true, 50.0, 0.0), seconds), rooms.means()) is None
        )
    rgb = np.ascontiguousarray(rooms.query(tracked.SEED).rgb[:, ::-1])
    mirrored = rooms.ask(rooms.as_panorama(rgb), problem.scan_map)
    assert find_near(mirrored, tracked.expected(true, 1.0), rooms.means()) is None


def test_a_frame_gains_by_the_few_places_within_reach(seen):
    problem, true = seen
    own = find_near(problem, tracked.expected(true, 0.1), rooms.means()).state
    near, _ = narrow_down(problem, true, Motion().reach(0.1), rooms.AUTO.effort)
    share = len(near.scan_map.sparse) / len(problem.scan_map.sparse)
    assert 0.0 < own.gain == pytest.approx(min(-np.log(share), 3.0))
    all_places = find_near(problem, tracked.expected(true, 60.0), rooms.means())  # are within reach
    assert all_places.state.gain == 0.0
    assert find_near(tracked.narrow(problem), tracked.expected(true, 0.1), rooms.means()).state.gain == 0.0


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
    elsewhere = tracked.off(true, 3.0, 0.0)
    expected = tracked.expected(true, 2.0)
    alike = list_alike(expected, [(elsewhere, min(behind, 0.0))])
    first = list_starts(expected, min(-behind, 0.0), alike, False)[0]
    found = describe_end(State(first.pose, 3.5, 0.5), expected, alike)
    assert is_acceptable(found.state, expected, first.must_be_sure)
    assert found.state.pose is {"expected": true, "elsewhere": elsewhere}[at]
    assert (found.how, found.is_alone) == (how, is_alone)


def test_the_best_place_near_is_tried_if_nothing_is_found_where_it_was_expected(seen):
    true = seen[1]
    elsewhere = tracked.off(true, 3.0, 0.0)
    expected = tracked.expected(true, 2.0)
    alike = list_alike(expected, [(elsewhere, 0.0), (tracked.off(true, 2.0, 0.0), -1.0)])
    assert list_starts(expected, 0.0, alike, False) == [Start(true, False), Start(elsewhere, False)]
    for odds, is_sure in ((3.5, True), (2.0, False)):
        assert is_acceptable(State(elsewhere, odds, 0.5), expected, False) == is_sure
        assert not is_acceptable(State(elsewhere, odds, 0.5), tracked.expected(true, 1.0), False), (
            "out of reach"
        )
        assert is_acceptable(State(true, odds, 0.5), expected, False), "it was expected"
    assert list_alike(tracked.expected(true, 1.0), [(elsewhere, 0.0)]) == []


def test_the_places_that_look_like_a_photo(seen):
    """Its own is the best, in a heading that was not asked; others in the room are behind."""
    problem, true = seen
    places = find_places(problem, true, rooms.means())
    assert pose_errors(places[0][0], true)[0] < 0.1
    assert max(behind for _, behind in places[1:]) < places[0][1] <= 0.0
    off = tracked.off(true, 1.0, 90.0)
    pose, behind = find_places(problem, off, rooms.means())[0]
    assert behind == 0.0  # what explains more than the pose given
    assert pose_errors(pose, true)[0] < 0.1


def test_a_mirrored_photo_is_told_near_a_pose_and_anywhere(seen):
    problem, true = seen
    rgb = np.ascontiguousarray(rooms.query(tracked.SEED).rgb[:, ::-1])
    mirrored = rooms.ask(rooms.as_panorama(rgb), problem.scan_map)
    for taken, wanted in ((problem, False), (mirrored, True)):
        for some, effort in (
            narrow_down(taken, true, 2.0, rooms.AUTO.effort),
            (taken, rooms.AUTO.effort.brief()),
        ):
            own = score_briefly(some, effort, WORKERS)
            assert (score_mirror(some, effort, WORKERS) > own) == wanted


def test_a_rough_place_is_refined_or_dropped(seen):
    problem, true = seen
    best = track(problem, true, WORKERS)
    own = State(best.pose, 5.0, best.score)
    wrong = State(tracked.off(true, 1.5, 120.0), 5.0)
    assert refine_state(problem, [own, wrong], wrong, WORKERS) == [own]
    elsewhere = State(tracked.off(true, 1.5, 120.0), 5.0, 0.2)
    rough = State(tracked.off(true, 0.1, 3.0), 5.0)
    first, second = refine_state(problem, [elsewhere, rough], rough, WORKERS)
    assert pose_errors(first.pose, true)[0] < 0.02
    assert first.log_odds > elsewhere.log_odds
    assert second is elsewhere


def test_a_camera_goes_on_as_it_went_but_no_farther_than_it_can(seen):
    _, true = seen
    ahead = predict(true, tracked.off(true, -0.4, -10.0), 0.5, 9.0)
    distance, angle = pose_errors(ahead, tracked.off(true, 0.2, 5.0))
    assert (distance, np.degrees(angle)) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert np.linalg.norm(
        predict(true, tracked.off(true, -4.0, 0.0), 1.0, 0.5).center_world - true.center_world
    ) == (pytest.approx(0.5))


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
