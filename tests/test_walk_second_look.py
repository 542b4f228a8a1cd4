"""Frames of a walk that were lost or are not sure, looked at again when all the others are known."""

from types import SimpleNamespace

import numpy as np
import pytest
from key_frames import make_followed

from piccolo.geometry.pose import Pose
from piccolo.judge.result import Result
from piccolo.problem.accuracy import PAPER_ACCURACY
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.jobs.threads import no_progress
from piccolo.together.walk import path as walk_path, second_look
from piccolo.together.walk.frames import Frame, Motion, State
from piccolo.together.walk.path import NOTHING, Ranked, believe
from piccolo.together.walk.tracker import Followed, expect

TIMES = (9.0, 9.5, 10.0, 12.0)  # the third is lost
LOST = 2


def _at(x):
    return Pose(np.eye(3), np.array([x, 0.0, 0.0]))


@pytest.fixture
def walk():
    """Key frames along a line at 1 m/s, of which one is lost; and what is believed of each."""
    sure = [State(_at(time), 8.0, 0.5) for time in TIMES]
    both = zip(TIMES, sure, strict=True)
    frames = [Frame(time, [state], is_key=True, departed=state.pose) for time, state in both]
    frames[LOST] = Frame(TIMES[LOST])
    beliefs = [Ranked([state], np.array([0.99])) for state in sure]
    beliefs[LOST] = NOTHING
    probabilities = [belief.probabilities for belief in beliefs]

    def find(problem, frame, near):
        expected = expect(frame, [(frames[k], pose) for k, pose in near], Motion())
        return second_look.find_near(problem, expected, None)

    about = {"find": find, "problem_of": lambda k: k, "means": None}
    tracker = SimpleNamespace(frames=frames, motion=Motion(), settings=CoarseToFineSettings(), **about)
    return tracker, walk_path.Path(probabilities, [None] * len(frames)), beliefs


def _find(walk, monkeypatch, x, how="near", is_alone=True):
    """Look for the lost frame, which is found at a place; return it, and where it was expected."""
    asked = []

    def find(problem, expected, means):
        asked.append(expected)
        return Followed(State(_at(x), 5.0, 0.5), how, is_alone)

    monkeypatch.setattr(second_look, "find_near", find)
    tracker, path, beliefs = walk
    second_look._find_lost(tracker, path, beliefs, LOST)
    return tracker.frames[LOST], asked


def test_a_lost_frame_is_expected_from_the_sure_frames_nearest_in_time(walk, monkeypatch):
    frame, asked = _find(walk, monkeypatch, 10.1)
    assert [expected.last.center_world[0] for expected in asked] == [9.5]
    assert asked[0].pose.center_world[0] == pytest.approx(10.0)
    assert asked[0].reach == Motion().reach(0.5)
    assert (frame.key, frame.how, frame.is_key) == (1, "near", False)
    assert frame.arrived.center_world[0] == pytest.approx(10.1)
    assert walk[2][LOST].states[0].pose.center_world[0] == pytest.approx(10.1)


@pytest.mark.parametrize(("x", "is_alone"), [(7.5, True), (10.1, False)])
def test_a_place_out_of_reach_or_one_of_several_is_none(walk, monkeypatch, x, is_alone):
    """From the frame after it, at 12 m, one at 7.5 m could not have been reached in 2 s."""
    frame, asked = _find(walk, monkeypatch, x, "near", is_alone)
    assert len(asked) == 1
    assert frame == Frame(TIMES[LOST])
    assert walk[2][LOST] is NOTHING


def test_a_sure_frame_is_not_looked_for(walk, monkeypatch):
    walk[2][LOST] = walk[2][1]
    assert _find(walk, monkeypatch, 10.1)[1] == []


