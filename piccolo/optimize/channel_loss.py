"""The loss of the default method: locally normalised channels of points against those of the panorama.

A residual's loss is that of Geman and McClure (1985), 1/2 e^2 / (1 + e^2 / s^2): what differs by much more
than the scale s [8-bit levels] pulls no more. A point on masked pixels costs half of the most it could.
"""

import math

import numpy as np

from ..panorama.local_normalization import ZERO_LEVEL
from ..panorama.texels import bilinear_weights, blend, is_valid, texel_at
from ..runtime.jit import F1, HALF, inline_kernel, kernel
from .levenberg_marquardt import levenberg_marquardt
from .normal_equations import COUNT, LOSS, block_adder

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


descend_channels = kernel(levenberg_marquardt(channel_equations))


@kernel
def correlate(points, channels, weights, texels, width, R_cam_from_world, center_world):
    """Correlation of the points' channels with the image's at the pose, and the weight of what both show."""
    R, t = R_cam_from_world, center_world
    stride = np.int32(width + 2)
    product = points_energy = image_energy = shared = 0.0
    for n in range(len(weights)):
        dx, dy, dz = points[0, n] - t[0], points[1, n] - t[1], points[2, n] - t[2]
        x = np.float32(R[0, 0] * dx + R[0, 1] * dy + R[0, 2] * dz)
        y = np.float32(R[1, 0] * dx + R[1, 1] * dy + R[1, 2] * dz)
        z = np.float32(R[2, 0] * dx + R[2, 1] * dy + R[2, 2] * dz)
        k, fu, fv = texel_at(x, y, z, math.sqrt(x * x + y * y), width)
        bilinear = bilinear_weights(fu, fv)
        t00, t10, t01, t11 = texels[k], texels[k + 1], texels[k + stride], texels[k + stride + 1]
        w = weights[n] * is_valid(t00, t10, t01, t11)
        shared += w
        for c in range(3):
            value = blend(t00, t10, t01, t11, bilinear, 8 * c) - np.float32(ZERO_LEVEL)
            feature = channels[c, n] - np.float32(ZERO_LEVEL)
            product += w * value * feature
            points_energy += w * feature * feature
            image_energy += w * value * value
    return product / math.sqrt(max(points_energy * image_energy, 1e-12)), shared


@kernel
def score(points, channels, weights, texels, width, R_cam_from_world, center_world):
    """The score of a pose: correlation over what both show, times the root of the fraction of the sphere.

    The weights are solid angles as fractions of the sphere.
    """
    R, t = R_cam_from_world, center_world
    correlation, shared = correlate(points, channels, weights, texels, width, R, t)
    return correlation * math.sqrt(shared)
