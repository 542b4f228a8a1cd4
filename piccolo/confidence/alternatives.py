"""Poses that may be right, and which of them are different answers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from ..geometry.pose import Pose
from ..geometry.suppression import non_maximum_suppression

MIN_DISTANCE, MIN_ANGLE = 0.5, math.radians(15.0)  # [m], [rad] poses nearer than both are one answer
MAX_ALTERNATIVES = 5  # reported


class Scored(Protocol):
    """A pose with a score: more is better."""

    @property
    def pose(self) -> Pose:
        """The pose."""

    @property
    def score(self) -> float:
        """Its score, of what is compared with what."""


ScoredPose = TypeVar("ScoredPose", bound=Scored)


@dataclass(frozen=True)
class Hypothesis:
    """A pose that may be right."""

    pose: Pose
    score: float  # what of the panorama it explains, as of `score.Evidence`


def by_score(poses: Sequence[ScoredPose]) -> list[ScoredPose]:
    """The best first; of equal ones, the first."""
    return sorted(poses, key=lambda p: -p.score)


def suppressed(
    ranked: Sequence[ScoredPose], count: int, min_distance: float, min_angle: float
) -> list[ScoredPose]:
    """The first `count` poses that are near (distance [m] and angle [rad]) none before."""
    if not ranked:
        return []
    rotations = np.array([h.pose.R_cam_from_world for h in ranked])
    centers = np.array([h.pose.center_world for h in ranked])
    return [ranked[k] for k in non_maximum_suppression(rotations, centers, count, min_distance, min_angle)]


def best_distinct(
    poses: Sequence[ScoredPose], count: int, min_distance: float, min_angle: float
) -> list[ScoredPose]:
    """At most `count` by falling score, none within distance [m] and angle [rad] of a better one."""
    return suppressed(by_score(poses), count, min_distance, min_angle)


def alternative_poses(
    best: Pose,
    hypotheses: Sequence[Hypothesis],
    less_refined: Sequence[Hypothesis] = (),
    count: int = MAX_ALTERNATIVES,
) -> list[Hypothesis]:
    """The `count` best-scoring hypotheses that are distinct from `best` and from each other.

    Of the less refined ones, those take part that are near none of the others.
    """
    ranked = [Hypothesis(best, math.inf), *by_score(hypotheses), *by_score(less_refined)]
    return by_score(suppressed(ranked, count + 1, MIN_DISTANCE, MIN_ANGLE)[1:])


def score_margin(score: float, alternatives: Sequence[Hypothesis]) -> float:
    """Lead of a score over the best alternative's, or over 0 if none has more."""
    return score - max([0.0, *(h.score for h in alternatives)])
