"""Poses that count as one: how near they must be, for each purpose, and non-maximum suppression."""

import math
from typing import NamedTuple

import numpy as np

from ..system.arrays import Array, Int64s
from ..system.kernels.jit import copy_to, kernel
from .pose import MAX_ANGLE, MAX_DISTANCE, Pose, pose_errors
from .vectors import dot, minus, row

ROOM_RANGE = 4.0  # [m] chosen, as in halls: what is seen farther off tells a position less exactly


class Nearness(NamedTuple):
    """Limits of a distance and of an angle; poses within both are near."""

    distance: float  # [m]
    angle: float  # [rad]

    def at(self, distance: float) -> "Nearness":
        """Return these limits where what is seen is at a distance [m]: beyond rooms theirs grows with it."""
        return self._replace(distance=self.distance * max(distance / ROOM_RANGE, 1.0))

    def holds(self, pose: Pose, other: Pose) -> bool:
        """Return True if two poses are near each other."""
        distance, angle = pose_errors(pose, other)
        return distance < self.distance and angle < self.angle


# of a search: rough poses of which one is enough to begin from
VOTED = Nearness(1.0, math.radians(30.0))  # by matches, before they are made exact
MATCHED = Nearness(0.3, math.radians(10.0))  # by matches, exact
STARTING = Nearness(0.5, math.radians(20.0))  # on the grid of candidates
STARTING_NARROW = Nearness(0.5, math.radians(14.0))  # and of a photo of a part of the sphere
DESCENDING = Nearness(0.15, math.radians(5.0))  # on prepared views
DESCENDED = Nearness(0.1, math.radians(5.0))  # on middle cells
# of results
RIGHT = Nearness(MAX_DISTANCE, MAX_ANGLE)  # the paper's line between correct and wrong
CONFIRMED = Nearness(0.3, math.radians(5.0))  # a pose that matches or another result confirm
ONE_ANSWER = Nearness(0.5, math.radians(15.0))  # of a photo: others are alternatives
ONE_IN_BUNDLE = Nearness(0.5, math.radians(6.0))  # of a photo, with the errors of relative poses
ONE_PLACE = Nearness(2.0, math.radians(45.0))  # of a walk: square rooms look alike turned by twice that


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
