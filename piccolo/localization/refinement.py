"""From starts to poses: successive halving on ever finer views, perturbations, the last millimetres."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE, Hypothesis, best_distinct, by_score, suppressed
from ..geometry.pose import Pose
from ..jobs.once import Once
from ..views.recent_views import place_of
from ..views.view import Cells, ViewConfig, normalized_view
from .comparison import compare, without_occluders
from .config import Beam
from .descent import COARSE_LOSS, FINE_LOSS, FULL_LOSS, descend, descend_all, descend_around, score_on
from .query import Query
from .starts import CLOSE_DISTANCE, SAME_ANGLE, SAME_DISTANCE, Starts, best_and_alternatives, narrow

FIRST_ITERATIONS, SECOND_ITERATIONS = 5, 12  # of the descents on prepared views
NUM_SCORED = 64  # starts, where only the best score is asked for
MIDDLE_LIMITS, FINE_LIMITS = (COARSE_LOSS, 12, 1e-3), (FINE_LOSS, 12, 1e-4)
FULL_LIMITS, LAST_LIMITS = (FULL_LOSS, 10, 1e-4), (FULL_LOSS, 30, 1e-7)
PERTURBATION = 0.4  # of that on middle cells, on fine ones
MAX_UNOCCLUDED = 2  # times that occluders are looked for
MAX_PERTURBATIONS, MIN_GAIN = 5, 0.02  # rounds; by the score in one, else it was the last
NUM_FOUND = 12  # poses of a search, at most
PLAIN_SCORE, FAINT_PART = 0.2, 0.25  # where the best has this score, no more is asked of what has less of it
NUM_POINTS = 30_000  # for the last millimetres, in what the photo shows
MAX_LAST_ROUNDS, SETTLED = 6, 1e-4  # [m] a camera that moves by less in a round has arrived
NEARLY = 0.02  # [m] and one that does by less sees the same points
MIN_SCORE_LEFT = 0.94  # of the score, in exchange for millimetres


def descend_prepared(query: Query, starts: Starts, num_iterations: int, count: int) -> Starts:
    """Descend from each start on its candidate's prepared view; keep the distinct best and alternatives."""
    ends = descend_all(query.scan_map, query.images.search, starts, num_iterations, query.workers)
    return ends.take(best_and_alternatives(ends.R_cam_from_map, ends.center_map, count, SAME_DISTANCE))


