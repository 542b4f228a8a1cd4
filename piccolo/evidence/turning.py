"""The rotation of a photo whose position is known by other means, as a bare wall fixes no position."""

import numpy as np

from ..geometry.levenberg_marquardt import GRADIENT, MATRIX, levenberg_marquardt
from ..geometry.pose import Pose, orthonormal
from ..geometry.pose_gaussian import PoseGaussian, turn_positions
from ..judge.candidate import Candidate
from ..optimize.channel_loss import ChannelProblem, channel_equations
from ..problem.problem import Problem
from ..problem.stages import FULL
from ..system.arrays import Array
from .blocks import fill_symmetric, jackknife_gradients, sort_by_block, sum_by_block
from .comparison import mask_occluders
from .covariance import (
    LEAST_BLOCKS,
    compute_acting_range,
    compute_hessian,
    few_blocks_factor,
    make_problem,
    remove_poles,
)
from .scan_errors import layer_covariance, scan_covariance

OF_TURN = GRADIENT, GRADIENT + 1, GRADIENT + 2, *(MATRIX + k for k in (0, 1, 2, 6, 7, 11))
OF_MOVE = MATRIX + 15, MATRIX + 18, MATRIX + 20  # the diagonal: moves are possible, but not asked for


def turn_equations(
    problem: ChannelProblem, R_cam_from_world: Array, center_world: Array, sums: Array
) -> None:
    """Write the sums (29,) of `channel_equations` of a camera that turns but stays where it is."""
    channel_equations(problem, R_cam_from_world, center_world, sums)
    turning = np.zeros_like(sums)
    turning[:GRADIENT] = sums[:GRADIENT]
    turning[list(OF_TURN)] = sums[list(OF_TURN)]
    turning[list(OF_MOVE)] = 1.0
    sums[:] = turning


descend_turns = levenberg_marquardt(turn_equations)


def turn(problem: Problem, pose: Pose) -> Pose:
    """Return the pose at the same position whose rotation fits the photo best, from coarse to fine."""
    points = problem.view_at(pose, "points").around(pose.center_world)
    R_cam_from_map = pose.R_cam_from_world.copy()
    limits = FULL.limits
    for image in ("middle", "fine", "full"):
        asked = make_problem(points, problem.photo.image(image))
        descend_turns(asked, limits.num_iterations, limits.tolerance, R_cam_from_map, np.zeros(3))
    return Pose(orthonormal(R_cam_from_map), pose.center_world)


def estimate_turn(problem: Problem, candidate: Candidate, position: Array) -> PoseGaussian | None:
    """Return a candidate's pose in the map with its errors, if its position has a covariance (3, 3) [m^2].

    An error of the position displaces what the photo shows, and a turn makes up for that: the rotation errs
    with it. None where the points do not fix the rotation.
    """
    pose = candidate.pose
    masked = mask_occluders(problem, candidate.comparison, candidate.unoccluded).photo
    points = remove_poles(problem.show(masked).view_at(pose, "points").around(pose.center_world), pose)
    if points.offsets.shape[1] == 0:
        return None
    acting_range = compute_acting_range(points)
    points, begins = sort_by_block(points)
    R_cam_from_map = pose.R_cam_from_world
    moves = R_cam_from_map @ position @ R_cam_from_map.T
    found: list[Array] = []
    for steps in problem.profile.steps:
        asked = make_problem(points, masked.image(steps.image))
        hessian = compute_hessian(asked, pose, steps.turn, acting_range)
        sums = sum_by_block(asked, pose, begins)
        sums = sums[sums[:, GRADIENT : GRADIENT + 3].any(axis=1)]
        if len(sums) < LEAST_BLOCKS or np.linalg.eigvalsh(hessian[:3, :3])[0] <= 0.0:
            continue
        matrices = fill_symmetric(sums[:, MATRIX:])[:, :3, :3]
        gradients = jackknife_gradients(sums[:, GRADIENT : GRADIENT + 3], matrices)
        inverse = np.linalg.inv(hessian[:3, :3])
        factor = steps.inflation * few_blocks_factor(len(sums))
        turns = factor * inverse @ (gradients.T @ gradients) @ inverse
        slope = -inverse @ hessian[:3, 3:]
        found.append(np.block([[turns + slope @ moves @ slope.T, slope @ moves], [moves @ slope.T, moves]]))
    if not found:
        return None
    tells_most = min(found, key=lambda covariance: float(np.trace(covariance[:3, :3])))
    common = scan_covariance(problem.scan_map, acting_range)
    common = common + layer_covariance(problem.scan_map, pose, acting_range)
    of_grid = np.diag(np.repeat([(problem.method.pixel_share * problem.pixel) ** 2, 0.0], 3))
    return PoseGaussian(pose, turn_positions(tells_most, R_cam_from_map.T) + of_grid, common)
