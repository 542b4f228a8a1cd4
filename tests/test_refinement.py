"""Decisions of the default method, each in a made-up case where one rule changes the outcome."""

import functools
import types
from types import SimpleNamespace

import numpy as np
import pytest
import rooms

from piccolo.coarse_to_fine import evaluation, refinement
from piccolo.coarse_to_fine import localize as method
from piccolo.coarse_to_fine.config import METHOD, Beam
from piccolo.coarse_to_fine.query import prepare_query
from piccolo.coarse_to_fine.search_result import SearchResult
from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.coarse_to_fine.starts import Starts, best_and_alternatives, narrow
from piccolo.confidence.alternatives import Hypothesis
from piccolo.confidence.score import Agreement
from piccolo.geometry.pose import Pose, step, yaw_rotation
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers

QUERY = SimpleNamespace(workers=Workers(1), method=METHOD, scan_map=SimpleNamespace(octree=None))


def _at(x, score, yaw_deg=0.0):
    return Hypothesis(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


@functools.lru_cache
def _query(seed):
    return prepare_query(rooms.scene(seed)[1], rooms.scan_map(seed), CoarseToFineSettings(), Workers(2))


def _places(hypotheses):
    return [round(float(h.pose.center_world[0]), 6) for h in hypotheses]


# The beam


def test_a_quarter_of_the_beam_is_for_the_best_that_lie_far_apart():
    """Twenty poses in a row 0.2 m apart, and behind them two at other places."""
    x = np.concatenate([0.2 * np.arange(20), [50.0, 60.0]])
    rotations, centers = np.repeat(np.eye(3)[None], 22, axis=0), np.outer(x, [1.0, 0, 0])
    kept = best_and_alternatives(rotations, centers, 8, 0.15)
    assert kept.tolist() == [0, 1, 2, 3, 4, 5, 6, 9]  # six near ones; of those half a metre apart, two more
    few = np.concatenate([np.arange(6), [20, 21]])
    assert best_and_alternatives(rotations[few], centers[few], 6, 0.15).tolist() == [0, 1, 2, 3, 4, 6]
    assert best_and_alternatives(rotations, centers, 8, 0.3).tolist() == [0, 2, 3, 4, 6, 8, 9, 10]


def test_narrow_ranks_hypotheses_first(monkeypatch):
    close = [_at(0.0, 0.5), _at(0.05, 0.9), _at(3.0, 0.1), _at(5.0, 0.7)]
    assert _places(narrow(close, 4)) == [0.05, 5.0, 3.0]
    assert _places(narrow(close, 1)) == [0.05]
    turned = [_at(0.0, 0.9), _at(0.09, 0.8), _at(0.11, 0.7), _at(0.0, 0.6, 4.9), _at(0.0, 0.5, 5.1)]
    assert [h.score for h in narrow(turned, 8)] == [0.9, 0.7, 0.5]
    R, centers = np.repeat(np.eye(3)[None], 3, axis=0), np.outer([0.0, 0.14, 0.16], [1.0, 0, 0])
    starts = Starts(R, centers, np.arange(3), np.array([0.3, 0.2, 0.1]))
    monkeypatch.setattr(refinement, "descend_all", lambda scan_map, image, starts, *_: starts)
    query = SimpleNamespace(**vars(QUERY), images=SimpleNamespace(search=None))
    assert refinement.descend_prepared(query, starts, 5, 8).candidate.tolist() == [0, 2]


def test_halving_keeps_as_many_as_the_beam_says(monkeypatch):
    calls = []

    def descend_prepared(query, starts, num_iterations, count):
        calls.append((num_iterations, count))
        return starts.take(np.arange(min(count, len(starts.score))))

    def gaining(name, gain):
        def function(query, h):
            calls.append(name)
            return Hypothesis(h.pose, h.score + gain)

        return function

    monkeypatch.setattr(refinement, "descend_prepared", descend_prepared)
    for name, gain in (("descend_middle", 0.1), ("perturb_middle", 0.1), ("descend_fine", 0.1)):
        monkeypatch.setattr(refinement, name, gaining(name, gain))
    monkeypatch.setattr(refinement, "refine_by_perturbation", gaining("perturb", 0.5))
    centers = np.outer(np.arange(40.0), [1.0, 0, 0])
    R, index = np.repeat(np.eye(3)[None], 40, axis=0), np.arange(40)
    starts = Starts(R, centers, index, 0.5 - 0.01 * index)
    fine, middle = refinement.refine(QUERY, starts, Beam(30, 12, 5, 2))
    assert calls[:2] == [(5, 30), (12, 12)]
    stages = ("descend_middle", "perturb_middle", "descend_fine", "perturb")
    assert [calls.count(name) for name in stages] == [12, 5, 5, 2]
    assert _places(fine) == [0, 1, 0, 1, 2, 3, 4]
    assert fine[0].score == pytest.approx(0.5 + 0.3 + 0.5)
    assert _places(middle) == list(range(12))


# Perturbations and the last millimetres


def test_each_stage_has_its_view_its_image_and_its_limits(monkeypatch):
    asked = []
    monkeypatch.setattr(refinement, "render_view", lambda octree, center, view: view)
    monkeypatch.setattr(refinement, "visible_points", lambda octree, center, view, count: (view, count))
    monkeypatch.setattr(refinement, "descend", lambda *arguments: asked.append(arguments) or arguments[3])
    monkeypatch.setattr(refinement, "score_on", lambda cells, center, image, pose: 0.5)
    query = SimpleNamespace(**vars(QUERY), images=SimpleNamespace(full="full", fine="fine", middle="middle"))
    h, full = _at(1.0, 0.2), (METHOD.full_view, 30_000)
    refinement.descend_middle(query, h)
    assert refinement.descend_fine(query, h).score == 0.5
    refinement.refine_full_resolution(query, h, 1)
    refinement.settle(query, h)
    assert [(cells, image, *limits) for cells, _, image, _, limits in asked] == [
        (METHOD.middle_view, "middle", 1.2, 12, 1e-3),
        (METHOD.fine_view, "fine", 1.0, 12, 1e-4),
        (full, "full", 0.7, 10, 1e-4),
        (full, "full", 0.7, 30, 1e-7),
    ]


@pytest.mark.parametrize(
    ("gains", "rounds", "expected"),
    [([0.2, 0.02, 0.005, 1], 3, 0.725), ([0.1] * 9, 5, 1.0), ([-0.3, 0.5], 1, 0.5), ([0.1, -0.1, 1], 2, 0.6)],
)
def test_poses_are_perturbed_for_as_long_as_that_helps(monkeypatch, gains, rounds, expected):
    left, sizes = list(gains), []

    def around(cells, images, pose, size):
        sizes.append(size)
        assert images == ("middle", "fine")
        return Hypothesis(pose, score[0])

    def fine(query, h):
        score[0] += left.pop(0)
        return Hypothesis(h.pose, score[0])

    score = [0.5]
    monkeypatch.setattr(refinement, "render_view", lambda *_: None)
    monkeypatch.setattr(refinement, "descend_around", around)
    monkeypatch.setattr(refinement, "descend_fine", fine)
    query = SimpleNamespace(**vars(QUERY), images=SimpleNamespace(middle="middle", fine="fine"))
    found = refinement.refine_by_perturbation(query, _at(0.0, 0.5))
    assert found.score == pytest.approx(expected)
    assert sizes == [0.4] * rounds


@pytest.mark.parametrize(("after", "is_taken"), [(0.60, True), (0.515, True), (0.505, False), (0.1, False)])
def test_full_resolution_is_taken_back_where_the_score_falls(monkeypatch, after, is_taken):
    """By a hundredth at most may it fall, in exchange for millimetres."""
    moved, start = _at(0.004, 0.0).pose, _at(0.0, 0.52)
    query = SimpleNamespace(**vars(QUERY), images=SimpleNamespace(full="full"))
    asked, descents = [], []
    monkeypatch.setattr(refinement, "score_at", lambda _, pose: 0.52 if pose is start.pose else after)
    monkeypatch.setattr(refinement, "visible_points", lambda octree, center, *_: asked.append(center[0]))
    monkeypatch.setattr(refinement, "descend", lambda *arguments: descents.append(arguments[-1]) or moved)
    expected = Hypothesis(moved, after) if is_taken else start
    assert refinement.refine_full_resolution(query, start, 2) == expected
    assert asked == [0.0, 0.004]  # the points are taken anew from where the pose is
    assert refinement.settle(query, start) == expected
    assert len(asked) == len(descents) == 4  # the second round of settling moves nothing
    monkeypatch.setattr(refinement, "descend", lambda *arguments: _at(len(asked), 0.0).pose)
    refinement.settle(query, start)
    assert len(asked) == 10  # six rounds at most


@pytest.mark.parametrize(("seed", "most"), [(1, 5e-4), (2, 5e-5), (3, 2e-4)])
def test_the_end_hardly_depends_on_where_the_descent_begins(seed, most):
    """Starts 5 mm apart end within 0.05 mm where the loss has one minimum; in noise it has several."""
    query, true_pose = _query(seed), rooms.scene(seed)[2]
    ends = [
        refinement.settle(query, Hypothesis(step(true_pose, np.array([0, 0, 0, *d])), 0.0)).pose
        for d in ([0.002, 0.001, 0.0], [-0.002, -0.001, 0.002])
    ]
    distance, angle_deg = rooms.errors(*ends)
    assert distance < most
    assert angle_deg < 0.03
    again = refinement.settle(query, Hypothesis(ends[0], 0.0)).pose
    assert rooms.errors(again, ends[0])[0] < 2e-5
    assert rooms.errors(ends[0], true_pose)[0] < 0.01


# Attempts and alternatives


def test_alternatives_that_come_near_are_refined_and_the_better_wins(monkeypatch):
    """The second gains by refinement and wins; one with less than 0.4 of the best score stays."""
    gains = {0.0: 9.0, 3.0: 0.25, 6.0: 0.01, 9.0: 9.0}
    refined = []

    def perturbed(query, h):
        refined.append(h.pose.center_world[0])
        return Hypothesis(h.pose, h.score + gains[refined[-1]])

    monkeypatch.setattr(method, "refine_by_perturbation", perturbed)
    monkeypatch.setattr(method, "refine_full_resolution", lambda query, h, n: h if n == 2 else None)
    result = SearchResult(_at(0.0, 0.5), (_at(3.0, 0.4), _at(6.0, 0.3), _at(9.0, 0.19)))
    found = method.refine_alternatives(QUERY, result)
    assert refined == [3.0, 6.0]
    assert (found.best.pose.center_world[0], found.best.score) == (3.0, pytest.approx(0.65))
    assert _places(found.alternatives) == [0.0, 6.0, 9.0]
    assert [h.score for h in found.alternatives] == pytest.approx([0.5, 0.31, 0.19])


def test_a_search_is_confident_by_score_and_margin():
    for score, other, is_sure in ((0.25, 0.1, True), (0.24, 0, False), (0.5, 0.35, True), (0.5, 0.36, False)):
        assert SearchResult(_at(0.0, score), (_at(3.0, other),)).is_confident == is_sure


def _run(monkeypatch, attempts, gravity="auto", refined=types.MappingProxyType({})):
    """Localize with made-up attempts, lists of hypotheses; the attempts made, and what is evaluated."""
    made, left = [], list(attempts)
    scan_map = SimpleNamespace(centers=np.zeros((1, 3)))

    def refine(query, starts, beam):
        made.append((starts, "wide" if beam is METHOD.wide_beam else "narrow"))
        return left.pop(0), []

    def perturbed(query, h):
        return Hypothesis(h.pose, refined.get(h.pose.center_world[0], h.score))

    monkeypatch.setattr(method, "apply_prior", lambda *_: scan_map)
    monkeypatch.setattr(method, "prepare_query", lambda *_: QUERY)
    monkeypatch.setattr(method, "search_poses", lambda query, gravity: gravity)
    monkeypatch.setattr(method, "refine", refine)
    monkeypatch.setattr(method, "refine_by_perturbation", perturbed)
    monkeypatch.setattr(method, "refine_full_resolution", lambda query, h, num_rounds: h)
    monkeypatch.setattr(method, "settle", lambda query, h: Hypothesis(h.pose, h.score + 0.001))
    monkeypatch.setattr(method, "evaluate", lambda query, panorama, found: found)
    settings = CoarseToFineSettings(gravity=gravity)
    found = method.localize(None, rooms.scene(1)[1], settings, Workers(1), Stopwatch())
    return made, found


@pytest.mark.parametrize(
    ("attempts", "gravity", "num_made", "best"),
    [
        ([[_at(1, 0.6)]], "auto", 1, 1),
        ([[_at(1, 0.2)], [_at(2, 0.6)]], "auto", 2, 2),
        ([[_at(1, 0.2)], [_at(2, 0.1)], [_at(3, 0.15)], [_at(4, 0.12)]], "auto", 4, 1),
        ([[_at(1, 0.02)], [_at(2, 0.04)]], "auto", 2, 2),  # hopeless: no wider beam
        ([[_at(1, 0.2)], [_at(2, 0.5)]], "known", 2, 2),
        ([[_at(1, 0.5), _at(9, 0.45)], [_at(1.1, 0.495)]], "unknown", 2, 1.1),  # a later one may lose 0.01
        ([[_at(1, 0.5), _at(9, 0.45)], [_at(1.1, 0.489)]], "unknown", 2, 1),
    ],
)
def test_attempts_are_made_until_one_is_confident(monkeypatch, attempts, gravity, num_made, best):
    made, found = _run(monkeypatch, attempts, gravity)
    order = [("known", "narrow"), ("unknown", "narrow"), ("known", "wide"), ("unknown", "wide")]
    assert made == [way for way in order if gravity in ("auto", way[0])][:num_made]
    assert found.best.pose.center_world[0] == best
    assert found.best.score in {h.score + 0.001 for some in attempts for h in some}  # settled


def test_a_confident_attempt_whose_alternative_gains_by_refinement_is_not_the_last(monkeypatch):
    attempts = [[_at(1, 0.6), _at(5, 0.3)], [_at(7, 0.9)]]
    made, found = _run(monkeypatch, attempts, refined={5.0: 0.55})
    assert len(made) == 2
    assert _places([found.best]) == [7]


# Evaluation


def test_evidence_counts_alternatives_that_are_local_minima(monkeypatch):
    """Of three alternatives the second is a minimum: it is told first, and its score counts."""
    scan_map = SimpleNamespace(points=None, coarse_points=None, to_world=lambda pose: pose)
    query = SimpleNamespace(scan_map=scan_map, settings=CoarseToFineSettings())
    values = {0.0: 0.8, 1.0: 0.3, 2.0: 0.75, 3.0: 0.1}
    asked = []

    def is_local_minimum(query, pose, agreement):
        asked.append((pose.center_world[0], agreement))
        return pose.center_world[0] == 2.0

    for name, value in {
        "visible_points": lambda *_: None,
        "sampling_loss": lambda *_: 0.07,
        "agreement_at": lambda points, panorama, pose: Agreement(values[pose.center_world[0]], 1.0),
        "occlusion_at": lambda *_: SimpleNamespace(fractions=lambda: (0.6, 0.3)),
        "is_local_minimum": is_local_minimum,
        "estimate_covariance": lambda *_: None,
    }.items():
        monkeypatch.setattr(evaluation, name, value)
    alternatives = _at(1.0, 0.5), _at(2.0, 0.45), _at(3.0, 0.1)
    found = evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), alternatives))
    assert asked == [(1.0, 0.3), (2.0, 0.75)]
    e = found.evidence
    assert (e.score, e.agreement, e.seen_fraction) == (0.6, 0.8, 1.0)
    assert (e.explained_fraction, e.contradicted_fraction) == (0.6, 0.3)
    assert e.margin == pytest.approx(0.05)  # by the agreements, where that is less than 0.1 by the scores
    assert e.alternative_score_ratio == pytest.approx(0.75)
    assert _places(found.alternatives) == [2.0, 1.0, 3.0]
    assert (found.loss, found.status) == (0.07, "ambiguous")
    many = tuple(_at(1.0 + 0.001 * k, 0.1) for k in range(9))
    values.update({h.pose.center_world[0]: 0.1 for h in many})
    found = evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), many))
    assert found.evidence.margin == pytest.approx(0.5)
    assert found.evidence.alternative_score_ratio == 0
    assert len(found.alternatives) == 5
    monkeypatch.setattr(evaluation, "sampling_loss", lambda *_: np.inf)
    assert evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), ())).pose is None
