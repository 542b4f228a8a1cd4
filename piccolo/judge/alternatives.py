"""Hypotheses, and the choice of those that are different answers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from ..geometry.nearness import ONE_ANSWER, Nearness, non_maximum_suppression
from ..geometry.pose import Pose

MAX_ALTERNATIVES = 5  # that a result reports


@dataclass(frozen=True)
class Hypothesis:
    """A pose that may be right."""

    pose: Pose
    score: float  # more is better
    is_climbed: bool = False  # no perturbation improves it


class Scored(Protocol):
    """A pose with a score, of which more is better."""

    @property
    def pose(self) -> Pose:
        """The pose."""

    @property
    def score(self) -> float:
        """The score."""


One = TypeVar("One", bound=Scored)


def sort_by_score(poses: Sequence[One]) -> list[One]:
    """Sort poses by falling score; those of equal score keep their order."""
    return sorted(poses, key=lambda p: -p.score)


def suppress_near(ranked: Sequence[One], count: int, near: Nearness) -> list[One]:
    """Return the first `count` poses that are not near an earlier one."""
    if not ranked:
        return []
    rotations = np.array([p.pose.R_cam_from_world for p in ranked])
    centers = np.array([p.pose.center_world for p in ranked])
    return [ranked[k] for k in non_maximum_suppression(rotations, centers, count, near)]


def best_distinct(poses: Sequence[One], count: int, near: Nearness) -> list[One]:
    """Return at most `count` poses, best first, none near a better one."""
    return suppress_near(sort_by_score(poses), count, near)


def alternative_poses(best: One, poses: Sequence[One], count: int = MAX_ALTERNATIVES) -> list[One]:
    """Return the `count` best-scoring poses that are distinct from `best` and from each other."""
    return suppress_near([best, *sort_by_score(poses)], count + 1, ONE_ANSWER)[1:]
