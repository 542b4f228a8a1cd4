"""Decisions of the default method, each in a made-up case where one rule changes the outcome."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms

from piccolo.confidence.alternatives import Hypothesis
from piccolo.geometry.pose import Pose, step, yaw_rotation
from piccolo.geometry.sphere import make_grid
from piccolo.jobs.threads import Workers
from piccolo.localization import refinement
from piccolo.localization.config import METHOD, Beam
from piccolo.localization.query import prepare_query
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.localization.starts import Starts, best_and_alternatives, narrow

QUERY = SimpleNamespace(workers=Workers(1), method=METHOD, scan_map=None)


def _at(x, score, yaw_deg=0.0):
    return Hypothesis(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


@functools.lru_cache
def _query(seed):
    return prepare_query(rooms.scene(seed)[1], rooms.scan_map(seed), CoarseToFineSettings(), Workers(2))


def _places(hypotheses):
    return [round(float(h.pose.center_world[0]), 6) for h in hypotheses]


# What is compared


@pytest.mark.parametrize(
    ("scores", "kept"),
    [
        ([0.6, 0.3, 0.16, 0.14], [0.6, 0.3, 0.16]),  # the best is plain: less than a quarter of it is nothing
        ([0.05, 0.21, 0.04], [0.21]),
        ([0.19, 0.03, 0.01], [0.19, 0.03, 0.01]),  # half hidden, perhaps: who knows what a comparison brings
        ([], []),
    ],
)
def test_faint_poses_are_compared_only_where_the_best_is_not_plain(scores, kept):
    found = refinement.plain([_at(k, score) for k, score in enumerate(scores)])
    assert sorted((h.score for h in found), reverse=True) == kept


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
    monkeypatch.setattr(refinement, "compared", gaining("compared", 1.0))
    centers = np.outer(np.arange(40.0), [1.0, 0, 0])
    R, index = np.repeat(np.eye(3)[None], 40, axis=0), np.arange(40)
    starts = Starts(R, centers, index, 0.5 - 0.01 * index)
    found = refinement.refine(QUERY, starts, Beam(30, 20, 5, 2))
    assert calls[:2] == [(5, 30), (12, 20)]
    stages = ("descend_middle", "perturb_middle", "descend_fine", "perturb", "compared")
    assert [calls.count(name) for name in stages] == [20, 5, 5, 2, 12]
    assert _places(found) == [*range(12)]  # each answer once, the last from middle cells
    assert [found[k].score for k in (0, 2, 5)] == pytest.approx([2.3, 1.78, 1.55])


# Perturbations and the last millimetres


def test_each_stage_has_its_view_its_image_and_its_limits(monkeypatch):
    asked = []
    monkeypatch.setattr(refinement, "normalized_view", lambda sums, center, view, shown: view)
    monkeypatch.setattr(refinement, "descend", lambda *arguments: asked.append(arguments) or arguments[2])
    monkeypatch.setattr(refinement, "score_on", lambda cells, blocks, image, pose: len(blocks))
    monkeypatch.setattr(refinement, "refine_unoccluded", lambda query, h: (query, h))
    monkeypatch.setattr(refinement, "without_occluders", lambda query, pose: query)
    monkeypatch.setattr(refinement, "compared", lambda query, h: h)
    images = SimpleNamespace(full="full", fine="fine", middle="middle")
    views = SimpleNamespace(averages=lambda *_: None, points=lambda place, view, shown, count: (view, count))
    query = SimpleNamespace(**vars(QUERY), images=images, shown_cells=lambda *_: np.ones(3), views=views)
    h, full = _at(1.0, 0.2), (METHOD.full_view, 30_000)
    for at, view in (
        (refinement.descend_middle, METHOD.middle_view),
        (refinement.descend_fine, METHOD.fine_view),
    ):
        assert at(query, h).score == len(view.arrays.blocks)
    refinement.refine_full_resolution(query, h, 1)
    refinement.settle(query, h)
    assert [(cells, image, *limits) for cells, image, _, limits in asked] == [
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

    def around(cells, blocks, images, pose, size, workers):
        sizes.append(size)
        assert images == ("middle", "fine")
        return Hypothesis(pose, score[0])

    def fine(query, h):
        score[0] += left.pop(0)
        return Hypothesis(h.pose, score[0])

    score = [0.5]
    monkeypatch.setattr(refinement, "view_at", lambda *_: None)
    monkeypatch.setattr(refinement, "score_on", lambda *_: 0.5)  # whatever another way of scoring said
    monkeypatch.setattr(refinement, "descend_around", around)
    monkeypatch.setattr(refinement, "descend_fine", fine)
    images = SimpleNamespace(middle="middle", fine="fine")
    query = SimpleNamespace(**vars(QUERY), images=images, shown_cells=lambda *_: None, ends=set())
    found = refinement.refine_by_perturbation(query, _at(0.0, 0.9))
    assert found.score == pytest.approx(expected)
    assert sizes == [0.4] * rounds
    again = Hypothesis(found.pose, 0.3)
    assert refinement.refine_by_perturbation(query, again) is again
    assert sizes == [0.4] * rounds


@pytest.mark.parametrize(("after", "is_taken"), [(0.60, True), (0.495, True), (0.485, False), (0.1, False)])
def test_full_resolution_is_taken_back_where_the_score_falls(monkeypatch, after, is_taken):
    """By six parts in a hundred at most may it fall, in exchange for millimetres."""
    moved, start = _at(0.04, 0.0).pose, _at(0.0, 0.52)
    query = SimpleNamespace(**vars(QUERY), images=SimpleNamespace(full="full"))
    asked, descents = [], []
    monkeypatch.setattr(refinement, "refine_unoccluded", lambda query, h: (query, h))
    monkeypatch.setattr(refinement, "without_occluders", lambda query, pose: query)
    monkeypatch.setattr(refinement, "compared", lambda query, h: Hypothesis(h.pose, after))
    monkeypatch.setattr(refinement, "points_at", lambda query, pose: asked.append(pose.center_world[0]))
    monkeypatch.setattr(refinement, "descend", lambda *arguments: descents.append(arguments[-1]) or moved)
    expected = Hypothesis(moved, after) if is_taken else start
    assert refinement.refine_full_resolution(query, start, 2) == expected
    assert asked == [0.0, 0.04]  # the points are taken anew from where the pose is
    assert refinement.settle(query, start) == expected
    assert len(asked) == len(descents) == 4  # the second round of settling moves nothing
    monkeypatch.setattr(refinement, "descend", lambda *arguments: _at(len(asked), 0.0).pose)
    refinement.settle(query, start)
    assert len(asked) == 10  # six rounds at most
    monkeypatch.setattr(refinement, "descend", lambda *arguments: _at(0.019, 0.0).pose)
    refinement.refine_full_resolution(query, start, 2)
    assert len(asked) == 11  # so near by it sees the same points


@pytest.mark.parametrize(
    ("hidden", "gains", "expected"),
    [
        ([None], [0.1], (0.6, None, 1)),
        (["a", "b"], [0.1, 0.1], (0.7, "b", 2)),
        (["a"], [0.01], (0.51, "a", 1)),
        (["a"], [-0.2], (0.5, "a", 1)),
        (["a", None], [0.1, 0.1], (0.7, None, 2)),
    ],
)
def test_occluders_are_masked_twice_at_most_and_while_that_helps(monkeypatch, hidden, gains, expected):
    """What is hidden at each look, what is gained; the score, what is hidden at last, the looks."""
    score, looks, left = [0.5], [], list(hidden)
    query = SimpleNamespace(**vars(QUERY), hidden=None)

    def without_occluders(asked, pose):
        assert asked is query  # always of the whole photo
        looks.append(left.pop(0))
        return query if looks[-1] is None else SimpleNamespace(**{**vars(QUERY), "hidden": looks[-1]})

    def perturbed(shown, h):
        assert shown.hidden == looks[-1]
        score[0] = max(score[0], h.score) + gains[len(looks) - 1]
        return h

    def compared(asked, h):
        assert asked is query
        return Hypothesis(h.pose, score[0])

    monkeypatch.setattr(refinement, "without_occluders", without_occluders)
    monkeypatch.setattr(refinement, "refine_by_perturbation", perturbed)
    monkeypatch.setattr(refinement, "compared", compared)
    monkeypatch.setattr(refinement, "perturb_middle", lambda shown, h: h)
    monkeypatch.setattr(refinement, "descend_fine", lambda shown, h: h)
    shown, h = refinement.refine_unoccluded(query, _at(0.0, 0.0))
    assert (pytest.approx(h.score), shown.hidden, len(looks)) == expected


def test_cells_and_points_are_those_that_the_photo_shows(monkeypatch):
    """Cells around the camera that point where the photo has a picture; all, for a photo of a sphere."""
    whole, pose = _query(1), _at(0.0, 0.0, 70.0).pose
    is_hidden = ~(np.abs(np.arange(16) - 4) < 2) & np.ones((8, 1), bool)  # but a fifth, around the left
    narrow = whole.without(is_hidden)
    grid = make_grid(METHOD.full_view.num_rings)
    azimuth = np.degrees(np.arctan2(*(grid.directions @ pose.R_cam_from_world.T).T[1::-1]))
    shown = narrow.shown_cells(METHOD.full_view.num_rings, pose)
    assert whole.shown_cells(METHOD.full_view.num_rings, pose).all()
    is_inside = np.abs((azimuth - 78.75 + 180) % 360 - 180) < 33.75
    assert (shown == is_inside).mean() > 0.98
    monkeypatch.setattr(refinement, "normalized_view", lambda sums, center, config, shown: shown)
    views = SimpleNamespace(
        averages=lambda *_: None, points=lambda place, config, shown, count: (shown, count)
    )
    asked = replace(narrow, views=views)
    assert (refinement.view_at(asked, pose, METHOD.full_view) == shown).all()
    assert refinement.points_at(asked, pose) == (shown.tobytes(), 30_000)


@pytest.mark.parametrize(("seed", "most"), [(1, 5e-5), (3, 5e-4), (4, 5e-5)])
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
