"""Poses on their way down: in arrays, and which of them go on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import RIVAL_ANGLE, RIVAL_DISTANCE, Hypothesis, distinct_best
from ..geometry.pose import Pose

START_DISTANCE, START_ANGLE_DEG = 0.5, 20.0  # starts nearer than this are one
SAME_DISTANCE, SAME_ANGLE_DEG = 0.15, 5.0  # so are poses on their way down
SHAKE_DISTANCE, SHAKE_ANGLE = 0.25, math.radians(8.0)  # [m], [rad] from a pose, to find it again from


@dataclass(frozen=True)
class Starts:
    """Poses in arrays, best first, and the candidate on whose view each descends."""

    R_cam_from_map: NDArray[np.float64]  # (n, 3, 3)
    center_map: NDArray[np.float64]  # (n, 3) [m]
    candidate: NDArray[np.int64]  # (n,)
    score: NDArray[np.float64]  # (n,)

    def hypotheses(self) -> list[Hypothesis]:
        """One object each."""
        poses = zip(self.R_cam_from_map, self.center_map, self.score, strict=True)
        return [Hypothesis(Pose(R, center), float(score)) for R, center, score in poses]


def best_and_rivals(hypotheses: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
    """The best that differ a little and, in a quarter of the places, the best that lie far apart."""
    kept = distinct_best(hypotheses, count - count // 4, 0.1, math.radians(SAME_ANGLE_DEG))
    for rival in distinct_best(hypotheses, count, RIVAL_DISTANCE, RIVAL_ANGLE):
        if len(kept) < count and not any(rival is k for k in kept):
            kept.append(rival)
    return kept


def shakes(share: float) -> NDArray[np.float64]:
    """Steps (9, 6), rotation [rad] and translation [m]: none, then to the corners of a cube."""
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3.0)
    steps = np.concatenate([signs[:, ::-1] * SHAKE_ANGLE, signs * SHAKE_DISTANCE], axis=1) * share
    return np.concatenate([np.zeros((1, 6)), steps])
