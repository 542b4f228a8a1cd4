"""Procedural colour of a surface point: patterns over two coordinates on the surface, in metres."""

import math

import numpy as np

from ...runtime.jit import inline_kernel


@inline_kernel
def hash_unit(i, j, seed):
    """A number in [0, 1) that looks random, of two integers and a seed."""
    h = (i * 374761393 + j * 668265263 + seed * 2147483647) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    h = ((h ^ (h >> 15)) * 1911520717) & 0x7FFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65536.0


@inline_kernel
def value_noise(s, t, seed):
    """Smooth noise in [0, 1] with cells of size 1."""
    i, j = math.floor(s), math.floor(t)
    x, y = s - i, t - j
    x, y = x * x * (3.0 - 2.0 * x), y * y * (3.0 - 2.0 * y)
    i, j = np.int64(i), np.int64(j)
    top = hash_unit(i, j, seed) * (1.0 - x) + hash_unit(i + 1, j, seed) * x
    bottom = hash_unit(i, j + 1, seed) * (1.0 - x) + hash_unit(i + 1, j + 1, seed) * x
    return top * (1.0 - y) + bottom * y


@inline_kernel
def cloudy(s, t, seed):
    """Noise in [0, 1] of three scales: 1 m, 0.25 m, 0.06 m."""
    coarse, middle = value_noise(s, t, seed), value_noise(4.0 * s, 4.0 * t, seed + 1)
    return 0.55 * coarse + 0.3 * middle + 0.15 * value_noise(16.0 * s, 16.0 * t, seed + 2)


@inline_kernel
def second_color_fraction(pattern, s, t, scale, seed):
    """Fraction in [0, 1] of the second colour at (s, t) [m]; patterns as in room.py."""
    i, j = np.int64(math.floor(s / scale)), np.int64(math.floor(t / scale))
    x, y = s / scale - math.floor(s / scale), t / scale - math.floor(t / scale)
    noise = cloudy(s, t, seed)
    if pattern == 0:  # plain
        return 0.35 * noise
    if pattern == 1:  # planks: rows of boards with joints
        joint = 1.0 if x < 0.04 else 0.0
        board = np.int64(math.floor(t / 1.2 + 0.37 * (i % 3)))
        return max(joint, 0.5 * hash_unit(i, board, seed) + 0.3 * noise)
    if pattern == 2:  # tiles with gaps
        gap = 1.0 if min(x, y) < 0.05 else 0.0
        return max(gap, 0.3 * hash_unit(i, j, seed) + 0.2 * noise)
    if pattern == 3:  # stripes of several widths
        return 0.75 * hash_unit(i, 0, seed) + 0.2 * noise
    if pattern == 4:  # checks
        return 0.8 * ((i + j) & 1) + 0.2 * noise
    return min(1.0, max(0.0, 2.5 * value_noise(2.0 * s / scale, 2.0 * t / scale, seed) - 0.7))  # picture
