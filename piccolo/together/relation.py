"""The pose of a photo by its matches with others whose keypoints have ranges, and the errors of that pose.

Matches of a wall, or of few things far away, fit several poses nearly equally well. So further descents begin
on both sides of the pose, along the two directions that the matches determine least. The distances of the
optima that they find are added to the errors, weighted by how likely the optima are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..evidence.verification import DRAWN_INFLATION, match_covariance
from ..geometry.pose import Pose, rotate_points
from ..geometry.pose_gaussian import add, differentiate_rays, subtract
from ..geometry.robust import geman_mcclure
from ..local_features.hypotheses import COS_EXACT, REFINE_SCALE, find_inliers, refine_on
from ..local_features.matching import Matches
from ..system.arrays import Array

NUM_WEAK = 2  # directions in which further descents begin
TRIED = (0.15, 0.3)  # [m] distances of their starts, on both sides of the pose
RANGE_OF_TURN = 3.0  # chosen: [m] times a turn [rad] is the move to which the turn is compared
STEPS_OF_RELATION = 30  # steps of a descent
LEAST_MOVE = 0.05  # part of a unit direction that moves the camera: with less, it is hardly more than a turn


class Relation(NamedTuple):
    """A pose by matches."""

    pose: Pose
    covariance: Array  # (6, 6) as of `PoseGaussian`


def relate(matches: Matches, near: Pose) -> Relation:
    """Return the best pose near one by matches, and its errors."""
    information = compute_information(matches, near)
    starts = [near, *(add(near, step) for step in list_weak_steps(information))]
    ends = [
        refine_on(matches, refine_on(matches, start, STEPS_OF_RELATION), STEPS_OF_RELATION)
        for start in starts
    ]
    losses = np.array([compute_match_loss(matches, end) for end in ends])
    best = ends[int(losses.argmin())]
    weights = np.exp(losses.min() - losses)
    errors = DRAWN_INFLATION * match_covariance(matches, best) + spread_over(ends, best, weights)
    return Relation(best, errors)


def spread_over(ends: Sequence[Pose], pose: Pose, weights: Array) -> Array:
    """Return the weighted mean square (6, 6) of the steps from a pose to other poses, as errors of it."""
    steps = np.array([subtract(end, pose) for end in ends])
    return np.asarray((weights[:, None] * steps).T @ steps / weights.sum())


def compute_information(matches: Matches, pose: Pose) -> Array:
    """Return the information (6, 6) that the matches that agree with a pose give of it, up to a factor."""
    agreeing = find_inliers(matches, pose, COS_EXACT)
    _, J = differentiate_rays(matches.points[agreeing], pose)
    return np.asarray(np.einsum("kai,kaj->ij", J, J))


def list_weak_steps(information: Array) -> list[Array]:
    """Return steps (6,) in the directions in which a pose is least determined, by its information (6, 6)."""
    units = np.array([1.0, 1.0, 1.0, *[1.0 / RANGE_OF_TURN] * 3])
    _, axes = np.linalg.eigh(units[:, None] * information * units)
    steps = []
    for direction in (units[:, None] * axes[:, :NUM_WEAK]).T:
        move = float(np.linalg.norm(direction[3:]))
        if move > LEAST_MOVE:
            steps += [sign * size / move * direction for size in TRIED for sign in (1.0, -1.0)]
    return steps


def compute_match_loss(matches: Matches, pose: Pose) -> float:
    """Return the loss of a pose, at most 1 for each of the photo's keypoints, by the best of its matches."""
    offsets = rotate_points(matches.points - pose.center_world, pose.R_cam_from_world)
    rays = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    squares = np.square(rays - matches.rays).sum(axis=1)
    least = np.full(int(matches.query.max()) + 1, np.inf)
    np.minimum.at(least, matches.query, squares)
    losses, _ = geman_mcclure(least[np.isfinite(least)], REFINE_SCALE**-2)
    return float(2.0 * losses.sum() / REFINE_SCALE**2)
