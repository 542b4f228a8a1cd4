"""The normal equations of a pose together with corrections of the picture's geometry (self-calibration).

A correction displaces a point, in the camera's axes, by a vector m for each unit of the correction (`moves`).
Its column of the Jacobian is the image gradient g along that vector, m . g. The columns of the corrections
follow those of the pose, [p x g, -g] in `normal_equations`.
"""

from typing import NamedTuple

import numpy as np

from ..geometry.robust import inline_geman_mcclure
from ..geometry.sphere import pixel_jacobian
from ..photo.panorama.texels import TEXEL_CHUNK, blend_with_gradient, is_valid, make_chunk, project
from ..system.arrays import Array, Array32, Int64s
from ..system.kernels.jit import F0, kernel
from .channel_loss import ChannelProblem

NUM_OF_POSE = 6  # numbers of a pose's step


class FreeSums(NamedTuple):
    """Sums of the equations over parts of the points; the n unknowns are 6 of the pose, then corrections."""

    loss: Array  # (parts,)
    weight: Array  # (parts,) sum of the weights of the points on valid pixels
    gradients: Array  # (parts, n)
    matrices: Array  # (parts, n, n)


@kernel
def write_free_equations(
    problem: ChannelProblem,
    moves: Array32,
    begins: Int64s,
    loss: Array,
    weight: Array,
    gradients: Array,
    matrices: Array,
) -> None:
    """Write the sums of `FreeSums` for points in the camera's axes, and their moves (p, 3, N) by corrections.

    Of each matrix the upper triangle is written. Part k is the points from begins[k] to begins[k + 1]. Points
    on masked pixels add nothing.
    """
    points, channels, weights, texels, width, scale = problem
    n = NUM_OF_POSE + len(moves)
    inverse_scale2 = np.float32(1.0 / (scale * scale))
    identity = np.eye(3)
    origin = np.zeros(3)
    of_u = np.empty(n, np.float32)
    of_v = np.empty(n, np.float32)
    p = make_chunk()
    loss[:] = 0.0
    weight[:] = 0.0
    gradients[:] = 0.0
    matrices[:] = 0.0
    for k in range(len(begins) - 1):
        g = gradients[k]
        A = matrices[k]
        for lo in range(begins[k], begins[k + 1], TEXEL_CHUNK):
            hi = min(lo + TEXEL_CHUNK, begins[k + 1])
            X, Y, Z = points[0][lo:hi], points[1][lo:hi], points[2][lo:hi]
            project(X, Y, Z, identity, origin, texels, width, p)
            for i in range(hi - lo):
                t00, t10, t01, t11 = p.t00[i], p.t10[i], p.t01[i], p.t11[i]
                loaded = weights[lo + i] * is_valid(t00, t10, t01, t11)
                if loaded <= F0:
                    continue
                x = p.x[i]
                y = p.y[i]
                z = p.z[i]
                e0, u0, v0 = blend_with_gradient(t00, t10, t01, t11, p.fu[i], p.fv[i], 0)
                e1, u1, v1 = blend_with_gradient(t00, t10, t01, t11, p.fu[i], p.fv[i], 8)
                e2, u2, v2 = blend_with_gradient(t00, t10, t01, t11, p.fu[i], p.fv[i], 16)
                e0 -= channels[0][lo + i]
                e1 -= channels[1][lo + i]
                e2 -= channels[2][lo + i]
                cost, w = inline_geman_mcclure(e0 * e0 + e1 * e1 + e2 * e2, inverse_scale2)
                loss[k] += loaded * cost
                weight[k] += loaded
                w *= loaded
                guu = w * (u0 * u0 + u1 * u1 + u2 * u2)
                guv = w * (u0 * v0 + u1 * v1 + u2 * v2)
                gvv = w * (v0 * v0 + v1 * v1 + v2 * v2)
                bu = w * (u0 * e0 + u1 * e1 + u2 * e2)
                bv = w * (v0 * e0 + v1 * e1 + v2 * e2)
                ux, uy, vx, vy, vz = pixel_jacobian(x, y, z, x * x + y * y, np.float32(width))
                of_u[0] = -z * uy
                of_u[1] = z * ux
                of_u[2] = x * uy - y * ux
                of_u[3] = -ux
                of_u[4] = -uy
                of_u[5] = F0
                of_v[0] = y * vz - z * vy
                of_v[1] = z * vx - x * vz
                of_v[2] = x * vy - y * vx
                of_v[3] = -vx
                of_v[4] = -vy
                of_v[5] = -vz
                for j in range(len(moves)):
                    mx = moves[j, 0, lo + i]
                    my = moves[j, 1, lo + i]
                    mz = moves[j, 2, lo + i]
                    of_u[NUM_OF_POSE + j] = ux * mx + uy * my
                    of_v[NUM_OF_POSE + j] = vx * mx + vy * my + vz * mz
                for a in range(n):
                    g[a] += of_u[a] * bu + of_v[a] * bv
                    along_u = guu * of_u[a] + guv * of_v[a]
                    along_v = guv * of_u[a] + gvv * of_v[a]
                    for b in range(a, n):
                        A[a, b] += along_u * of_u[b] + along_v * of_v[b]


def sum_free_equations(problem: ChannelProblem, moves: Array32, begins: Int64s) -> FreeSums:
    """Return the sums over each part of points in the camera's axes, with `moves` (p, 3, N) by corrections.

    Part k is the points from begins[k] to begins[k + 1].
    """
    parts = len(begins) - 1
    n = NUM_OF_POSE + len(moves)
    sums = FreeSums(np.empty(parts), np.empty(parts), np.empty((parts, n)), np.empty((parts, n, n)))
    write_free_equations(problem, moves, begins, *sums)
    upper = np.triu(sums.matrices)
    matrices = upper + np.triu(sums.matrices, 1).transpose(0, 2, 1)
    return sums._replace(matrices=matrices)
