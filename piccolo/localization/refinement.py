"""From starts to poses: successive halving on ever finer views, and perturbations."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE, Hypothesis, best_distinct, by_score, suppressed
from ..geometry.pose import Pose
from ..geometry.suppression import non_maximum_suppression
from .comparison import compare, score_pose
from .descent import COARSE_LOSS, FINE_LOSS, Fit, descend, descend_all, descend_around, fit_on
from .query import Query
from .search import Starts
from .settings import Beam

FIRST_ITERATIONS = 5  # of the first descents on prepared views
SECOND_ITERATIONS = 12
MIDDLE_LIMITS = (COARSE_LOSS, 12, 1e-3)
FINE_LIMITS = (FINE_LOSS, 12, 1e-4)
PERTURBATION = 0.4  # of that on middle cells, on fine ones
MAX_PERTURBATIONS = 5  # rounds
MIN_GAIN = 0.02  # by the score in a round; else it was the last
NUM_FOUND = 12  # poses of a search, at most
PLAIN_SCORE, FAINT_PART = 0.2, 0.25  # where the best has this score, no more is asked of what has less of it
SAME_DISTANCE = 0.15  # [m] poses on their way down nearer than this
SAME_ANGLE = math.radians(5.0)  # and this are one
CLOSE_DISTANCE = 0.1  # [m] the same after the descent on middle cells


def refine(query: Query, starts: Starts, beam: Beam) -> list[Hypothesis]:
    """Successive halving from the starts to a few poses on fine cells, and the best elsewhere; best first."""

    def each(descend_on: Callable[[Query, Pose], Fit], poses: Sequence[Pose]) -> list[Fit]:
        return query.workers.map(partial(descend_on, query), poses, "descend")

    coarse = descend_prepared(query, starts, FIRST_ITERATIONS, beam.num_coarse)
    coarse = descend_prepared(query, coarse, SECOND_ITERATIONS, beam.num_middle)
    middle = each(descend_middle, coarse.poses())
    perturbed = each(perturb_middle, narrow(middle, beam.num_fine))
    fine = each(descend_fine, narrow(perturbed, beam.num_fine))
    best = best_distinct(fine, beam.num_perturbed, CLOSE_DISTANCE, SAME_ANGLE)
    others = plain(distinct(fine, middle))[len(best) :]  # which most likely stay
    with query.workers.beside(*(partial(compare, query, f.pose) for f in others)):
        ends = query.workers.map(partial(refine_by_perturbation, query), best, "descend")
    poses = [f.pose for f in plain(distinct([*ends, *fine], middle))]
    return by_score(query.workers.map(partial(score_pose, query), poses, "descend"))


def refine_matches(query: Query, poses: Sequence[Pose]) -> list[Hypothesis]:
    """Poses that matches gave, each as found or after a descent on fine cells; the best first."""

    def refine_match(pose: Pose) -> Hypothesis:
        end = descend_fine(query, pose).pose
        return max(score_pose(query, pose), score_pose(query, end), key=lambda h: h.score)

    return by_score(query.workers.map(refine_match, poses, "descend"))


def descend_prepared(query: Query, starts: Starts, num_iterations: int, count: int) -> Starts:
    """Descend from each start on its candidate's prepared view; keep the distinct best and alternatives."""
    image = query.photo.images.search()
    ends, _ = descend_all(query.scan_map, image, starts, num_iterations, query.workers)
    return ends.take(best_and_alternatives(ends.R_cam_from_map, ends.center_map, count, SAME_DISTANCE))


def descend_middle(query: Query, pose: Pose) -> Fit:
    """Descend on middle cells, seen from where the pose is now."""
    config = query.method.middle_view
    image = query.photo.images.middle()
    cells = query.view_at(pose, config)
    return fit_on(cells, config.arrays.blocks, image, descend(cells, image, pose, MIDDLE_LIMITS))


def perturb_middle(query: Query, pose: Pose) -> Fit:
    """Descend again from around a pose on middle cells."""
    config = query.method.middle_view
    images = query.photo.images.search(), query.photo.images.middle()
    cells = query.view_at(pose, config)
    return descend_around(cells, config.arrays.blocks, images, pose, 1.0, query.workers)


def descend_fine(query: Query, pose: Pose) -> Fit:
    """Descend on fine cells, seen from where the pose is now."""
    config = query.method.fine_view
    image = query.photo.images.fine()
    cells = query.view_at(pose, config)
    return fit_on(cells, config.arrays.blocks, image, descend(cells, image, pose, FINE_LIMITS))


def refine_by_perturbation(query: Query, fit: Fit) -> Fit:
    """Perturb and refine for as long as the score rises: a pose that stopped short creeps on.

    Where that has ended before, it has ended.
    """
    if fit.pose.key in query.cache.ends:
        return fit
    config = query.method.fine_view
    blocks = config.arrays.blocks
    images = query.photo.images.middle(), query.photo.images.fine()
    cells = query.view_at(fit.pose, config)
    fit = fit_on(cells, blocks, images[1], fit.pose)
    for _ in range(MAX_PERTURBATIONS):
        around = descend_around(cells, blocks, images, fit.pose, PERTURBATION, query.workers)
        refined = descend_fine(query, around.pose)
        gain = refined.score - fit.score
        fit = refined if gain > 0.0 else fit
        if gain < MIN_GAIN * refined.score:
            break
        cells = query.view_at(fit.pose, config)
    query.cache.ends.add(fit.pose.key)
    return fit


def best_and_alternatives(
    rotations: NDArray[np.float64], centers: NDArray[np.float64], count: int, min_distance: float
) -> NDArray[np.int64]:
    """Indices of `count` of the poses (n, 3, 3), (n, 3), best first, which are in order again.

    The best that differ a little and, in a quarter of the places, the best that lie far apart.
    """
    near = non_maximum_suppression(rotations, centers, count - count // 4, min_distance, SAME_ANGLE)
    apart = non_maximum_suppression(rotations, centers, count, MIN_DISTANCE, MIN_ANGLE)
    others = apart[~np.isin(apart, near)][: count - len(near)]
    return np.sort(np.concatenate([near, others]))


def narrow(fits: Sequence[Fit], count: int) -> list[Pose]:
    """The `best_and_alternatives` of poses by their scores."""
    ranked = [f.pose for f in by_score(fits)]
    rotations = np.array([pose.R_cam_from_world for pose in ranked])
    centers = np.array([pose.center_world for pose in ranked])
    return [ranked[k] for k in best_and_alternatives(rotations, centers, count, CLOSE_DISTANCE)]


def distinct(fine: Sequence[Fit], middle: Sequence[Fit]) -> list[Fit]:
    """The best on fine cells, and the best of those on middle cells, none near another."""
    return suppressed([*by_score(fine), *by_score(middle)], NUM_FOUND, MIN_DISTANCE, MIN_ANGLE)


def plain(ranked: Sequence[Fit]) -> list[Fit]:
    """Those that a comparison could bring near the best: all, unless it is good and they are far from it."""
    best = max((f.score for f in ranked), default=0.0)
    least = FAINT_PART * best if best >= PLAIN_SCORE else -math.inf
    return [f for f in ranked if f.score >= least]
