"""Hypotheses, and the choice of those that are different answers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.pose import Pose
from ..geometry.suppression import non_maximum_suppression

MIN_DISTANCE = 0.5  # [m] poses nearer than this
MIN_ANGLE = math.radians(15.0)  # and this are one answer
MAX_ALTERNATIVES = 5  # reported


@dataclass(frozen=True)
class Hypothesis:
    """A pose that may be right."""

    pose: Pose
    score: float  # more is better; in the end the part of the panorama that it explains, as in `Evidence`


def sort_by_score(poses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Sort hypotheses by falling score; those of equal score keep their order."""
    return sorted(poses, key=lambda p: -p.score)


def suppress_near(
    ranked: Sequence[Hypothesis], count: int, min_distance: float, min_angle: float
) -> list[Hypothesis]:
    """Return the first `count` poses that are not near an earlier one (distance [m] and angle [rad])."""
    if not ranked:
        return []
    rotations = np.array([p.pose.R_cam_from_world for p in ranked])
    centers = np.array([p.pose.center_world for p in ranked])
    return [ranked[k] for k in non_maximum_suppression(rotations, centers, count, min_distance, min_angle)]


def best_distinct(
    poses: Sequence[Hypothesis], count: int, min_distance: float, min_angle: float
) -> list[Hypothesis]:
    """Return at most `count` poses, best first, none within distance [m] and angle [rad] of a better one."""
    return suppress_near(sort_by_score(poses), count, min_distance, min_angle)


def alternative_poses(
    best: Pose, hypotheses: Sequence[Hypothesis], count: int = MAX_ALTERNATIVES
) -> list[Hypothesis]:
    """Return the `count` best-scoring hypotheses that are distinct from `best` and from each other."""
    ranked = [Hypothesis(best, math.inf), *sort_by_score(hypotheses)]
    return suppress_near(ranked, count + 1, MIN_DISTANCE, MIN_ANGLE)[1:]
