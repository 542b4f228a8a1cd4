"""Decisions of the default method, each in a made-up case where one rule changes the outcome."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
import rooms

from piccolo.coarse_to_fine import evaluation, refinement
from piccolo.coarse_to_fine import localize as method
from piccolo.coarse_to_fine.comparison import Comparison
from piccolo.coarse_to_fine.config import METHOD, Beam
from piccolo.coarse_to_fine.query import prepare_query
from piccolo.coarse_to_fine.search_result import SearchResult
from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.coarse_to_fine.starts import Starts, best_and_alternatives, narrow
from piccolo.confidence.alternatives import Hypothesis
from piccolo.confidence.score import Agreement
from piccolo.geometry.pose import Pose, step, yaw_rotation
from piccolo.geometry.sphere import make_grid
from piccolo.optimize.channel_loss import CHANCE
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
    monkeypatch.setattr(refinement, "compared", gaining("compared", 1.0))
    centers = np.outer(np.arange(40.0), [1.0, 0, 0])
    R, index = np.repeat(np.eye(3)[None], 40, axis=0), np.arange(40)
    starts = Starts(R, centers, index, 0.5 - 0.01 * index)
    found = refinement.refine(QUERY, starts, Beam(30, 20, 5, 2))
    assert calls[:2] == [(5, 30), (12, 20)]
    stages = ("descend_middle", "perturb_middle", "descend_fine", "perturb", "compared")
    assert [calls.count(name) for name in stages] == [20, 5, 5, 2, 15]
    assert _places(found) == [0, 1, 0, 1, 2, 3, 4, *range(5, 13)]  # the last from middle cells
    assert [found[k].score for k in (0, 2, 7)] == pytest.approx([2.3, 1.8, 1.55])


# Perturbations and the last millimetres


def test_each_stage_has_its_view_its_image_and_its_limits(monkeypatch):
    asked = []
    monkeypatch.setattr(refinement, "render_view", lambda octree, center, view, shown: view)
    monkeypatch.setattr(
        refinement, "visible_points", lambda octree, center, view, shown, count: (view, count)
    )
    monkeypatch.setattr(refinement, "descend", lambda *arguments: asked.append(arguments) or arguments[3])
    monkeypatch.setattr(refinement, "score_on", lambda cells, blocks, center, image, pose: len(blocks))
    monkeypatch.setattr(refinement, "refine_unoccluded", lambda query, h: (query, h))
    monkeypatch.setattr(refinement, "without_occluders", lambda query, pose: query)
    monkeypatch.setattr(refinement, "compared", lambda query, h: h)
    images = SimpleNamespace(full="full", fine="fine", middle="middle")
    query = SimpleNamespace(**vars(QUERY), images=images, shown_cells=lambda *_: None)
    h, full = _at(1.0, 0.2), (METHOD.full_view, 30_000)
    for at, view in (
        (refinement.descend_middle, METHOD.middle_view),
        (refinement.descend_fine, METHOD.fine_view),
    ):
        assert at(query, h).score == len(view.arrays.blocks)
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

    def around(cells, blocks, images, pose, size):
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
    images = SimpleNamespace(middle="middle", fine="fine")
    query = SimpleNamespace(**vars(QUERY), images=images, shown_cells=lambda *_: None)
    found = refinement.refine_by_perturbation(query, _at(0.0, 0.5))
    assert found.score == pytest.approx(expected)
    assert sizes == [0.4] * rounds


@pytest.mark.parametrize(("after", "is_taken"), [(0.60, True), (0.515, True), (0.503, False), (0.1, False)])
def test_full_resolution_is_taken_back_where_the_score_falls(monkeypatch, after, is_taken):
    """By three parts in a hundred at most may it fall, in exchange for millimetres."""
    moved, start = _at(0.004, 0.0).pose, _at(0.0, 0.52)
    query = SimpleNamespace(**vars(QUERY), images=SimpleNamespace(full="full"))
    asked, descents = [], []
    monkeypatch.setattr(refinement, "refine_unoccluded", lambda query, h: (query, h))
    monkeypatch.setattr(refinement, "without_occluders", lambda query, pose: query)
    monkeypatch.setattr(refinement, "compared", lambda query, h: Hypothesis(h.pose, after))
    monkeypatch.setattr(refinement, "points_at", lambda query, pose: asked.append(pose.center_world[0]))
    monkeypatch.setattr(refinement, "descend", lambda *arguments: descents.append(arguments[-1]) or moved)
    expected = Hypothesis(moved, after) if is_taken else start
    assert refinement.refine_full_resolution(query, start, 2) == expected
    assert asked == [0.0, 0.004]  # the points are taken anew from where the pose is
    assert refinement.settle(query, start) == expected
    assert len(asked) == len(descents) == 4  # the second round of settling moves nothing
    monkeypatch.setattr(refinement, "descend", lambda *arguments: _at(len(asked), 0.0).pose)
    refinement.settle(query, start)
    assert len(asked) == 10  # six rounds at most


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
    monkeypatch.setattr(refinement, "render_view", lambda octree, center, config, shown: shown)
    monkeypatch.setattr(
        refinement, "visible_points", lambda octree, center, config, shown, count: (shown, count)
    )
    assert (refinement.view_at(narrow, pose, METHOD.full_view) == shown).all()
    points, count = refinement.points_at(narrow, pose)
    assert (points == shown).all()
    assert count == 30_000


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


# Matches, searches and alternatives


def _seen(explains, num_blocks=4):
    """A comparison that explains a part of each of some blocks of a hundredth of the sphere."""
    beyond = CHANCE + (1.0 - CHANCE) * explains
    return Comparison(np.full(num_blocks, beyond), *[np.full(num_blocks, 0.01)] * 2, 0.04)


def test_of_poses_that_matches_gave_the_better_end_is_taken(monkeypatch):
    """As found, or after a descent on fine cells, whichever explains more."""
    scores = {0.0: 0.3, 1.0: 0.5, 5.0: 0.6, 6.0: 0.2}
    down = lambda query, h: _at(h.pose.center_world[0] + 1.0, 0.9)  # noqa: E731
    monkeypatch.setattr(refinement, "descend_fine", down)
    monkeypatch.setattr(refinement, "perturb_middle", lambda query, h: _at(-1.0, 0.9))
    to_score = lambda query, h: Hypothesis(h.pose, scores[h.pose.center_world[0]])  # noqa: E731
    monkeypatch.setattr(refinement, "compared", to_score)
    found = refinement.refine_matched(QUERY, [_at(0.0, 0).pose, _at(5.0, 0).pose])
    assert [(h.pose.center_world[0], h.score) for h in found] == [(5.0, 0.6), (1.0, 0.5)]


def test_alternatives_that_come_near_are_refined_and_what_explains_more_wins(monkeypatch):
    """The third explains more of what both show, though its score is less; the far one stays as it is."""
    explains = {0.0: 0.5, 3.0: 0.4, 6.0: 0.6, 9.0: 0.1}
    refined = []

    def full(query, h, num_rounds):
        refined.append((h.pose.center_world[0], num_rounds))
        return Hypothesis(h.pose, h.score + 0.01)

    monkeypatch.setattr(method, "refine_full_resolution", full)
    monkeypatch.setattr(method, "compare", lambda query, pose: _seen(explains[pose.center_world[0]]))
    monkeypatch.setattr(method, "settle", lambda query, h: h)
    found = method.finished(QUERY, [_at(9.0, 0.1), _at(0.0, 0.5), _at(6.0, 0.31), _at(3.0, 0.4)])
    assert refined == [(0.0, 2), (3.0, 2), (6.0, 2)]
    assert found.best == Hypothesis(found.best.pose, 0.32)
    assert _places([found.best, *found.alternatives]) == [6.0, 0.0, 3.0, 9.0]
    assert found.rival_ratio == pytest.approx(0.5 / 0.6)


def test_an_alternative_must_explain_five_hundredths_more_to_win(monkeypatch):
    for other, best in ((0.52, 0.0), (0.53, 3.0)):
        explains = {0.0: 0.5, 3.0: other}
        monkeypatch.setattr(
            method, "compare", lambda query, pose, of=explains: _seen(of[pose.center_world[0]])
        )
        found = method.fairly_selected(QUERY, SearchResult(_at(0.0, 0.5), (_at(3.0, 0.4),)))
        assert _places([found.best]) == [best]
    alone = SearchResult(_at(0.0, 0.5), ())
    assert method.fairly_selected(QUERY, alone) is alone


def test_margin_is_the_lesser_of_two_leads_and_a_result_is_sure_by_three_things():
    for score, other, rival, margin in ((0.5, 0.1, 0.3, 0.7), (0.5, 0.4, 0.3, 0.2), (0.1, 0.4, 0.0, -1.0)):
        found = SearchResult(_at(0.0, score), (_at(3.0, other),), rival)
        assert found.margin == pytest.approx(margin)
    assert SearchResult(_at(0.0, 0.3), ()).margin == 1.0
    for score, other, matches, is_sure in (
        (0.05, 0.02, 12, True),
        (0.04, 0.01, 12, False),
        (0.5, 0.24, 11, False),
        (0.5, 0.26, 99, False),
    ):
        assert SearchResult(_at(0.0, score), (_at(3.0, other),)).is_sure(matches) == is_sure


def _run(monkeypatch, matched, searches, gravity="auto", config=METHOD):
    """Localize with made-up poses from matches and from searches; the searches made, what is evaluated.

    A score in hundredths is also how many features agree, and what a pose explains.
    """
    made, left = [], list(searches)
    scan_map = SimpleNamespace(centers=np.zeros((1, 3)))
    scores = {h.pose.center_world[0]: h.score for some in (matched, *searches) for h in some}

    def search_poses(query, gravity):
        made.append(gravity)
        return gravity

    monkeypatch.setattr(method, "apply_prior", lambda *_: scan_map)
    monkeypatch.setattr(method, "prepare_query", lambda *_: SimpleNamespace(**vars(QUERY), matches=None))
    monkeypatch.setattr(method, "matched_poses", lambda query: "matched")
    monkeypatch.setattr(method, "refine_matched", lambda query, poses: list(matched))
    monkeypatch.setattr(method, "count_matches", lambda _, pose: 100 * scores.get(pose.center_world[0], 0))
    monkeypatch.setattr(method, "compare", lambda query, pose: _seen(scores[pose.center_world[0]]))
    monkeypatch.setattr(method, "search_poses", search_poses)
    monkeypatch.setattr(method, "refine", lambda query, starts, beam: left.pop(0))
    monkeypatch.setattr(method, "refine_full_resolution", lambda query, h, num_rounds: h)
    monkeypatch.setattr(method, "settle", lambda query, h: Hypothesis(h.pose, h.score + 0.001))
    monkeypatch.setattr(method, "evaluate", lambda query, panorama, found: found)
    settings = CoarseToFineSettings(gravity=gravity)
    found = method.localize(None, rooms.scene(1)[1], settings, Workers(1), Stopwatch(), config)
    return made, found


@pytest.mark.parametrize(
    ("matched", "searches", "gravity", "num_made", "best"),
    [
        ([_at(1, 0.6)], [], "auto", 0, 1),
        ([], [[_at(1, 0.6)]], "auto", 1, 1),
        ([_at(1, 0.1)], [[_at(2, 0.6)]], "auto", 1, 2),  # too few matches
        ([_at(1, 0.6), _at(5, 0.4)], [[_at(7, 0.1)], [_at(7, 0.1)]], "auto", 2, 1),  # two that are alike
        ([_at(1, 0.1)], [[_at(2, 0.11)], [_at(3, 0.09)]], "auto", 2, 2),
        ([], [[_at(2, 0.1)]], "known", 1, 2),
        ([_at(1, 0.08)], [[_at(2, 0.05)]], "unknown", 1, 1),
    ],
)
def test_searches_are_made_where_matches_leave_doubt(monkeypatch, matched, searches, gravity, num_made, best):
    made, found = _run(monkeypatch, matched, searches, gravity)
    assert made == [way for way in ("known", "unknown") if gravity in ("auto", way)][:num_made]
    assert found.best.pose.center_world[0] == best
    assert found.best.score in {h.score + 0.001 for some in (matched, *searches) for h in some}  # settled


def test_matches_or_searches_can_be_taken_out(monkeypatch):
    alone = METHOD._replace(uses_features=False)
    made, found = _run(monkeypatch, [_at(1, 0.6)], [[_at(2, 0.1)], [_at(2, 0.1)]], config=alone)
    assert (made, _places([found.best])) == (["known", "unknown"], [2])
    made, found = _run(monkeypatch, [_at(1, 0.1)], [], config=METHOD._replace(uses_search=False))
    assert (made, _places([found.best])) == ([], [1])


# Evaluation


def test_evidence_counts_what_agrees_with_the_pose_and_elsewhere(monkeypatch):
    scan_map = SimpleNamespace(points=None, coarse_points=None, to_world=lambda pose: pose)
    query = SimpleNamespace(scan_map=scan_map, settings=CoarseToFineSettings(), matches=None)
    counts = {0.0: 30, 1.0: 4, 2.0: 6}
    for name, value in {
        "visible_points": lambda *_: None,
        "sampling_loss": lambda *_: 0.07,
        "agreement_at": lambda points, panorama, pose: Agreement(0.8, 1.0),
        "occlusion_at": lambda *_: SimpleNamespace(fractions=lambda: (0.6, 0.3)),
        "count_matches": lambda matches, pose: counts.get(pose.center_world[0], 0),
        "estimate_covariance": lambda *_: None,
        "is_mirrored": lambda *_: False,
    }.items():
        monkeypatch.setattr(evaluation, name, value)
    alternatives = _at(1.0, 0.3), _at(2.0, 0.2)
    found = evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), alternatives, 0.7))
    e = found.evidence
    assert (e.score, e.agreement, e.seen_fraction) == (0.6, 0.8, 1.0)
    assert (e.explained_fraction, e.contradicted_fraction) == (0.6, 0.3)
    assert (e.num_matches, e.alternative_matches) == (30, 6)
    assert e.margin == pytest.approx(0.3)
    assert _places(found.alternatives) == [1.0, 2.0]
    assert found.loss == 0.07
    many = tuple(_at(1.0 + 0.001 * k, 0.1) for k in range(9))
    found = evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), many))
    assert len(found.alternatives) == 5
    alone = evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), ()))
    assert (alone.evidence.margin, alone.evidence.alternative_matches) == (1.0, 0)
    monkeypatch.setattr(evaluation, "sampling_loss", lambda *_: np.inf)
    assert evaluation.evaluate(query, rooms.scene(1)[1], SearchResult(_at(0.0, 0.6), ())).pose is None
