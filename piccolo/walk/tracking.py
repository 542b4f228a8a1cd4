"""One frame, when it is known about where the camera was: a descent from there, or a search nearby."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE, Hypothesis, by_score, suppressed
from ..confidence.confidence import posterior
from ..geometry.pose import Pose, exp_so3, log_so3, pose_errors
from ..geometry.rotations import Gravity
from ..localization.attempts import (
    FIRST_BEAM,
    brief_query,
    first_score,
    is_rather_mirrored,
    mirror_score,
)
from ..localization.comparison import score_pose
from ..localization.covariance import estimate_covariance
from ..localization.prior import apply_prior
from ..localization.query import Cache, Query
from ..localization.refinement import FULL_LOSS, descend, descend_fine, descend_middle, perturb_middle, refine
from ..localization.search import search_poses
from ..localization.selection import rank, standings_of
from ..scan_map.prior import Prior
from .frames import OTHER_LOG_ODDS, State, log_ratio

LEAST_SCORE = 0.2  # of a frame that is tracked
LEAST_KEPT = 0.6  # of the score of the frame before
MOST_LISTED = 12  # poses of a frame
KEPT_BESIDE = 0.4  # of the best score: copies of a place are kept until the walk tells them apart
LAST_LIMITS = (FULL_LOSS, 10, 1e-5)  # of the last descent, as in refinement


def predicted(before: Pose, earlier: Pose, ratio: float, max_distance: float) -> Pose:
    """Where a camera is, going on as it went from an earlier pose to the last.

    `ratio` is the time since by the time between the two. At most max_distance [m] away.
    """
    move = ratio * (before.center_world - earlier.center_world)
    length = float(np.linalg.norm(move))
    move *= min(1.0, max_distance / max(length, 1e-9))
    turn = ratio * log_so3(before.R_cam_from_world @ earlier.R_cam_from_world.T)
    return Pose(exp_so3(turn) @ before.R_cam_from_world, before.center_world + move)


def tracked(query: Query, start: Pose, least_score: float) -> Hypothesis:
    """The pose to which a frame descends from one near it, or where it explains less, from farther around."""
    near = descend_fine(query, descend_middle(query, start).pose)
    if near.score < least_score:
        around = descend_fine(query, perturb_middle(query, near.pose).pose)
        near = max(near, around, key=lambda fit: fit.score)
    end = descend_last(query, near.pose)
    if end.score >= least_score:
        return end
    return max(end, score_pose(query, near.pose), key=lambda h: h.score)


def tracked_on(query: Query, end: Hypothesis) -> Hypothesis:
    """A pose that explains more, farther around one that was tracked; else the same."""
    around = descend_last(query, descend_fine(query, perturb_middle(query, end.pose).pose).pose)
    return max(end, around, key=lambda h: h.score)


def descend_last(query: Query, pose: Pose) -> Hypothesis:
    """The last descent, on the points themselves, with the score by which poses are selected."""
    pose = descend(query.points_at(pose), query.photo.images.full(), pose, LAST_LIMITS)
    return score_pose(query, pose)


def found_near(query: Query, near: Pose, radius: float, least_score: float) -> list[Hypothesis]:
    """Poses found within a radius [m] by whole views; none if the best has less than a score."""
    x, y, z = (float(value) for value in query.scan_map.to_world(near).center_world)
    some = apply_prior(query.scan_map, Prior(near_world=(x, y, z), radius=radius))
    if len(some.sparse) == 0:
        return []
    close = found_everywhere(replace(query, scan_map=some, cache=Cache(query.cache.views)), least_score)
    least = KEPT_BESIDE * max((h.score for h in close), default=0.0)
    ends = query.workers.map(lambda h: tracked(query, h.pose, least), close, "descend")
    return [end for end in ends if end.score >= least]


def found_everywhere(query: Query, least_score: float) -> list[Hypothesis]:
    """Poses found in a whole map by whole views, copies too, to centimetres, the best first.

    None if the best has less than a score.
    """
    first = brief_query(replace(query, num_halves=0))
    gravity: Gravity = "unknown" if query.settings.gravity == "unknown" else "known"
    starts = search_poses(first, gravity)
    if first_score(first, starts) < least_score or is_rather_mirrored(first, starts, mirror_score(first)):
        return []
    found = rank(refine(first, starts, FIRST_BEAM), MOST_LISTED - 1)
    if found.best.score < least_score:
        return []
    least = KEPT_BESIDE * found.best.score
    return [h for h in (found.best, *found.alternatives) if h.score >= least]


def states_at(query: Query, hypotheses: Sequence[Hypothesis]) -> list[State]:
    """Poses of a frame as states, with the odds that they have by whole views, the best first."""
    ranked = suppressed(by_score(hypotheses), MOST_LISTED, MIN_DISTANCE, MIN_ANGLE)
    asked = replace(query, num_halves=0)
    best, *others = ranked
    covariance = estimate_covariance(query, best.pose)
    standings = standings_of(asked, best, others)
    *probabilities, none = posterior(standings, covariance)
    return [
        State(h.pose, log_ratio(float(p), float(none)), h.score, covariance if h is best else None)
        for h, p in zip(ranked, probabilities, strict=True)
    ]


def beside(query: Query, states: Sequence[State], found: Hypothesis) -> State | None:
    """A pose as a state beside others of its frame, by what it explains by the best.

    None if it is one of them, or so much worse that it can't be a copy.
    """
    best = max(states, key=lambda state: state.log_odds)
    if any(is_same(state.pose, found.pose) for state in states):
        return None
    asked, at_best = replace(query, num_halves=0), Hypothesis(best.pose, best.score)
    first, second = posterior(standings_of(asked, at_best, [found]), None)[:2]
    odds = best.log_odds + log_ratio(float(second), float(first))
    if odds < best.log_odds - OTHER_LOG_ODDS:
        return None
    return State(found.pose, odds, found.score, estimate_covariance(query, found.pose), best.num_matches)


def is_same(pose: Pose, other: Pose) -> bool:
    """True for two poses that are one answer."""
    distance, angle = pose_errors(pose, other)
    return distance < MIN_DISTANCE and angle < MIN_ANGLE