def descend_middle(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend on middle cells, seen from where the pose is now."""
    image, config = query.images.middle, query.method.middle_view
    cells = view_at(query, h.pose, config)
    pose = descend(cells, image, h.pose, MIDDLE_LIMITS)
    return Hypothesis(pose, score_on(cells, config.arrays.blocks, image, pose))


def perturb_middle(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend again from around a pose on middle cells."""
    config, images = query.method.middle_view, (query.images.search, query.images.middle)
    cells = view_at(query, h.pose, config)
    return descend_around(cells, config.arrays.blocks, images, h.pose, 1.0, query.workers)


def descend_fine(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend on fine cells, seen from where the pose is now."""
    image, config = query.images.fine, query.method.fine_view
    cells = view_at(query, h.pose, config)
    pose = descend(cells, image, h.pose, FINE_LIMITS)
    return Hypothesis(pose, score_on(cells, config.arrays.blocks, image, pose))


def refine_by_perturbation(query: Query, h: Hypothesis) -> Hypothesis:
    """Perturb and refine for as long as the score rises: a pose that stopped short creeps on.

    Where that has ended before, it has ended.
    """
    config, images = query.method.fine_view, (query.images.middle, query.images.fine)
    if h.pose.key in query.ends:
        return h
    blocks, cells = config.arrays.blocks, view_at(query, h.pose, config)
    h = Hypothesis(h.pose, score_on(cells, blocks, query.images.fine, h.pose))
    for _ in range(MAX_PERTURBATIONS):
        around = descend_around(cells, blocks, images, h.pose, PERTURBATION, query.workers)
        refined = descend_fine(query, around)
        gain = refined.score - h.score
        h = refined if gain > 0.0 else h
        if gain < MIN_GAIN * refined.score:
            break
        cells = view_at(query, h.pose, config)
    query.ends.add(h.pose.key)
    return h


def compared(query: Query, h: Hypothesis) -> Hypothesis:
    """The same pose with the score by which poses are selected."""
    return Hypothesis(h.pose, compare(query, h.pose).score)


def view_at(query: Query, pose: Pose, config: ViewConfig) -> Cells:
    """The cells seen from about a pose that the photo shows."""
    place, shown = place_of(pose), query.shown_cells(config.num_rings, pose)
    return normalized_view(query.views.averages(place, config), place, config, shown)


def points_at(query: Query, pose: Pose) -> Cells:
    """The points that the last descent goes by: those seen from about a pose that the photo shows too."""
    config = query.method.full_view
    shown = query.shown_cells(config.num_rings, pose)
    return query.views.points(place_of(pose), config, shown.tobytes(), NUM_POINTS)


def refine_unoccluded(query: Query, h: Hypothesis) -> tuple[Query, Hypothesis]:
    """A pose refined by what of the photo does not contradict it; the query of just that, and the pose.

    The score is that of `compared`, of the whole photo.
    """
    h, shown = compared(query, h), query
    for _ in range(MAX_UNOCCLUDED):
        shown = without_occluders(query, h.pose)
        start = h if shown is query else descend_fine(shown, perturb_middle(shown, h))
        refined = compared(query, refine_by_perturbation(shown, start))
        gain = refined.score - h.score
        h = refined if gain > 0.0 else h
        if shown is query or gain < MIN_GAIN * refined.score:
            break
    return shown, h


def refine_full_resolution(query: Query, h: Hypothesis, num_rounds: int) -> Hypothesis:
    """The last millimetres: the visible points themselves in the finest image, unless the score falls.

    In each round the points are taken anew, from where the pose is then, unless it has hardly moved. The
    score is that of `compared`.
    """
    shown, before = refine_unoccluded(query, h)
    pose = before.pose
    for _ in range(num_rounds):
        center = pose.center_world
        pose = descend(points_at(shown, pose), shown.images.full, pose, FULL_LIMITS)
        if math.dist(pose.center_world, center) < NEARLY:
            break
    after = compared(query, Hypothesis(pose, 0.0))
    return after if after.score > MIN_SCORE_LEFT * before.score else before


def settle(query: Query, h: Hypothesis) -> Hypothesis:
    """The same until the pose moves no more, so that it does not depend on where the search began."""
    pose, shown = h.pose, without_occluders(query, h.pose)
    for _ in range(MAX_LAST_ROUNDS):
        center = pose.center_world
        pose = descend(points_at(shown, pose), shown.images.full, pose, LAST_LIMITS)
        if math.dist(pose.center_world, center) < SETTLED:
            break
    settled = compared(query, Hypothesis(pose, 0.0))
    return settled if settled.score > MIN_SCORE_LEFT * h.score else h


def refine_matched(query: Query, poses: Sequence[Pose]) -> list[Hypothesis]:
    """Poses that matches gave, refined on fine cells; the best first, by the score of `compared`."""

    def refined(pose: Pose) -> Hypothesis:
        as_found = Hypothesis(pose, 0.0)
        ends = as_found, descend_fine(query, as_found)
        return max((compared(query, end) for end in ends), key=lambda h: h.score)

    return by_score(list(query.workers.map(refined, poses, "descend")))


def first_score(query: Query, starts: Starts) -> float:
    """The best score after a short descent from the best starts on their candidates' prepared views."""
    some = starts.take(np.arange(min(NUM_SCORED, len(starts.score))))
    ends = descend_all(query.scan_map, query.images.search, some, FIRST_ITERATIONS, query.workers)
    return float(ends.score.max(initial=0.0))


def refine(query: Query, starts: Starts, beam: Beam) -> list[Hypothesis]:
    """Successive halving from the starts to a few poses on fine cells, and the best elsewhere; best first.

    The score is that of `compared`.
    """

    def each(function: Callable[[Query, Hypothesis], Hypothesis], some: list[Hypothesis]) -> list[Hypothesis]:
        return list(query.workers.map(lambda h: function(query, h), some, "descend"))

    coarse = descend_prepared(query, starts, FIRST_ITERATIONS, beam.num_coarse)
    coarse = descend_prepared(query, coarse, SECOND_ITERATIONS, beam.num_middle)
    middle = each(descend_middle, coarse.hypotheses())
    perturbed = each(perturb_middle, narrow(middle, beam.num_fine))
    fine = each(descend_fine, narrow(perturbed, beam.num_fine))
    best = best_distinct(fine, beam.num_perturbed, CLOSE_DISTANCE, SAME_ANGLE)
    others = plain(distinct(fine, middle))[len(best) :]  # which most likely stay
    with query.workers.beside(*(Once(partial(compare, query, h.pose)) for h in others)):
        ends = each(refine_by_perturbation, best)
    return by_score(each(compared, plain(distinct([*ends, *fine], middle))))


def distinct(fine: Sequence[Hypothesis], middle: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best on fine cells, and the best of those on middle cells, none near another."""
    ranked = [*by_score(fine), *by_score(middle)]
    return suppressed(ranked, NUM_FOUND, MIN_DISTANCE, MIN_ANGLE)


def plain(ranked: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those that a comparison could bring near the best: all, unless it is good and they are far from it."""
    best = max((h.score for h in ranked), default=0.0)
    least = FAINT_PART * best if best >= PLAIN_SCORE else -math.inf
    return [h for h in ranked if h.score >= least]
