"""From starts to poses: successive halving on ever finer views, perturbations, the last millimetres."""

import math
from collections.abc import Callable

from ..confidence.alternatives import Hypothesis, best_distinct, by_score
from ..geometry.pose import Pose
from .config import Beam
from .descent import COARSE_LOSS, FINE_LOSS, FULL_LOSS, descend, descend_all, descend_around, score_on
from .query import Query
from .starts import CLOSE_DISTANCE, SAME_ANGLE, SAME_DISTANCE, Starts, best_and_alternatives, narrow
from .view import render_view, visible_points

FIRST_ITERATIONS, SECOND_ITERATIONS = 5, 12  # of the descents on prepared views
MIDDLE_LIMITS, FINE_LIMITS = (COARSE_LOSS, 12, 1e-3), (FINE_LOSS, 12, 1e-4)
FULL_LIMITS, LAST_LIMITS = (FULL_LOSS, 10, 1e-4), (FULL_LOSS, 30, 1e-7)
PERTURBATION = 0.4  # of that on middle cells, on fine ones
MAX_PERTURBATIONS, MIN_GAIN = 5, 0.01  # rounds; of the score in one, else it was the last
NUM_POINTS = 30_000  # for the last millimetres
MAX_LAST_ROUNDS, SETTLED = 6, 1e-4  # [m] a camera that moves by less in a round has arrived
MAX_SCORE_LOSS = 0.01  # in exchange for millimetres


def descend_prepared(query: Query, starts: Starts, num_iterations: int, count: int) -> Starts:
    """Descend from each start on its candidate's prepared view; keep the distinct best and alternatives."""
    ends = descend_all(query.scan_map, query.images.search, starts, num_iterations, query.workers)
    return ends.take(best_and_alternatives(ends.R_cam_from_map, ends.center_map, count, SAME_DISTANCE))


def descend_middle(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend on middle cells, seen from where the pose is now."""
    center, image = h.pose.center_world, query.images.middle
    cells = render_view(query.scan_map.octree, center, query.method.middle_view)
    pose = descend(cells, center, image, h.pose, MIDDLE_LIMITS)
    return Hypothesis(pose, score_on(cells, center, image, pose))


def perturb_middle(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend again from around a pose on middle cells."""
    cells = render_view(query.scan_map.octree, h.pose.center_world, query.method.middle_view)
    return descend_around(cells, (query.images.search, query.images.middle), h.pose, 1.0)


def descend_fine(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend on fine cells, seen from where the pose is now."""
    center, image = h.pose.center_world, query.images.fine
    cells = render_view(query.scan_map.octree, center, query.method.fine_view)
    pose = descend(cells, center, image, h.pose, FINE_LIMITS)
    return Hypothesis(pose, score_on(cells, center, image, pose))


def refine_by_perturbation(query: Query, h: Hypothesis) -> Hypothesis:
    """Perturb and refine for as long as the score rises: a pose that stopped short creeps on."""
    for _ in range(MAX_PERTURBATIONS):
        cells = render_view(query.scan_map.octree, h.pose.center_world, query.method.fine_view)
        images = query.images.middle, query.images.fine
        refined = descend_fine(query, descend_around(cells, images, h.pose, PERTURBATION))
        gain = refined.score - h.score
        h = refined if gain > 0.0 else h
        if gain < MIN_GAIN:
            break
    return h


def score_at(query: Query, pose: Pose) -> float:
    """Score of a pose on fine cells, seen from just there."""
    cells = render_view(query.scan_map.octree, pose.center_world, query.method.fine_view)
    return score_on(cells, pose.center_world, query.images.fine, pose)


def refine_full_resolution(query: Query, h: Hypothesis, num_rounds: int) -> Hypothesis:
    """The last millimetres: the visible points themselves in the finest image, unless the score falls.

    In each round the points are taken anew, from where the pose is then.
    """
    before, pose = score_at(query, h.pose), h.pose
    for _ in range(num_rounds):
        center = pose.center_world
        points = visible_points(query.scan_map.octree, center, query.method.full_view, NUM_POINTS)
        pose = descend(points, center, query.images.full, pose, FULL_LIMITS)
    score = score_at(query, pose)
    return Hypothesis(pose, score) if score > before - MAX_SCORE_LOSS else Hypothesis(h.pose, before)


def settle(query: Query, h: Hypothesis) -> Hypothesis:
    """The same until the pose moves no more, so that it does not depend on where the search began."""
    pose = h.pose
    for _ in range(MAX_LAST_ROUNDS):
        center = pose.center_world
        points = visible_points(query.scan_map.octree, center, query.method.full_view, NUM_POINTS)
        pose = descend(points, center, query.images.full, pose, LAST_LIMITS)
        if math.dist(pose.center_world, center) < SETTLED:
            break
    score = score_at(query, pose)
    return Hypothesis(pose, score) if score > h.score - MAX_SCORE_LOSS else h


def refine(query: Query, starts: Starts, beam: Beam) -> tuple[list[Hypothesis], list[Hypothesis]]:
    """Successive halving from the starts to a few poses on fine cells, best first.

    Then the many on middle cells, for the alternatives among them.
    """

    def each(function: Callable[[Query, Hypothesis], Hypothesis], some: list[Hypothesis]) -> list[Hypothesis]:
        return list(query.workers.map(lambda h: function(query, h), some, "descend"))

    coarse = descend_prepared(query, starts, FIRST_ITERATIONS, beam.num_coarse)
    coarse = descend_prepared(query, coarse, SECOND_ITERATIONS, beam.num_middle)
    middle = each(descend_middle, coarse.hypotheses())
    perturbed = each(perturb_middle, narrow(middle, beam.num_fine))
    fine = each(descend_fine, narrow(perturbed, beam.num_fine))
    best = best_distinct(fine, beam.num_perturbed, CLOSE_DISTANCE, SAME_ANGLE)
    return by_score([*each(refine_by_perturbation, best), *fine]), middle
