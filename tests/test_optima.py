"""Optima near a photo's own pose, and how far they make it uncertain."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from made_up import PARTIAL, PROBLEM, make_candidate, make_selection, move

from piccolo.geometry.pose import Pose
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.alternatives import Hypothesis
from piccolo.judge.belief import make_belief
from piccolo.judge.result import nothing_found
from piccolo.together import optima
from piccolo.together.bundle_search import Support
from piccolo.together.optima import spread_optima, widen_unsure

OWN = make_candidate(0.0, 0.6, num_matches=20)
ALONG_X = np.diag([1e-8, 1e-8, 1e-8, 0.03**2, 0.01**2, 0.005**2])  # which is determined least
GAUSSIAN = PoseGaussian(OWN.pose, ALONG_X, np.zeros((6, 6)))


def _spread(monkeypatch, end_of, score, num_matches=20):
    """Errors by optima: descents from x [m] end at `end_of(x)`, where the photo has another score."""

    def descend(problem, start, workers, stage):
        return Hypothesis(Pose(OWN.pose.R_cam_from_world, [end_of(start.center_world[0]), 0.0, 0.0]), score)

    def examine(problem, poses, workers):
        return [make_candidate(pose.center_world[0], score, num_matches) for pose in poses]

    monkeypatch.setattr(optima, "refine", descend)
    monkeypatch.setattr(optima, "examine_each", examine)
    problem = replace(PROBLEM, profile=PARTIAL)
    return spread_optima(problem, OWN, GAUSSIAN, rooms.WORKERS)


def test_descents_that_lead_back_add_nothing(monkeypatch):
    assert np.allclose(_spread(monkeypatch, lambda _: 0.0, OWN.score), 0.0)


def test_an_end_that_explains_as_much_counts_with_its_whole_distance(monkeypatch):
    """Half of the starts end 0.2 m away along x."""
    spread = _spread(monkeypatch, lambda x: 0.2 if x > 0.01 else 0.0, OWN.score)
    (along,) = np.flatnonzero(np.diag(spread) > 1e-6)
    assert along == 3
    assert 0.05 < np.sqrt(spread[3, 3]) < 0.15


@pytest.mark.parametrize(("score", "num_matches"), [(0.3, 20), (0.6, 2)])
def test_an_end_counts_less_if_it_explains_less_or_fewer_matches_agree(monkeypatch, score, num_matches):
    away = _spread(monkeypatch, lambda _: 0.2, OWN.score)
    less = _spread(monkeypatch, lambda _: 0.2, score, num_matches)
    assert less[3, 3] < 0.4 * away[3, 3]


def test_an_end_in_another_place_does_not_count(monkeypatch):
    assert np.allclose(_spread(monkeypatch, lambda _: 0.7, OWN.score), 0.0)


def _member(status):
    """A photo with the status that it has alone, whose best pose is its own."""
    alone = replace(nothing_found().take_belief(make_belief([0.95]), 0.9), status=status)
    problem = SimpleNamespace(forget=lambda: None)
    found = SimpleNamespace(problem=problem, selection=make_selection(OWN))
    return SimpleNamespace(found=found, alone=alone, is_best=lambda pose: pose.distance(OWN.pose) < 0.5)


def test_only_own_poses_that_are_not_sure_alone_are_widened(monkeypatch):
    monkeypatch.setattr(optima, "spread_optima", lambda *_: np.eye(6))
    support = Support(OWN, GAUSSIAN, is_found=True, odds=50.0, odds_elsewhere=0.1, num_places=100)
    supports = {
        0: support,  # sure there
        1: support._replace(own=move(OWN, 3.0)),  # sure elsewhere
        2: support,  # not sure
        3: support._replace(gaussian=None),
        4: support._replace(odds=0.0),  # it shows nothing of the place
    }
    members = {k: _member("localized" if k < 2 else "ambiguous") for k in supports}
    widened = widen_unsure(members, supports, rooms.WORKERS)
    changed = {k for k, one in widened.items() if one is not supports[k]}
    assert list(widened) == list(supports)
    assert changed == {1, 2}
    assert np.allclose(widened[2].gaussian.own, ALONG_X + np.eye(6))
