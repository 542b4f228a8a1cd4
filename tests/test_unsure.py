"""Which photos of a group help to find the rest, and which are doubted; without a scan."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from piccolo import CoarseToFineSettings
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.belief import make_belief
from piccolo.judge.result import Result
from piccolo.together import unsure
from piccolo.together.members import Grouped, Shot
from piccolo.together.nearby import Witness
from piccolo.together.unsure import list_strays, localize_rest

TIER = "pure"

SURE = Result(status="localized", belief=make_belief([0.95]))
UNSURE = Result(belief=make_belief([0.6]))


def _gaussian(x):
    """Where a photo was taken, by itself."""
    errors = np.diag(np.repeat([1e-4, 2e-4], 3))
    return PoseGaussian(Pose(yaw_rotation(x), np.array([x, 0.0, 0.0])), errors, np.zeros((6, 6)))


def _sure_at(x, *others):
    return Grouped(replace(SURE, gaussian=_gaussian(x)), others)


@pytest.fixture
def asked(monkeypatch):
    """Let photos be found near the others from the round that is told for each; note who was asked for."""
    calls = []
    given = []
    found_in = {}
    before_each = []

    class Searched(int):
        """A photo's number, in place of its poses near the others."""

        def forget(self):
            return self

    def search_nearby(scan_map, shot, others, means, before):
        before_each.append(before)
        return Searched(shot.panorama)

    def localize_nearby(scan_map, searched, alone, located, means, demand):
        number = int(searched)
        calls.append((number, len(located)))
        given.append(located)
        sure_with, found_with = found_in[number]
        result = SURE if len(located) >= sure_with else UNSURE
        held = SimpleNamespace(alone=_gaussian(0.1 * number))
        return SimpleNamespace(result=result, held=held) if len(located) >= found_with else None

    def doubt_stray(scan_map, shot, alone, located, num_strays, means):
        calls.append((shot.panorama, len(located)))
        return UNSURE

    monkeypatch.setattr(unsure, "search_nearby", search_nearby)
    monkeypatch.setattr(unsure, "localize_nearby", localize_nearby)
    monkeypatch.setattr(unsure, "doubt_stray", doubt_stray)
    monkeypatch.setattr(unsure, "take_average", lambda result, *_: result)
    return SimpleNamespace(calls=calls, given=given, found_in=found_in, before_each=before_each)


def _localize(grouped):
    shots = [Shot(number, CoarseToFineSettings()) for number in grouped]
    return localize_rest(None, shots, grouped, None)


def test_photos_that_are_sure_near_others_help_to_find_further_ones(asked):
    grouped = {k: _sure_at(0.1 * k) for k in range(3)} | {k: Grouped(UNSURE, ()) for k in (3, 4, 5, 6)}
    asked.found_in |= {3: (3, 3), 4: (4, 3), 5: (9, 3), 6: (5, 4)}
    rest = _localize(grouped)
    assert rest[3].result is rest[4].result is SURE
    assert (rest[3].others, rest[4].others) == ((0, 1, 2), (0, 1, 2, 3))
    assert rest[5].result is UNSURE
    assert rest[6].result is SURE, "who is not found at first is asked again"
    assert asked.calls == [(3, 3), (4, 3), (5, 3), (6, 3), (4, 4), (5, 4), (6, 4), (5, 5), (6, 5)]
    assert asked.before_each == [None] * 4 + [4, 5, 6, 5, 6], "its poses near them are handed on"


def test_without_news_nobody_is_asked_again(asked):
    grouped = {k: _sure_at(0.1 * k) for k in range(3)} | {3: Grouped(UNSURE, ())}
    asked.found_in[3] = (9, 0)
    assert _localize(grouped)[3].result is UNSURE
    assert asked.calls == [(3, 3)]


def test_one_photo_that_is_sure_of_its_place_tells_the_others_if_not_how_exactly(asked):
    """It may be found more exactly by those that it helped."""
    is_vague = replace(SURE, status="not_localized", belief=make_belief([0.95], 0.5), gaussian=_gaussian(0.0))
    grouped = {0: Grouped(is_vague, ()), 1: Grouped(UNSURE, ())}
    asked.found_in |= {0: (1, 1), 1: (1, 1)}
    rest = _localize(grouped)
    assert rest[1] == Grouped(SURE, (0,))
    assert rest[0] == Grouped(SURE, (1,))
    assert asked.calls == [(1, 1), (0, 1)]
    assert [one.probability for (one,) in asked.given] == [0.95, 0.95], (
        "who was found hands on how sure it is"
    )


def test_a_photo_whose_calibration_is_doubted_tells_nobody(asked):
    doubted = replace(UNSURE, belief=make_belief([0.99], doubt=0.2), gaussian=_gaussian(0.0))
    assert _localize({0: Grouped(doubted, ()), 1: Grouped(UNSURE, ())}) == {}
    assert asked.calls == []


def test_a_sure_photo_elsewhere_is_doubted_and_helps_nobody(asked):
    grouped = {k: _sure_at(0.1 * k) for k in range(3)} | {3: _sure_at(8.0), 4: Grouped(UNSURE, ())}
    asked.found_in[4] = (9, 9)
    assert _localize(grouped)[3] == Grouped(UNSURE, (0, 1, 2))
    assert asked.calls == [(4, 3), (3, 3)]


def test_one_that_is_there_together_with_another_is_not_doubted(asked):
    grouped = {k: _sure_at(0.1 * k) for k in range(3)} | {3: _sure_at(8.0, 4), 4: _sure_at(8.2, 3)}
    assert _localize(grouped)[3].result.status == "localized"
    assert asked.calls == []


@pytest.mark.parametrize(("positions", "strays"), [((0, 0.3, 0.6, 9), [3]), ((0, 0.3, 9), []), ((0, 9), [])])
def test_photos_at_no_spot_are_strays_if_others_are_at_one(positions, strays):
    assert list_strays({k: Witness(_gaussian(x), 0.95) for k, x in enumerate(positions)}) == strays
