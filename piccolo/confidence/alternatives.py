"""Hypotheses, and the choice of those that are different answers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.nearness import ONE_ANSWER, Nearness, non_maximum_suppression
from ..geometry.pose import Pose

MAX_ALTERNATIVES = 5  # reported


@dataclass(frozen=True)
class Hypothesis:
    """A pose that may be right."""

    pose: Pose
    score: float  # more is better; in the end the part of the panorama that it explains, as in `Evidence`


def sort_by_score(poses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Sort hypotheses by falling score; those of equal score keep their order."""
    return sorted(poses, key=lambda p: -p.score)


def suppress_near(ranked: Sequence[Hypothesis], count: int, near: Nearness) -> list[Hypothesis]:
    """Return the first `count` poses that are not near an earlier one."""
    if not ranked:
        return []
    rotations = np.array([p.pose.R_cam_from_world for p in ranked])
    centers = np.array([p.pose.center_world for p in ranked])
    return [ranked[k] for k in non_maximum_suppression(rotations, centers, count, near)]


def best_distinct(poses: Sequence[Hypothesis], count: int, near: Nearness) -> list[Hypothesis]:
    """Return at most `count` poses, best first, none near a better one."""
    return suppress_near(sort_by_score(poses), count, near)


def alternative_poses(
    best: Pose, hypotheses: Sequence[Hypothesis], count: int = MAX_ALTERNATIVES
) -> list[Hypothesis]:
    """Return the `count` best-scoring hypotheses that are distinct from `best` and from each other."""
    ranked = [Hypothesis(best, math.inf), *sort_by_score(hypotheses)]
    return suppress_near(ranked, count + 1, ONE_ANSWER)[1:]
