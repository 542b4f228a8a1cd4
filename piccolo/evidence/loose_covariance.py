"""Errors of a pose that a photo does not fix, as one of a bare wall: large where the photo tells nothing."""

import numpy as np

from ..geometry.pose_gaussian import PoseGaussian, turn_positions
from ..judge.candidate import Candidate
from ..problem.problem import Problem
from ..system.arrays import Array
from .blocks import block_gradients, sort_by_block, sum_by_block
from .comparison import mask_occluders
from .covariance import (
    LEAST_BLOCKS,
    common_covariance,
    compute_acting_range,
    compute_hessian,
    few_blocks_factor,
    grid_covariance,
    make_problem,
    remove_poles,
)

FLAT_CURVATURE = 1e-3  # chosen: curvature of the loss in a direction, divided by the greatest
FLAT_DEVIATION = 1.0  # [rad] in a flat direction, moves as seen from the acting range
MOST_FLAT = 2  # directions: along a wall, and up or around one axis


def estimate_loosely(problem: Problem, candidate: Candidate) -> PoseGaussian | None:
    """Return a candidate's pose in the map with its errors, which are large where the photo fixes nothing.

    A bare wall fixes all but a move along it. Such a direction, in which the loss hardly rises or even falls,
    is left to other evidence. Of the images, the one that leaves the fewest directions counts. None if more
    than MOST_FLAT are left.
    """
    pose = candidate.pose
    masked = mask_occluders(problem, candidate.comparison, candidate.unoccluded).photo
    points = remove_poles(problem.show(masked).view_at(pose, "points").around(pose.center_world), pose)
    if points.offsets.shape[1] == 0:
        return None
    acting_range = compute_acting_range(points)
    points, begins = sort_by_block(points)
    found: list[tuple[int, Array]] = []
    for steps in (*problem.profile.steps, problem.profile.rough_steps):
        asked = make_problem(points, masked.image(steps.image))
        hessian = compute_hessian(asked, pose, steps.turn, acting_range)
        gradients = block_gradients(sum_by_block(asked, pose, begins))
        if len(gradients) >= LEAST_BLOCKS:
            factor = steps.inflation * few_blocks_factor(len(gradients))
            found.append(loose_covariance(hessian, gradients, factor, acting_range))
    if not found:
        return None
    num_flat, covariance = min(found, key=lambda one: (one[0], float(np.trace(one[1]))))
    if num_flat > MOST_FLAT:
        return None
    own = turn_positions(covariance, pose.R_cam_from_world.T) + grid_covariance(problem)
    return PoseGaussian(pose, own, common_covariance(problem, pose, acting_range))


def loose_covariance(
    hessian: Array, gradients: Array, factor: float, acting_range: float
) -> tuple[int, Array]:
    """Return the number of flat directions, and a covariance (6, 6) in which these have FLAT_DEVIATION.

    The others are as in `covariance.sandwich_covariance`, times a factor. Moves are compared with turns as
    angles seen from `acting_range` [m].
    """
    units = np.repeat([1.0, acting_range], 3)
    curvatures, axes = np.linalg.eigh(units[:, None] * hessian * units)
    is_flat = curvatures <= FLAT_CURVATURE * curvatures[-1]
    known = axes[:, ~is_flat]
    slopes = known.T @ (units * gradients).T / curvatures[~is_flat, None]
    covariance = factor * known @ slopes @ slopes.T @ known.T
    covariance += FLAT_DEVIATION**2 * axes[:, is_flat] @ axes[:, is_flat].T
    return int(is_flat.sum()), np.asarray(units[:, None] * covariance * units)
