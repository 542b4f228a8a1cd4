"""What cloud and panorama are compared in: opponent colours, locally normalised, as 8-bit levels."""

import math

import numpy as np

from ..runtime.jit import F0, F1, HALF, inline_kernel

CLIP = 2.0  # deviations; what differs more from its surroundings counts no more
MIN_DEVIATION = 0.03  # of a channel in [0, 1]: flatter surroundings are not amplified further
ZERO_LEVEL = 127.5  # the level of 0
LEVELS_PER_UNIT = 127.5 / CLIP
OPPONENT = np.array([[1 / 3, 1 / 3, 1 / 3], [1 / 2, 0, -1 / 2], [-1 / 4, 1 / 2, -1 / 4]], np.float32)

_CLIP = np.float32(CLIP)
_MIN_VARIANCE = np.float32(MIN_DEVIATION * MIN_DEVIATION)


@inline_kernel
def opponent(r, g, b):
    """Luminance, (R - B) / 2 and (2 G - R - B) / 4: OPPONENT times the colour."""
    return (r + g + b) / np.float32(3.0), HALF * (r - b), HALF * g - np.float32(0.25) * (r + b)


@inline_kernel
def zscore(value, mean, inverse_std):
    """(value - mean) / standard deviation, clipped."""
    return min(max((value - mean) * inverse_std, -_CLIP), _CLIP)


@inline_kernel
def inverse_std(mean, mean_square):
    """1 / standard deviation, bounded where nothing varies."""
    return F1 / math.sqrt(max(mean_square - mean * mean, F0) + _MIN_VARIANCE)
