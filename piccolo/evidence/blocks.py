"""Normal equations of a pose, by blocks of the sphere whose errors are independent."""

import math

import numpy as np
from numpy.typing import NDArray

from ..geometry.levenberg_marquardt import GRADIENT, MATRIX, NUM_SUMS
from ..geometry.pose import Pose
from ..geometry.sphere import find_cell
from ..optimize.channel_loss import ChannelProblem, equations_by_part
from ..system.arrays import Array, Int64s, Integers, Mask
from ..views.view import Cells

ERROR_RINGS = 12  # 184 blocks of 15 degrees: errors within one are taken as one error
ERROR_COLUMNS = 24  # of 15 degrees: errors within one are taken as one error of a whole sphere
LEAST_COLUMNS = 20  # that have points: else blocks count, as columns are too few
ONE_BLOCK = 1.001  # above 1, so that one block may hold all information


def take(points: Cells, which: Mask | NDArray[np.intp]) -> Cells:
    """Return some of the points, by a mask or by their indices in a new order."""
    offsets, channels, weights = (np.ascontiguousarray(values[..., which]) for values in points[:3])
    return Cells(offsets, channels, weights, points.center_map)


def fill_symmetric(upper: Array) -> Array:
    """Return symmetric matrices (..., 6, 6) from their upper triangles (..., 21), row by row."""
    matrix = np.zeros((*upper.shape[:-1], 6, 6))
    rows, columns = np.triu_indices(6)
    matrix[..., rows, columns] = upper
    matrix[..., columns, rows] = upper
    return matrix


def sort_by(points: Cells, labels: Integers) -> tuple[Cells, Int64s]:
    """Sort points by labels (N,); return also where each label begins, and the number of points (B + 1,)."""
    begins = np.concatenate([[0], np.cumsum(np.bincount(labels))])
    return take(points, np.argsort(labels, kind="stable")), begins


def sort_by_block(points: Cells) -> tuple[Cells, Int64s]:
    """Sort the points around a camera by the block of the sphere in which each lies."""
    ranges = np.linalg.norm(points.offsets, axis=0)
    return sort_by(points, find_cell(points.offsets.T / ranges[:, None], ERROR_RINGS))


def sort_by_column(points: Cells) -> tuple[Cells, Int64s]:
    """Sort the points around a camera by columns from pole to pole; by blocks if they are not all around.

    Edges of buildings are upright, and longer than a block. A scanner that turns displaces all of one alike.
    """
    turns = np.arctan2(points.offsets[1], points.offsets[0]).astype(np.float64) / math.tau + 0.5
    columns = np.minimum((ERROR_COLUMNS * turns).astype(np.int64), ERROR_COLUMNS - 1)
    is_around = np.count_nonzero(np.bincount(columns)) >= LEAST_COLUMNS
    return sort_by(points, columns) if is_around else sort_by_block(points)


def sum_by_block(problem: ChannelProblem, pose: Pose, begins: Int64s) -> Array:
    """Sum the normal equations (B, 29) over each block's points around a pose, from its `begins` (B + 1,)."""
    sums = np.empty((len(begins) - 1, NUM_SUMS))
    equations_by_part(problem, pose.R_cam_from_world, np.zeros(3), begins, sums)
    return sums


def block_gradients(sums: Array) -> Array:
    """Return jackknife gradients (B, 6), in the camera's frame, from the sums (B, 29) of blocks."""
    shown = sums[sums[:, GRADIENT:MATRIX].any(axis=1)]  # of what the photo shows
    return jackknife_gradients(shown[:, GRADIENT:MATRIX], fill_symmetric(shown[:, MATRIX:]))


def jackknife_gradients(gradients: Array, matrices: Array) -> Array:
    """Return gradients (B, n) as at a pose found without each block, by matrices (B, n, n).

    The more information one block holds, the more the pose has followed its errors, and the less of them its
    gradient shows: g <- (I - A_b A^-1)^-1 g, with the block's part A_b of the Gauss-Newton matrix A
    (the estimate CR3 of Bell and McCaffrey, 2002).
    """
    shares = matrices @ np.linalg.pinv(matrices.sum(axis=0))
    identity = np.eye(gradients.shape[1])
    return np.asarray(np.linalg.solve(ONE_BLOCK * identity - shares, gradients[..., None])[..., 0])
