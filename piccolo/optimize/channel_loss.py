"""The loss of the default method: locally normalised channels of points against those of the panorama.

The loss of a residual is Geman and McClure's, with a scale [8-bit levels]. A point on masked pixels costs
half of the largest loss.
"""

import math
from typing import NamedTuple

import numpy as np

from ..geometry.levenberg_marquardt import COUNT_SUM, LOSS, levenberg_marquardt
from ..geometry.robust import inline_geman_mcclure
from ..geometry.sphere import CHANCE_CORRELATION, NUM_BLOCKS
from ..photo.panorama.local_normalization import ZERO_LEVEL
from ..photo.panorama.texels import TEXEL_CHUNK, make_chunk, project, sample
from ..system.arrays import Array, Array32, Int32s, Int64s
from ..system.kernels.jit import Scalar, inline_kernel, kernel
from .normal_equations import block_adder

NUM_MOMENTS = 10
FLAT_BLOCK = 6.0  # [levels] a smaller standard deviation of a block's channels counts as this
ZERO = np.float32(ZERO_LEVEL)


class ChannelProblem(NamedTuple):
    """Points with channels, the image with which they are compared, and the scale of the loss."""

    points: Array32  # (3, N) [m] in the frame of the pose
    channels: Array32  # (3, N) [8-bit levels]
    weights: Array32  # (N,)
    texels: Int32s  # of the panorama's channels
    width: int  # [px] of the panorama
    scale: float  # of the loss [levels]


@inline_kernel
def read_channels(
    colors: tuple[Array32, Array32, Array32, Array32], i: np.uintp
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return channels [levels] and weight of a point, read from four arrays."""
    return colors[0][i], colors[1][i], colors[2][i], colors[3][i]


@inline_kernel
def beyond_chance(correlation: float) -> float:
    """Return by how much a block's correlation exceeds that of wrong poses, scaled to [0, 1]."""
    return max(correlation - CHANCE_CORRELATION, 0.0) / (1.0 - CHANCE_CORRELATION)


add_channels = block_adder(read_channels, inline_geman_mcclure)


@kernel
def channel_equations(
    problem: ChannelProblem, R_cam_from_world: Array, center_world: Array, sums: Array
) -> None:
    """Write loss, sum of weights, gradient and matrix (29,) of a problem at a pose."""
    points, channels, weights, texels, width, scale = problem
    R, t = R_cam_from_world, center_world
    colors = (channels[0], channels[1], channels[2], weights)
    sums[:] = 0.0
    xyz = (points[0], points[1], points[2])
    add_channels(xyz, colors, texels, width, R, t, np.float32(1.0 / (scale * scale)), sums)
    total_weight = 0.0
    for n in range(len(weights)):
        total_weight += weights[n]
    sums[LOSS] += (total_weight - sums[COUNT_SUM]) * 0.25 * scale * scale


@kernel
def equations_by_part(
    problem: ChannelProblem, R_cam_from_world: Array, center_world: Array, begins: Int64s, sums: Array
) -> None:
    """Write the sums (parts, 29) of `channel_equations` for each part of a problem's points.

    Part k is the points from begins[k] to begins[k + 1]. Points on masked pixels add nothing to the loss.
    """
    points, channels, weights, texels, width, scale = problem
    R, t = R_cam_from_world, center_world
    inverse_scale2 = np.float32(1.0 / (scale * scale))
    sums[:] = 0.0
    for k in range(len(sums)):
        part = slice(begins[k], begins[k + 1])
        colors = (channels[0][part], channels[1][part], channels[2][part], weights[part])
        xyz = (points[0][part], points[1][part], points[2][part])
        add_channels(xyz, colors, texels, width, R, t, inverse_scale2, sums[k])


descend_channels = kernel(levenberg_marquardt(channel_equations))


@kernel
def correlate(
    points: Array32,
    channels: Array32,
    weights: Array32,
    blocks: Int32s,
    texels: Int32s,
    width: int,
    R_cam_from_world: Array,
    center_world: Array,
    sums: Array,
) -> None:
    """Write the weighted sums (B, 10) over each block of the points' channels a and the image's channels b.

    The ten are a b, a^2 and b^2, each added over the three channels; the weight; a and then b by channel.
    """
    sums[:] = 0.0
    p = make_chunk()
    found = np.empty((NUM_MOMENTS, TEXEL_CHUNK), np.float32)
    for lo in range(0, len(weights), TEXEL_CHUNK):
        hi = min(lo + TEXEL_CHUNK, len(weights))
        part = slice(lo, hi)
        x = points[0][part]
        y = points[1][part]
        z = points[2][part]
        project(x, y, z, R_cam_from_world, center_world, texels, width, p)
        f0 = channels[0][part]
        f1 = channels[1][part]
        f2 = channels[2][part]
        weight = weights[part]
        for n in range(hi - lo):
            b0, b1, b2, shown = sample(p, n)
            a0 = f0[n] - ZERO
            a1 = f1[n] - ZERO
            a2 = f2[n] - ZERO
            b0 -= ZERO
            b1 -= ZERO
            b2 -= ZERO
            w = weight[n] * shown
            found[0, n] = w * (a0 * b0 + a1 * b1 + a2 * b2)
            found[1, n] = w * (a0 * a0 + a1 * a1 + a2 * a2)
            found[2, n] = w * (b0 * b0 + b1 * b1 + b2 * b2)
            found[3, n] = w
            found[4, n] = w * a0
            found[5, n] = w * a1
            found[6, n] = w * a2
            found[7, n] = w * b0
            found[8, n] = w * b1
            found[9, n] = w * b2
        for n in range(hi - lo):
            s = sums[blocks[lo + n]]
            for k in range(NUM_MOMENTS):
                s[k] += found[k, n]


@kernel
def score(
    points: Array32,
    channels: Array32,
    weights: Array32,
    blocks: Int32s,
    texels: Int32s,
    width: int,
    R_cam_from_world: Array,
    center_world: Array,
) -> float:
    """Return the score of a pose: the sum over blocks of correlation beyond chance times the area in common.

    That area is where both points and image show something. `weights` (N,) are solid angles as fractions of
    the sphere, `blocks` (N,) the block of each point. An occluder costs the area that it hides and no more.
    """
    sums = np.empty((NUM_BLOCKS, NUM_MOMENTS))
    correlate(points, channels, weights, blocks, texels, width, R_cam_from_world, center_world, sums)
    total = 0.0
    for b in range(NUM_BLOCKS):
        s = sums[b]
        if s[3] <= 0.0:
            continue
        product = s[0]
        energy = s[1]
        other = s[2]
        for k in range(4, 7):
            product -= s[k] * s[k + 3] / s[3]
            energy -= s[k] * s[k] / s[3]
            other -= s[k + 3] * s[k + 3] / s[3]
        least = FLAT_BLOCK * FLAT_BLOCK * s[3]
        correlation = product / math.sqrt(max(energy, least) * max(other, least))
        total += beyond_chance(correlation) * s[3]
    return total
