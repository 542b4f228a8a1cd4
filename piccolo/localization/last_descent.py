"""The last descent: mask occluders, descend on the points of the scan, repeat until the pose converges."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ..confidence.alternatives import Hypothesis
from ..geometry.pose import Pose
from .comparison import mask_occluders, score_pose
from .query import Query
from .refinement import (
    FINE_LIMITS,
    FULL_LOSS,
    MIN_GAIN,
    Fit,
    Limits,
    descend,
    descend_fine,
    perturb_middle,
    refine_by_perturbation,
)
from .selection import SURE_MATCHES, Selection, rank, select
from .verification import count_agreeing

HOPELESS_SCORE = 0.02  # black, white and noisy pictures, and most photos of other places, have less
FAINT_SCORE = 0.1  # a pose with less, and fewer matches than the next line, is never localized
FAINT_MATCHES = 6
NEAR_SCORE = 0.6  # an alternative with this fraction of the best score is refined like the best
NEAR_MATCHES = 0.5  # and so is one with this fraction of its matches
MAX_REFINED = 4  # alternatives
MAX_UNOCCLUDED = 2  # rounds that mask occluders
NUM_ROUNDS = 2  # of the descent at full resolution
FULL_LIMITS = Limits(FULL_LOSS, 10, 1e-4)
LAST_LIMITS = Limits(FULL_LOSS, 30, 1e-7)
NEARLY = 0.02  # [m] after a smaller move the camera sees the same points
MAX_LAST_ROUNDS = 6
SETTLED = 1e-4  # [m] a smaller move ends the last rounds
MIN_SCORE_LEFT = 0.9  # fraction of the score that a descent on points must keep


def refine_to_the_end(query: Query, hypotheses: Sequence[Hypothesis]) -> Selection:
    """Refine the best hypothesis and the alternatives that come near it, and select the best.

    If all are faint, only the best is refined first, on fine cells; if it stays faint, refinement ends.
    """
    found = rank(hypotheses)
    if found.best.score < HOPELESS_SCORE:
        return found
    if is_faint(query, found):
        best = refine_unoccluded(query, found.best.pose)[1]
        found = select(query, rank([best, *found.alternatives]))
        if is_faint(query, found):
            return found
    least = max(NEAR_MATCHES * count_agreeing(query, found.best.pose), SURE_MATCHES)
    near: list[Hypothesis] = []
    far: list[Hypothesis] = []
    for h in found.alternatives:
        is_near = h.score > NEAR_SCORE * found.best.score or count_agreeing(query, h.pose) >= least
        (near if is_near and len(near) < MAX_REFINED else far).append(h)
    if not near:
        best = refine_unoccluded(query, found.best.pose)[1]
        return settle_best(query, rank([best, *found.alternatives]))
    poses = [h.pose for h in (found.best, *near)]
    ends = query.workers.map(partial(refine_full_resolution, query), poses, "descend")
    return settle_best(query, select(query, rank([*ends, *far])))


def is_faint(query: Query, found: Selection) -> bool:
    """Return True if the best pose and all alternatives have a low score and few matches."""
    return all(
        h.score < FAINT_SCORE and count_agreeing(query, h.pose) < FAINT_MATCHES
        for h in (found.best, *found.alternatives)
    )


def refine_unoccluded(query: Query, pose: Pose) -> tuple[Query, Hypothesis]:
    """Mask occluders and refine the pose, in rounds; return the masked query and the pose.

    The score of the pose is that of the whole photo.
    """
    h = score_pose(query, pose)
    for _ in range(MAX_UNOCCLUDED):
        shown = mask_occluders(query, h.pose)
        start = Fit(h.pose, h.score)
        if shown is not query:
            start = descend_fine(shown, perturb_middle(shown, h.pose).pose)
        refined = score_pose(query, refine_by_perturbation(shown, start).pose)
        gain = refined.score - h.score
        h = refined if gain > 0.0 else h
        if shown is query or gain < MIN_GAIN * refined.score:
            break
    return shown, h


def refine_full_resolution(query: Query, pose: Pose) -> Hypothesis:
    """Mask occluders, then descend on the visible points in the finest image."""
    shown, h = refine_unoccluded(query, pose)
    return descend_on_points(query, shown, h, FULL_LIMITS, NUM_ROUNDS, NEARLY)


def settle(query: Query, h: Hypothesis) -> Hypothesis:
    """Descend until the pose converges, so that it does not depend on where the search began."""
    shown = mask_occluders(query, h.pose)
    return descend_on_points(query, shown, h, LAST_LIMITS, MAX_LAST_ROUNDS, SETTLED)


def descend_on_points(
    query: Query, shown: Query, h: Hypothesis, limits: Limits, num_rounds: int, arrived: float
) -> Hypothesis:
    """Descend on the points visible from the pose, until a round moves it by less than `arrived` [m].

    The descent uses the masked query `shown`; the result is discarded if the whole photo's score falls.
    """
    pose = h.pose
    for k in range(num_rounds):
        center = pose.center_world
        if k == 0 and query.scan_map.has_shape:
            pose = descend(shown.points_at(pose), shown.photo.images.fine(), pose, FINE_LIMITS)
        pose = descend(shown.points_at(pose), shown.photo.images.full(), pose, limits)
        if math.dist(pose.center_world, center) < arrived:
            break
    end = score_pose(query, pose)
    return end if end.score > MIN_SCORE_LEFT * h.score else h


def settle_best(query: Query, found: Selection) -> Selection:
    """Refine the best pose to convergence; repeat if another becomes the best."""
    at_rest: list[Hypothesis] = []
    with query.workers.beside(partial(query.surroundings_at, found.best.pose)):  # it hardly moves
        for _ in range(1 + len(found.alternatives)):
            best = settle(query, found.best)
            at_rest.append(best)
            found = select(query, replace(found, best=best))
            if any(found.best is h for h in at_rest):
                break
    return found
