"""The sampling loss of the paper (Eq. 2), its gradient and its normal equations.

    L(R, t) = (1 / N') sum_i || I(Pi(R (x_i - t))) - c_i ||_2

over the N' points that do not fall on masked pixels; colours in [0, 1], a mean of unsquared norms. A step
(w, d), rotation [rad] then translation [m], acts as R <- exp([w]x) R and t <- t + R^T d, so that with
p = R (x - t): dp = w x p - d. A scalar image of gradient g = dI/dp has the row [p x g, -g].

Kernels sum float32 within blocks of 4,096 points; the blocks' sums are added in float64 in order. The result
has the same bits for any number of threads.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import FARTHEST, PackedPoints
from ..geometry.pose import Array, Pose
from ..geometry.sphere import direction_to_pixel, pixel_jacobian
from ..panorama.texels import Texels, bilinear_weights, blend, blend_with_gradient, channel
from ..runtime.jit import F0, kernel
from ..runtime.threads import Workers

BLOCK = 4096
NUM_SUMS = 29  # loss, count, gradient (6), upper triangle of the normal matrix (21)
# A pose that hides more of the cloud behind masked pixels has no loss. Of a panorama valid in part, the least
# share of points that must show goes with the square of that part: a crop may face the nearer wall.
MIN_SHOWN_SHARE = 0.5
HALF_LEVEL = np.float32(0.5)  # a residual below half an 8-bit level has the weight of half a level
TO_UNIT = 1.0 / 255.0


@kernel
def loss_blocks(x, y, z, rgbx, R_cam_from_world, center_world, texels, width, first_block, sums):
    """Write for each block (blocks, 2): the sum of the residual norms [8-bit levels], the count of points."""
    R, t = R_cam_from_world, center_world
    W, stride = np.float32(width), np.int32(width + 2)
    r00, r01, r02 = np.float32(R[0, 0]), np.float32(R[0, 1]), np.float32(R[0, 2])
    r10, r11, r12 = np.float32(R[1, 0]), np.float32(R[1, 1]), np.float32(R[1, 2])
    r20, r21, r22 = np.float32(R[2, 0]), np.float32(R[2, 1]), np.float32(R[2, 2])
    tx, ty, tz = np.float32(t[0]), np.float32(t[1]), np.float32(t[2])
    # An unsigned index needs no test for being negative; four bases and one 32-bit index gather fastest.
    right, below, below_right = texels[1:], texels[stride:], texels[stride + 1 :]
    for block in range(len(sums)):
        lo = (first_block + block) * BLOCK
        hi = min(len(x), lo + BLOCK)
        # Slices counted from 0: a loop from `lo` keeps the test for negative indices in every load.
        xs, ys, zs, cs = x[lo:hi], y[lo:hi], z[lo:hi], rgbx[lo:hi]
        total = F0
        count = F0
        for i in range(hi - lo):
            dx, dy, dz = xs[i] - tx, ys[i] - ty, zs[i] - tz
            px = r00 * dx + r01 * dy + r02 * dz
            py = r10 * dx + r11 * dy + r12 * dz
            pz = r20 * dx + r21 * dy + r22 * dz
            u, v = direction_to_pixel(px, py, pz, math.sqrt(px * px + py * py), W)
            j = np.int32(u + HALF_LEVEL)
            k = np.int32(v + HALF_LEVEL)
            weights = bilinear_weights(u + HALF_LEVEL - np.float32(j), v + HALF_LEVEL - np.float32(k))
            at = np.uintp(np.int32(k * stride + j))
            t00, t10, t01, t11 = texels[at], right[at], below[at], below_right[at]
            c = cs[i]
            dr = blend(t00, t10, t01, t11, weights, 0) - channel(c, 0)
            dg = blend(t00, t10, t01, t11, weights, 8) - channel(c, 8)
            db = blend(t00, t10, t01, t11, weights, 16) - channel(c, 16)
            counts = np.float32((t00 & t10 & t01 & t11) >> 24)
            total += counts * math.sqrt(dr * dr + dg * dg + db * db)
            count += counts
        sums[block, 0] = total
        sums[block, 1] = count


@kernel
def normal_blocks(x, y, z, rgbx, R_cam_from_world, center_world, texels, width, first_block, sums):
    """Write for each block (blocks, 29): loss, count, gradient, upper triangle of sum J^T J / norm.

    Longer than other kernels: split, its 28 sums would leave the registers.
    """
    R, t = R_cam_from_world, center_world
    W, stride = np.float32(width), np.int32(width + 2)
    r00, r01, r02 = np.float32(R[0, 0]), np.float32(R[0, 1]), np.float32(R[0, 2])
    r10, r11, r12 = np.float32(R[1, 0]), np.float32(R[1, 1]), np.float32(R[1, 2])
    r20, r21, r22 = np.float32(R[2, 0]), np.float32(R[2, 1]), np.float32(R[2, 2])
    tx, ty, tz = np.float32(t[0]), np.float32(t[1]), np.float32(t[2])
    # An unsigned index needs no test for being negative; four bases and one 32-bit index gather fastest.
    right, below, below_right = texels[1:], texels[stride:], texels[stride + 1 :]
    for block in range(len(sums)):
        lo = (first_block + block) * BLOCK
        hi = min(len(x), lo + BLOCK)
        xs, ys, zs, cs = x[lo:hi], y[lo:hi], z[lo:hi], rgbx[lo:hi]
        total = count = F0
        g0 = g1 = g2 = g3 = g4 = g5 = F0
        h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = F0
        h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = F0
        for i in range(hi - lo):
            dx, dy, dz = xs[i] - tx, ys[i] - ty, zs[i] - tz
            px = r00 * dx + r01 * dy + r02 * dz
            py = r10 * dx + r11 * dy + r12 * dz
            pz = r20 * dx + r21 * dy + r22 * dz
            rho2 = px * px + py * py
            u, v = direction_to_pixel(px, py, pz, math.sqrt(rho2), W)
            j = np.int32(u + HALF_LEVEL)
            k = np.int32(v + HALF_LEVEL)
            fu, fv = u + HALF_LEVEL - np.float32(j), v + HALF_LEVEL - np.float32(k)
            at = np.uintp(np.int32(k * stride + j))
            t00, t10, t01, t11 = texels[at], right[at], below[at], below_right[at]
            c = cs[i]
            r, ru, rv = blend_with_gradient(t00, t10, t01, t11, fu, fv, 0)
            g, gu, gv = blend_with_gradient(t00, t10, t01, t11, fu, fv, 8)
            b, bu, bv = blend_with_gradient(t00, t10, t01, t11, fu, fv, 16)
            r, g, b = r - channel(c, 0), g - channel(c, 8), b - channel(c, 16)
            norm = math.sqrt(r * r + g * g + b * b)
            counts = np.float32((t00 & t10 & t01 & t11) >> 24)
            total += counts * norm
            count += counts
            w = counts / max(norm, HALF_LEVEL)
            # The image enters only by a 2 x 2 matrix and two sums over its channels.
            a_uu, a_uv = w * (ru * ru + gu * gu + bu * bu), w * (ru * rv + gu * gv + bu * bv)
            a_vv = w * (rv * rv + gv * gv + bv * bv)
            e_u, e_v = w * (ru * r + gu * g + bu * b), w * (rv * r + gv * g + bv * b)
            # Rows [p x g, -g] of u and v; du/dz is 0 and the v-row has nothing about z.
            ux, uy, vx, vy, vz = pixel_jacobian(px, py, pz, rho2, W)
            u0, u1, u2 = -pz * uy, pz * ux, px * uy - py * ux
            v0, v1 = py * vz - pz * vy, pz * vx - px * vz
            s0, s1, s2 = a_uu * u0 + a_uv * v0, a_uu * u1 + a_uv * v1, a_uu * u2
            s3, s4, s5 = -a_uu * ux - a_uv * vx, -a_uu * uy - a_uv * vy, -a_uv * vz
            q0, q1, q2 = a_uv * u0 + a_vv * v0, a_uv * u1 + a_vv * v1, a_uv * u2
            q3, q4, q5 = -a_uv * ux - a_vv * vx, -a_uv * uy - a_vv * vy, -a_vv * vz
            g0, g1, g2 = g0 + (u0 * e_u + v0 * e_v), g1 + (u1 * e_u + v1 * e_v), g2 + u2 * e_u
            g3, g4, g5 = g3 - (ux * e_u + vx * e_v), g4 - (uy * e_u + vy * e_v), g5 - vz * e_v
            h00, h01, h02 = h00 + (u0 * s0 + v0 * q0), h01 + (u0 * s1 + v0 * q1), h02 + (u0 * s2 + v0 * q2)
            h03, h04, h05 = h03 + (u0 * s3 + v0 * q3), h04 + (u0 * s4 + v0 * q4), h05 + (u0 * s5 + v0 * q5)
            h11, h12, h13 = h11 + (u1 * s1 + v1 * q1), h12 + (u1 * s2 + v1 * q2), h13 + (u1 * s3 + v1 * q3)
            h14, h15 = h14 + (u1 * s4 + v1 * q4), h15 + (u1 * s5 + v1 * q5)
            h22, h23, h24, h25 = h22 + u2 * s2, h23 + u2 * s3, h24 + u2 * s4, h25 + u2 * s5
            h33, h34, h35 = h33 - (ux * s3 + vx * q3), h34 - (ux * s4 + vx * q4), h35 - (ux * s5 + vx * q5)
            h44, h45, h55 = h44 - (uy * s4 + vy * q4), h45 - (uy * s5 + vy * q5), h55 - vz * q5
        s = sums[block]
        s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7] = total, count, g0, g1, g2, g3, g4, g5
        s[8], s[9], s[10], s[11], s[12], s[13] = h00, h01, h02, h03, h04, h05
        s[14], s[15], s[16], s[17], s[18] = h11, h12, h13, h14, h15
        s[19], s[20], s[21], s[22] = h22, h23, h24, h25
        s[23], s[24], s[25], s[26], s[27], s[28] = h33, h34, h35, h44, h45, h55


def _sum_blocks(
    blocks: Callable[..., None], points: PackedPoints, texels: Texels, pose: Pose, num_threads: int
) -> Array:
    """Sums over all points, float64, by a kernel that fills one row of float32 a block."""
    if not np.abs(pose.center_world).max() < FARTHEST:  # NaN included: a kernel must not gather there
        return np.zeros(NUM_SUMS)
    num_blocks = -(-len(points) // BLOCK)
    sums = np.empty((num_blocks, NUM_SUMS if blocks is normal_blocks else 2), dtype=np.float32)
    bounds = np.linspace(0, num_blocks, num_threads + 1).astype(np.int64)

    def run(part: int) -> None:
        lo, hi = bounds[part], bounds[part + 1]
        p, R, t = points, pose.R_cam_from_world, pose.center_world
        blocks(p.x, p.y, p.z, p.rgbx, R, t, texels.rgbx, texels.width, lo, sums[lo:hi])

    list(Workers(num_threads).each(run, range(num_threads), "blocks"))
    return np.asarray(sums.sum(axis=0, dtype=np.float64))


def sampling_loss(points: PackedPoints, texels: Texels, pose: Pose, num_threads: int = 1) -> float:
    """The paper's Eq. 2 at `pose`, in [0, sqrt(3)]; inf where masked pixels hide too many of the points."""
    total, count = _sum_blocks(loss_blocks, points, texels, pose, num_threads)[:2]
    if count <= MIN_SHOWN_SHARE * texels.valid_share**2 * len(points):
        return math.inf
    return float(total / count * TO_UNIT)


def normal_equations(
    points: PackedPoints, texels: Texels, pose: Pose, num_threads: int = 1
) -> tuple[float, Array, NDArray[np.float64]]:
    """Loss, its gradient (6,) and the matrix (6, 6) of iteratively reweighted least squares at `pose`.

    The matrix is (1 / N') sum_i J_i^T J_i / ||e_i||; -inverse(matrix) @ gradient is the Gauss-Newton step.
    """
    sums = _sum_blocks(normal_blocks, points, texels, pose, num_threads)
    total, count = sums[:2]
    if count <= MIN_SHOWN_SHARE * texels.valid_share**2 * len(points):
        return math.inf, np.zeros(6), np.eye(6)
    per_point = TO_UNIT / count
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = sums[8:]
    matrix = matrix + np.triu(matrix, 1).T
    return float(total * per_point), sums[2:8] * per_point, matrix * per_point