def test_a_frame_tracked_in_a_copy_is_tracked_where_it_is_expected(walk, monkeypatch):
    """Whatever looks like that place near it."""
    expected = _at(10.2)
    tracker, _, beliefs = walk
    tracker.frames[LOST].key = 1
    beliefs[LOST] = Ranked([State(expected, 4.0)], np.array([0.5]), expected)
    frame, asked = _find(walk, monkeypatch, 10.1, "tracked", is_alone=False)
    assert asked[0].pose is expected
    assert frame.arrived.center_world[0] == pytest.approx(10.1)


@pytest.mark.parametrize(
    ("probabilities", "is_refined", "listed"),
    [
        ([0.95, 0.04], [True, False], []),
        ([0.8, 0.15], [True, False], [1]),
        ([0.87, 0.05, 0.08], [True, False, False], [2]),
        ([0.7, 0.06, 0.09, 0.08, 0.07], [True] + 4 * [False], [2, 3, 4]),
        ([0.86, 0.09, 0.02, 0.02], [True, False, False, False], [1]),
        ([0.4, 0.09, 0.09], [True, False, False], []),
        ([0.04, 0.4, 0.3], [True, False, False], [1, 2]),
    ],
)
def test_rough_places_are_refined_if_they_leave_another_unsure(probabilities, is_refined, listed):
    """Of those that do so together, as many as leave it sure without them."""
    states = [State(_at(5.0 * k), 1.0, 0.5 if r else None) for k, r in enumerate(is_refined)]
    tracker = SimpleNamespace(frames=[Frame(0.0, states, is_key=True)])
    path = walk_path.Path([np.array(probabilities)], [None])
    assert second_look._list_rough(tracker, path, 0) == listed


def test_frames_that_are_not_sure_are_searched_some_of_each_run():
    sure = Ranked([State(_at(0.0), 8.0, 0.5)], np.array([0.99]))
    unsure = NOTHING
    demand = CoarseToFineSettings().demand
    frames = [Frame(float(k)) for k in range(60)]
    beliefs = [unsure] * 2 + [sure] + [unsure] * 57
    assert second_look.list_unsure(frames, beliefs, demand) == [0, 1, *range(5, 60, 5)]
    frames[1].alone = Result()
    assert second_look.list_unsure(frames, beliefs, demand)[:2] == [0, 5]
    assert second_look.list_unsure(frames[:3], [sure] * 3, demand._replace(min_confidence=0.999)) == [0, 2]


@pytest.mark.parametrize(
    ("x", "is_sure", "is_tracked", "is_taken"),
    [
        (10.1, True, True, True),
        (10.1, False, True, False),
        (10.1, False, False, True),
        (30.0, True, False, False),
    ],
)
def test_a_frame_that_is_sure_alone_joins_the_walk_if_it_is_within_reach(
    walk, x, is_sure, is_tracked, is_taken
):
    tracker, _, beliefs = walk
    before = tracker.frames[LOST]
    before.states = [State(_at(10.2), 1.0, 0.5)] if is_tracked else []
    alone = Result("localized" if is_sure else "ambiguous")

    def search(problem, frame):
        frame.alone = alone
        frame.states = [State(_at(x), 4.0, 0.5)]
        frame.is_key = True

    tracker.search = search
    assert second_look._search_unsure(tracker, beliefs, no_progress) == is_taken
    assert tracker.frames[LOST].is_key == is_taken
    assert tracker.frames[LOST].alone is alone
    assert (tracker.frames[LOST] is before) != is_taken


def test_a_pose_that_found_a_frame_before_stays_if_it_is_likelier(walk, monkeypatch):
    tracker, path, beliefs = walk
    tracker.frames[LOST] = make_followed(TIMES[LOST], 1, (10, 0, 0), 2.0)
    beliefs[LOST] = believe(tracker.frames, path, LOST)
    assert 0.8 < beliefs[LOST].confidence(PAPER_ACCURACY) < 0.9
    before = tracker.frames[LOST]

    def find_worse(problem, frame, near):
        return Followed(State(_at(10.1), 1.0, 0.5), "tracked", True)

    tracker.find = find_worse
    second_look._find_lost(tracker, path, beliefs, LOST)
    assert tracker.frames[LOST] is before
