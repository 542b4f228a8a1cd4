"""Two fisheye pictures side by side, as cameras store them before stitching: 2:1, but no panorama."""

import cv2
import numpy as np
from numpy.typing import NDArray

# Set by hand, between the circles and the panoramas of tests/test_panorama_masks.py.
SIZE = 128  # [px] of each half, for the test
BLACK = 24  # levels: the dark around the circles carries some noise
MIN_BLACK_OUTSIDE = 0.98
MIN_BRIGHT_INSIDE = 0.7  # of each sector of a ring within the circle
NUM_SECTORS = 8


def is_dual_fisheye(rgb: NDArray[np.uint8]) -> bool:
    """True if all is black outside of the two circles inscribed in the halves, but not within them.

    A panorama with black poles is black within the circles' upper and lower parts too; a dark one is dark all
    around. Circles down to 0.9 of the halves' height are found.
    """
    small = cv2.resize(rgb, (2 * SIZE, SIZE), interpolation=cv2.INTER_AREA).max(axis=2)
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    radius = np.hypot(u, v) / (SIZE / 2)
    sector = np.floor(np.arctan2(v, u) / (2.0 * np.pi) * NUM_SECTORS).astype(int) % NUM_SECTORS
    is_ring = (radius > 0.7) & (radius < 0.85)
    for half in (small[:, :SIZE], small[:, SIZE:]):
        if (half[radius > 1.03] < BLACK).mean() < MIN_BLACK_OUTSIDE:
            return False
        is_bright = half >= BLACK
        if min(is_bright[is_ring & (sector == k)].mean() for k in range(NUM_SECTORS)) < MIN_BRIGHT_INSIDE:
            return False
    return True
