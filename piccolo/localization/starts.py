"""Poses on their way down: in arrays, and which of them go on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE, Hypothesis, by_score
from ..geometry.pose import Pose
from ..geometry.suppression import non_maximum_suppression

START_DISTANCE, START_ANGLE = 0.5, math.radians(20.0)  # [m], [rad] starts nearer than both are one
SAME_DISTANCE, SAME_ANGLE = 0.15, math.radians(5.0)  # so are poses on their way down
CLOSE_DISTANCE = 0.1  # [m] the same after the descent on middle cells


@dataclass(frozen=True)
class Starts:
    """Poses in arrays, best first, and the candidate on whose view each descends."""

    R_cam_from_map: NDArray[np.float64]  # (n, 3, 3)
    center_map: NDArray[np.float64]  # (n, 3) [m]
    candidate: NDArray[np.int64]  # (n,)
    score: NDArray[np.float64]  # (n,)

    def take(self, indices: NDArray[np.int64]) -> "Starts":
        """The starts at `indices`, in that order."""
        return Starts(*(values[indices] for values in vars(self).values()))

    def hypotheses(self) -> list[Hypothesis]:
        """One object each."""
        poses = zip(self.R_cam_from_map, self.center_map, self.score, strict=True)
        return [Hypothesis(Pose(R, center), float(score)) for R, center, score in poses]


def best_and_alternatives(
    rotations: NDArray[np.float64], centers: NDArray[np.float64], count: int, min_distance: float
) -> NDArray[np.int64]:
    """Indices of `count` of the poses (n, 3, 3), (n, 3), best first, which are in order again.

    The best that differ a little and, in a quarter of the places, the best that lie far apart.
    """
    near = non_maximum_suppression(rotations, centers, count - count // 4, min_distance, SAME_ANGLE)
    apart = non_maximum_suppression(rotations, centers, count, MIN_DISTANCE, MIN_ANGLE)
    others = apart[~np.isin(apart, near)][: count - len(near)]
    return np.sort(np.concatenate([near, others]))


def narrow(hypotheses: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
    """The same of hypotheses."""
    ranked = by_score(hypotheses)
    rotations = np.array([h.pose.R_cam_from_world for h in ranked])
    centers = np.array([h.pose.center_world for h in ranked])
    return [ranked[k] for k in best_and_alternatives(rotations, centers, count, CLOSE_DISTANCE)]
