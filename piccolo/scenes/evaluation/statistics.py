"""Statistics over rows: errors, shares, and what a confidence is worth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...confidence.confidence import LOCALIZED
from ...geometry.pose_error import MAX_ANGLE, MAX_DISTANCE
from .row import Row

HUGE = 1e30  # stands for an error without a pose while quartiles are interpolated
THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m] at which accuracy is told


@dataclass(frozen=True)
class Limits:
    """From where on a pose is wrong."""

    max_distance: float = MAX_DISTANCE  # [m]
    max_angle: float = MAX_ANGLE  # [rad]


PAPER_LIMITS = Limits()


@dataclass(frozen=True)
class Summary:
    """What a table tells of some rows."""

    num_queries: int
    num_correct: int
    num_localized: int
    num_wrong: int  # of the localized
    position_quartiles: NDArray[np.float64]  # (3,) [m] over all queries, inf where there is no pose
    rotation_quartiles: NDArray[np.float64]  # (3,) [rad]
    seconds: float  # median

    @property
    def accuracy(self) -> float:
        """Share of correct poses, whatever their verdict."""
        return self.num_correct / self.num_queries


def quartiles(values: Sequence[float]) -> NDArray[np.float64]:
    """The 25th, 50th and 75th percentiles (3,) of values of which some may be infinite."""
    found = np.quantile(np.minimum(values, HUGE), [0.25, 0.5, 0.75])
    return np.where(found > 1e-6 * HUGE, np.inf, found)


def summarize(rows: Sequence[Row], limits: Limits = PAPER_LIMITS) -> Summary:
    """The statistics of at least one row."""
    is_correct = [row.is_correct(limits.max_distance, limits.max_angle) for row in rows]
    is_localized = [row.result.status == LOCALIZED for row in rows]
    return Summary(
        num_queries=len(rows),
        num_correct=sum(is_correct),
        num_localized=sum(is_localized),
        num_wrong=sum(a and not b for a, b in zip(is_localized, is_correct, strict=True)),
        position_quartiles=quartiles([row.position_error for row in rows]),
        rotation_quartiles=quartiles([row.rotation_error for row in rows]),
        seconds=float(np.median([row.seconds for row in rows])),
    )


def accuracies(rows: Sequence[Row], max_angle: float) -> list[float]:
    """The share of rows below each of THRESHOLDS [m] and below an angle [rad]."""
    return [sum(row.is_correct(line, max_angle) for row in rows) / len(rows) for line in THRESHOLDS]


@dataclass(frozen=True)
class Point:
    """One point of the curve of risk over coverage."""

    confidence: float  # results from here on are accepted
    coverage: float  # share that is accepted
    risk: float  # share of these that is wrong
    num_wrong: int


def risk_and_coverage(rows: Sequence[Row], limits: Limits = PAPER_LIMITS) -> list[Point]:
    """What is accepted and what is wrong of it, as the line moves down from one confidence to the next."""
    points: list[Point] = []
    by_confidence = sorted(rows, key=lambda row: -row.result.confidence)
    num_wrong = 0
    for k, row in enumerate(by_confidence, 1):
        num_wrong += not row.is_correct(limits.max_distance, limits.max_angle)
        is_last = k == len(rows) or by_confidence[k].result.confidence < row.result.confidence
        if is_last:
            points.append(Point(row.result.confidence, k / len(rows), num_wrong / k, num_wrong))
    return points
