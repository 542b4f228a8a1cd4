"""The normal equations of a pose together with corrections of the picture's geometry (self-calibration).

A correction displaces a point, in the camera's axes, by a vector m for each unit of the correction (`moves`).
Its column of the Jacobian is the image gradient g along that vector, m . g. The columns of the corrections
follow those of the pose, [p x g, -g] in `normal_equations`.
"""

from typing import NamedTuple

import numpy as np

from ..geometry.robust import inline_geman_mcclure
from ..geometry.sphere import pixel_jacobian
from ..photo.panorama.texels import TEXEL_CHUNK, Projected, blend_with_gradient, is_valid, make_chunk, project
from ..system.arrays import Array, Array32, Int64s
from ..system.kernels.jit import F0, Scalar, inline_kernel, kernel
from .channel_loss import ChannelProblem

NUM_OF_POSE = 6  # numbers of a pose's step


class FreeSums(NamedTuple):
    """Sums of the equations over parts of the points; the n unknowns are 6 of the pose, then corrections."""

    loss: Array  # (parts,)
    weight: Array  # (parts,) sum of the weights of the points on valid pixels
    gradients: Array  # (parts, n)
    matrices: Array  # (parts, n, n)


class Rows(NamedTuple):
    """Of a chunk of points, what the equations are made of; arrays (..., TEXEL_CHUNK)."""

    of_u: Array32  # (n, TEXEL_CHUNK) derivatives of the pixel by the unknowns
    of_v: Array32
    along_u: Array32  # (TEXEL_CHUNK,) one unknown's derivatives, weighted by the image gradients
    along_v: Array32
    guu: Array32  # weighted sums over channels of the products of the image gradients
    guv: Array32
    gvv: Array32
    bu: Array32  # and of the gradients with the errors
    bv: Array32


@inline_kernel
def make_rows(n: int) -> Rows:
    """Make the arrays of a chunk for n unknowns, not filled."""
    f = np.empty((7, TEXEL_CHUNK), np.float32)
    of_u = np.empty((n, TEXEL_CHUNK), np.float32)
    of_v = np.empty((n, TEXEL_CHUNK), np.float32)
    return Rows(of_u, of_v, f[0], f[1], f[2], f[3], f[4], f[5], f[6])


@inline_kernel
def write_errors(
    points: Projected, channels: Array32, weights: Array32, inverse_scale2: Scalar, rows: Rows
) -> tuple[Scalar, Scalar]:
    """Write the products of gradients and errors of points with channels (3, N) and weights (N,).

    Return the sums of their losses and of their weights.
    """
    p = points
    total = F0
    loaded = F0
    for i in range(len(weights)):
        t00 = p.t00[i]
        t10 = p.t10[i]
        t01 = p.t01[i]
        t11 = p.t11[i]
        weight = weights[i] * is_valid(t00, t10, t01, t11)
        e0, u0, v0 = blend_with_gradient(t00, t10, t01, t11, p.fu[i], p.fv[i], 0)
        e1, u1, v1 = blend_with_gradient(t00, t10, t01, t11, p.fu[i], p.fv[i], 8)
        e2, u2, v2 = blend_with_gradient(t00, t10, t01, t11, p.fu[i], p.fv[i], 16)
        e0 -= channels[0, i]
        e1 -= channels[1, i]
        e2 -= channels[2, i]
        cost, w = inline_geman_mcclure(e0 * e0 + e1 * e1 + e2 * e2, inverse_scale2)
        total += weight * cost
        loaded += weight
        w *= weight
        rows.guu[i] = w * (u0 * u0 + u1 * u1 + u2 * u2)
        rows.guv[i] = w * (u0 * v0 + u1 * v1 + u2 * v2)
        rows.gvv[i] = w * (v0 * v0 + v1 * v1 + v2 * v2)
        rows.bu[i] = w * (u0 * e0 + u1 * e1 + u2 * e2)
        rows.bv[i] = w * (v0 * e0 + v1 * e1 + v2 * e2)
    return total, loaded


@inline_kernel
def write_derivatives(points: Projected, moves: Array32, width: Scalar, rows: Rows) -> None:
    """Write the derivatives of the pixels of points with moves (p, 3, N), in an image of `width`."""
    p = points
    u = rows.of_u
    v = rows.of_v
    count = moves.shape[2]
    for i in range(count):
        x = p.x[i]
        y = p.y[i]
        z = p.z[i]
        ux, uy, vx, vy, vz = pixel_jacobian(x, y, z, x * x + y * y, width)
        u[0, i] = -z * uy
        u[1, i] = z * ux
        u[2, i] = x * uy - y * ux
        u[3, i] = -ux
        u[4, i] = -uy
        u[5, i] = F0
        v[0, i] = y * vz - z * vy
        v[1, i] = z * vx - x * vz
        v[2, i] = x * vy - y * vx
        v[3, i] = -vx
        v[4, i] = -vy
        v[5, i] = -vz
    for j in range(len(moves)):
        of_u = u[NUM_OF_POSE + j]
        of_v = v[NUM_OF_POSE + j]
        move = moves[j]
        for i in range(count):
            of_u[i] = -u[3, i] * move[0, i] - u[4, i] * move[1, i]
            of_v[i] = -v[3, i] * move[0, i] - v[4, i] * move[1, i] - v[5, i] * move[2, i]


@inline_kernel
def add_rows(rows: Rows, count: int, gradient: Array, matrix: Array) -> None:
    """Add the rows of `count` points to a gradient (n,) and to the upper triangle of a matrix (n, n)."""
    n = len(gradient)
    for a in range(n):
        u = rows.of_u[a]
        v = rows.of_v[a]
        slope = F0
        for i in range(count):
            slope += u[i] * rows.bu[i] + v[i] * rows.bv[i]
            rows.along_u[i] = rows.guu[i] * u[i] + rows.guv[i] * v[i]
            rows.along_v[i] = rows.guv[i] * u[i] + rows.gvv[i] * v[i]
        gradient[a] += slope
        for b in range(a, n):
            other_u = rows.of_u[b]
            other_v = rows.of_v[b]
            product = F0
            for i in range(count):
                product += rows.along_u[i] * other_u[i] + rows.along_v[i] * other_v[i]
            matrix[a, b] += product


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
    on masked pixels add nothing. Sums of a chunk are float32.
    """
    points, channels, weights, texels, width, scale = problem
    inverse_scale2 = np.float32(1.0 / (scale * scale))
    identity = np.eye(3)
    origin = np.zeros(3)
    p = make_chunk()
    rows = make_rows(NUM_OF_POSE + len(moves))
    loss[:] = 0.0
    weight[:] = 0.0
    gradients[:] = 0.0
    matrices[:] = 0.0
    for k in range(len(begins) - 1):
        for lo in range(begins[k], begins[k + 1], TEXEL_CHUNK):
            hi = min(lo + TEXEL_CHUNK, begins[k + 1])
            project(points[0][lo:hi], points[1][lo:hi], points[2][lo:hi], identity, origin, texels, width, p)
            part = slice(lo, hi)
            total, loaded = write_errors(p, channels[:, part], weights[part], inverse_scale2, rows)
            write_derivatives(p, moves[:, :, part], np.float32(width), rows)
            loss[k] += total
            weight[k] += loaded
            add_rows(rows, hi - lo, gradients[k], matrices[k])


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
