"""The sampling loss of the paper (Eq. 2), its gradient and its normal equations.

    L(R, t) = (1 / N') sum_i || I(Pi(R (x_i - t))) - c_i ||_2

over the N' points that do not fall on masked pixels. Colours are in [0, 1]; norms are not squared. Steps of a
pose are those of `normal_equations`.

Kernels sum in float32 within chunks of 512 points. The sums of the chunks are added in float64, in order,
first within blocks of 4,096 points and then over the blocks.
"""

import math
from collections.abc import Callable

import numpy as np

from ..geometry.levenberg_marquardt import GRADIENT, MATRIX, NUM_SUMS
from ..geometry.points import FARTHEST_POINT, PackedPoints
from ..geometry.pose import Pose
from ..geometry.robust import inline_absolute
from ..photo.panorama.texels import (
    TEXEL_CHUNK,
    Texels,
    bilinear_weights,
    blend,
    channel,
    is_valid,
    make_chunk,
    project,
)
from ..system.arrays import Array, Array32, Int32s
from ..system.kernels.jit import F0, F1, Scalar, inline_kernel, kernel
from .normal_equations import block_adder

POINTS_A_SUM = 4096
# A pose has no loss if a smaller fraction of the points falls on valid pixels. If only a part of the panorama
# is valid, this is multiplied by the square of that part: a crop may face the nearer wall, with fewer points.
MIN_SHOWN_SHARE = 0.5
HALF_LEVEL = np.float32(0.5)  # a residual below half an 8-bit level has the weight of half a level
TO_UNIT = 1.0 / 255.0
Points = tuple[Array32, Array32, Array32, Int32s]  # x, y, z [m] and packed colours (N,)


@kernel
def loss_blocks(
    points: Points, image: Texels, R_cam_from_world: Array, center_world: Array, sums: Array
) -> None:
    """Write, by block (blocks, 2), the sum of residual norms [8-bit levels] and the count of points."""
    x, y, z, rgbx = points
    p = make_chunk()
    for block in range(len(sums)):
        begin = block * POINTS_A_SUM
        end = min(len(x), begin + POINTS_A_SUM)
        sums[block] = 0.0
        for lo in range(begin, end, TEXEL_CHUNK):
            hi = min(lo + TEXEL_CHUNK, end)
            part = slice(lo, hi)
            project(x[part], y[part], z[part], R_cam_from_world, center_world, image.rgbx, image.width, p)
            colors = rgbx[lo:hi]
            total = count = F0
            for n in range(hi - lo):
                weights = bilinear_weights(p.fu[n], p.fv[n])
                t00, t10, t01, t11 = p.t00[n], p.t10[n], p.t01[n], p.t11[n]
                c = colors[n]
                dr = blend(t00, t10, t01, t11, weights, 0) - channel(c, 0)
                dg = blend(t00, t10, t01, t11, weights, 8) - channel(c, 8)
                db = blend(t00, t10, t01, t11, weights, 16) - channel(c, 16)
                counts = is_valid(t00, t10, t01, t11)
                total += counts * math.sqrt(dr * dr + dg * dg + db * db)
                count += counts
            sums[block, 0] += total
            sums[block, 1] += count


@inline_kernel
def read_packed(rgbx: Int32s, i: np.uintp) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return channels [8-bit levels] and weight, always 1, of a point with a packed colour."""
    c = rgbx[i]
    return channel(c, 0), channel(c, 8), channel(c, 16), F1


add_packed = block_adder(read_packed, inline_absolute)


@kernel
def normal_blocks(
    points: Points, image: Texels, R_cam_from_world: Array, center_world: Array, sums: Array
) -> None:
    """Write, by block (blocks, 29), loss, count, gradient and the upper triangle of sum J^T J / norm."""
    x, y, z, rgbx = points
    R, t = R_cam_from_world, center_world
    for block in range(len(sums)):
        lo = block * POINTS_A_SUM
        part = slice(lo, min(len(x), lo + POINTS_A_SUM))
        sums[block] = 0.0
        xyz = (x[part], y[part], z[part])
        add_packed(xyz, rgbx[part], image.rgbx, image.width, R, t, HALF_LEVEL, sums[block])


def _sum_blocks(blocks: Callable[..., None], points: PackedPoints, texels: Texels, pose: Pose) -> Array:
    """Call a kernel that writes a row of sums for each block of points; return the total of these rows."""
    if not np.abs(pose.center_world).max() < FARTHEST_POINT:  # or NaN: a kernel would read outside the image
        return np.zeros(NUM_SUMS)
    sums = np.empty((-(-len(points) // POINTS_A_SUM), NUM_SUMS if blocks is normal_blocks else 2))
    arrays = points.x, points.y, points.z, points.rgbx
    blocks(arrays, texels, pose.R_cam_from_world, pose.center_world, sums)
    return np.asarray(sums.sum(axis=0))


def _is_hidden(count: float, points: PackedPoints, texels: Texels) -> bool:
    """Return True if masked pixels hide so many points that a pose has no loss."""
    return bool(count <= MIN_SHOWN_SHARE * texels.valid_share**2 * len(points))


def sampling_loss(points: PackedPoints, texels: Texels, pose: Pose) -> float:
    """Compute the paper's Eq. 2 at `pose`, in [0, sqrt(3)]; inf if masked pixels hide too many points."""
    total, count = _sum_blocks(loss_blocks, points, texels, pose)[:2]
    if _is_hidden(count, points, texels):
        return math.inf
    return float(total / count * TO_UNIT)


def sampling_equations(points: PackedPoints, texels: Texels, pose: Pose) -> tuple[float, Array, Array]:
    """Compute loss, gradient (6,) and matrix (6, 6) of iteratively reweighted least squares at `pose`.

    The matrix is (1 / N') sum_i J_i^T J_i / ||e_i||; -inverse(matrix) @ gradient is the Gauss-Newton step.
    """
    sums = _sum_blocks(normal_blocks, points, texels, pose)
    total, count = sums[:2]
    if _is_hidden(count, points, texels):
        return math.inf, np.zeros(6), np.eye(6)
    per_point = TO_UNIT / count
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = sums[MATRIX:]
    matrix = matrix + np.triu(matrix, 1).T
    return float(total * per_point), sums[GRADIENT:MATRIX] * per_point, matrix * per_point
