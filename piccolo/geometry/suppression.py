"""Non-maximum suppression of poses."""

import math

import numpy as np

from ..arrays import Array, Int64s
from ..kernels.jit import copy_to, kernel
from .nearness import Nearness
from .vectors import dot, minus, row


@kernel
def suppress(rotations: Array, centers: Array, min_distance: float, min_trace: float, kept: Int64s) -> int:
    """Write the indices of the poses, best first, that are near none kept before; return their number."""
    places = np.empty((len(kept), 3))
    count = 0
    for k in range(len(centers)):
        is_new = True
        for m in range(count):
            gap = minus(row(places, m), row(centers, k))
            if dot(gap, gap) < min_distance * min_distance:
                trace = 0.0
                for i in range(9):
                    trace += rotations[k, i // 3, i % 3] * rotations[kept[m], i // 3, i % 3]
                if trace > min_trace:
                    is_new = False
                    break
        if is_new:
            kept[count] = k
            copy_to(places[count], centers[k])
            count += 1
            if count == len(kept):
                break
    return count


def non_maximum_suppression(rotations: Array, centers: Array, count: int, near: Nearness) -> Int64s:
    """Return the indices of at most `count` poses (n, 3, 3), (n, 3), best first, near no better one."""
    kept = np.empty(count, np.int64)
    min_trace = 1.0 + 2.0 * math.cos(near.angle)
    return kept[: suppress(rotations, centers, near.distance, min_trace, kept)]
