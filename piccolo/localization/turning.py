"""The rotation of a photo whose position is known by other means."""

import numpy as np

from ..evidence.covariance import make_problem
from ..geometry.levenberg_marquardt import GRADIENT, MATRIX, levenberg_marquardt
from ..geometry.pose import Pose, orthonormal
from ..judge.alternatives import Hypothesis
from ..optimize.channel_loss import ChannelProblem, channel_equations
from ..photo.panorama.texels import Texels
from ..problem.problem import Problem
from ..problem.stages import FULL, MIDDLE, ImageName
from ..system.arrays import Array
from ..views.view import Cells
from .ladder import score_on_cells, see_cells

COARSE_TO_FINE: tuple[ImageName, ...] = ("middle", "fine", "full")
SUMS_OF_TURN = GRADIENT, GRADIENT + 1, GRADIENT + 2, *(MATRIX + k for k in (0, 1, 2, 6, 7, 11))
SUMS_OF_MOVE = MATRIX + 15, MATRIX + 18, MATRIX + 20  # the diagonal alone: no gradient asks for a move


def turn_equations(
    problem: ChannelProblem, R_cam_from_world: Array, center_world: Array, sums: Array
) -> None:
    """Write the sums (29,) of `channel_equations` of a camera that turns but stays where it is."""
    channel_equations(problem, R_cam_from_world, center_world, sums)
    turning = np.zeros_like(sums)
    turning[:GRADIENT] = sums[:GRADIENT]
    turning[list(SUMS_OF_TURN)] = sums[list(SUMS_OF_TURN)]
    turning[list(SUMS_OF_MOVE)] = 1.0
    sums[:] = turning


descend_turns = levenberg_marquardt(turn_equations)


def turn(problem: Problem, pose: Pose) -> Pose:
    """Return the pose at the same position whose rotation fits the photo best, on one image after another."""
    points = problem.view_at(pose, "points")
    for image in COARSE_TO_FINE:
        pose = turn_on(points, problem.photo.image(image), pose)
    return pose


def turn_roughly(problem: Problem, pose: Pose) -> Hypothesis:
    """Return the pose at the same position whose rotation fits the photo best on coarse cells, scored there.

    All rotations at a position are searched by it.
    """
    cells, blocks = see_cells(problem, pose, MIDDLE.view)
    image = problem.photo.image(MIDDLE.image)
    return score_on_cells(cells, blocks, image, turn_on(cells, image, pose))


def turn_on(cells: Cells, image: Texels, pose: Pose) -> Pose:
    """Return the pose at the same position whose rotation fits an image best."""
    asked = make_problem(cells.around(pose.center_world), image)
    R_cam_from_map = pose.R_cam_from_world.copy()
    limits = FULL.limits
    descend_turns(asked, limits.num_iterations, limits.tolerance, R_cam_from_map, np.zeros(3))
    return Pose(orthonormal(R_cam_from_map), pose.center_world)
