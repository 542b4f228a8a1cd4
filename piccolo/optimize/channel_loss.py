"""The loss of the default method: locally normalised channels of points against those of the panorama.

A residual's loss is that of Geman and McClure (1985), 1/2 e^2 / (1 + e^2 / s^2): what differs by much more
than the scale s [8-bit levels] pulls no more. A point on masked pixels costs half of the most it could.
"""

import math

import numpy as np

from ..geometry.sphere import make_grid
from ..panorama.local_normalization import ZERO_LEVEL
from ..panorama.texels import blend, is_valid, texels_around
from ..runtime.jit import F1, HALF, inline_kernel, kernel
from .levenberg_marquardt import levenberg_marquardt
from .normal_equations import COUNT, LOSS, block_adder

BLOCK_RINGS = 6  # blocks of the sphere of 30 degrees, in which a score is taken
NUM_BLOCKS = len(make_grid(BLOCK_RINGS))
CHANCE = 0.35  # a block's correlation that wrong poses reach
BLOCK = 512  # points: float32 sums within, float64 over blocks


@inline_kernel
def read_channels(colors, i):
    """Channels [levels] and weight of a point, of four arrays."""
    return colors[0][i], colors[1][i], colors[2][i], colors[3][i]


@inline_kernel
def geman_mcclure(square, inverse_scale2):
    """Loss of a residual of this squared length, and its weight."""
    s = F1 / (F1 + square * inverse_scale2)
    return HALF * square * s, s * s


@inline_kernel
def beyond_chance(correlation):
    """What a block's correlation has beyond what those of wrong poses reach, in [0, 1]."""
    return max(correlation - CHANCE, 0.0) / (1.0 - CHANCE)


add_channels = block_adder(read_channels, geman_mcclure)


@kernel
def channel_equations(problem, R_cam_from_world, center_world, sums):
    """Write loss, count, gradient and matrix (29,) of a problem at a pose.

    A problem is: points (3, N) [m], channels (3, N) [levels], weights (N,), texels and width of the
    panorama's channels, scale of the loss [levels].
    """
    points, channels, weights, texels, width, scale = problem
    R, t = R_cam_from_world, center_world
    sums[:] = 0.0
    inverse_scale2 = np.float32(1.0 / (scale * scale))
    total_weight = 0.0
    for lo in range(0, len(weights), BLOCK):
        hi = min(lo + BLOCK, len(weights))
        x, y, z, w = points[0][lo:hi], points[1][lo:hi], points[2][lo:hi], weights[lo:hi]
        colors = channels[0][lo:hi], channels[1][lo:hi], channels[2][lo:hi], w
        add_channels(x, y, z, colors, texels, width, R, t, inverse_scale2, sums)
        for i in range(len(w)):
            total_weight += w[i]
    sums[LOSS] += (total_weight - sums[COUNT]) * 0.25 * scale * scale


@kernel
def equations_by_part(problem, R_cam_from_world, center_world, begins, sums):
    """Write gradient and matrix, as `channel_equations` does (parts, 29), of each part of a problem's points.

    A part ends where the next begins (parts + 1,).
    """
    points, channels, weights, texels, width, scale = problem
    sums[:] = 0.0
    inverse_scale2 = np.float32(1.0 / (scale * scale))
    for k in range(len(sums)):
        for lo in range(begins[k], begins[k + 1], BLOCK):
            hi = min(lo + BLOCK, begins[k + 1])
            x, y, z, w = points[0][lo:hi], points[1][lo:hi], points[2][lo:hi], weights[lo:hi]
            colors = channels[0][lo:hi], channels[1][lo:hi], channels[2][lo:hi], w
            how = texels, width, R_cam_from_world, center_world, inverse_scale2
            add_channels(x, y, z, colors, *how, sums[k])


descend_channels = kernel(levenberg_marquardt(channel_equations))


@kernel
def correlate(points, channels, weights, blocks, texels, width, R_cam_from_world, center_world, sums):
    """Write, block by block (B, 4), product, energies and shared weight of points' and image's channels."""
    R, t = R_cam_from_world, center_world
    sums[:] = 0.0
    for n in range(len(weights)):
        dx, dy, dz = points[0, n] - t[0], points[1, n] - t[1], points[2, n] - t[2]
        x = np.float32(R[0, 0] * dx + R[0, 1] * dy + R[0, 2] * dz)
        y = np.float32(R[1, 0] * dx + R[1, 1] * dy + R[1, 2] * dz)
        z = np.float32(R[2, 0] * dx + R[2, 1] * dy + R[2, 2] * dz)
        (t00, t10, t01, t11), bilinear = texels_around(texels, x, y, z, width)
        w = weights[n] * is_valid(t00, t10, t01, t11)
        s = sums[blocks[n]]
        s[3] += w
        for c in range(3):
            value = blend(t00, t10, t01, t11, bilinear, 8 * c) - np.float32(ZERO_LEVEL)
            feature = channels[c, n] - np.float32(ZERO_LEVEL)
            s[0] += w * value * feature
            s[1] += w * feature * feature
            s[2] += w * value * value


@kernel
def score(points, channels, weights, blocks, texels, width, R_cam_from_world, center_world):
    """The score of a pose: what blocks of the sphere correlate beyond chance, times what both show of them.

    The weights are solid angles as fractions of the sphere, `blocks` (N,) the block of each point. An
    occluder costs what it hides and no more.
    """
    sums = np.empty((NUM_BLOCKS, 4))
    correlate(points, channels, weights, blocks, texels, width, R_cam_from_world, center_world, sums)
    total = 0.0
    for b in range(NUM_BLOCKS):
        product, points_energy, image_energy, shared = sums[b, 0], sums[b, 1], sums[b, 2], sums[b, 3]
        total += beyond_chance(product / math.sqrt(max(points_energy * image_energy, 1e-12))) * shared
    return total
