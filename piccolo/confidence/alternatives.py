"""Poses that may be right, and which of them are different answers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ..geometry.pose import Pose, are_same

RIVAL_DISTANCE, RIVAL_ANGLE = 0.5, math.radians(15.0)  # [m], [rad] poses nearer than both are no rivals
MAX_RIVALS = 5  # reported


@dataclass(frozen=True)
class Hypothesis:
    """A pose, and how well it explains the panorama."""

    pose: Pose
    score: float


def distinct_best(
    hypotheses: Sequence[Hypothesis], count: int, min_distance: float, min_angle: float
) -> list[Hypothesis]:
    """At most `count` by falling score, none within distance [m] and angle [rad] of a better one."""
    kept: list[Hypothesis] = []
    for h in sorted(hypotheses, key=lambda h: -h.score):
        if len(kept) < count and not any(are_same(h.pose, k.pose, min_distance, min_angle) for k in kept):
            kept.append(h)
    return kept


def rivals_of(
    best: Pose, hypotheses: Sequence[Hypothesis], more: Sequence[Hypothesis] = (), count: int = MAX_RIVALS
) -> list[Hypothesis]:
    """The `count` best hypotheses of which only one can be right, and none of them if `best` is.

    Of `more`, which are less refined, those take part that are near none of the others.
    """
    found: list[Hypothesis] = []
    for some in (hypotheses, more):
        known = [best, *(h.pose for h in found)]
        apart = [h for h in some if not any(are_same(h.pose, k, RIVAL_DISTANCE, RIVAL_ANGLE) for k in known)]
        found += distinct_best(apart, count - len(found), RIVAL_DISTANCE, RIVAL_ANGLE)
    return sorted(found, key=lambda h: -h.score)


def lead(score: float, rivals: Sequence[Hypothesis]) -> float:
    """Margin of a score over the best rival's, or over 0 if none has more."""
    return score - max([0.0, *(h.score for h in rivals)])
