"""Statistics over the results of many queries: errors, accuracy, risk over coverage."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...confidence.confidence import LOCALIZED
from .query_result import PAPER_THRESHOLDS, QueryResult, Thresholds

HUGE = 1e30  # stands for an error without a pose while quartiles are interpolated
ACCURACY_DISTANCES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m]


@dataclass(frozen=True)
class Summary:
    """What a table says about some queries."""

    num_queries: int
    num_correct: int
    num_localized: int
    num_wrong: int  # of the localized
    position_quartiles: NDArray[np.float64]  # (3,) [m] over all queries, inf where there is no pose
    rotation_quartiles: NDArray[np.float64]  # (3,) [rad]
    seconds: float  # median

    @property
    def accuracy(self) -> float:
        """Fraction of correct poses, whatever their status."""
        return self.num_correct / self.num_queries


def quartiles(values: Sequence[float]) -> NDArray[np.float64]:
    """The 25th, 50th and 75th percentiles (3,) of values, some of which may be infinite."""
    found = np.quantile(np.minimum(values, HUGE), [0.25, 0.5, 0.75])
    return np.where(found > 1e-6 * HUGE, np.inf, found)


def summarize(rows: Sequence[QueryResult], thresholds: Thresholds = PAPER_THRESHOLDS) -> Summary:
    """The statistics of one or more queries."""
    is_correct = [row.is_correct(thresholds) for row in rows]
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


def accuracies(rows: Sequence[QueryResult], max_angle: float) -> list[float]:
    """The fraction of queries below each of ACCURACY_DISTANCES [m] and below an angle [rad]."""
    levels = [Thresholds(distance, max_angle) for distance in ACCURACY_DISTANCES]
    return [sum(row.is_correct(level) for row in rows) / len(rows) for level in levels]


@dataclass(frozen=True)
class Point:
    """One point of the curve of risk over coverage."""

    confidence: float  # results from here on are accepted
    coverage: float  # fraction that is accepted
    risk: float  # fraction of these that is wrong
    num_wrong: int


def risk_and_coverage(rows: Sequence[QueryResult], thresholds: Thresholds = PAPER_THRESHOLDS) -> list[Point]:
    """The curve of risk over coverage, a point for each distinct confidence, from the highest down."""
    points: dict[float, Point] = {}
    num_wrong = 0
    for k, row in enumerate(sorted(rows, key=lambda row: -row.result.confidence), 1):
        num_wrong += not row.is_correct(thresholds)
        confidence = row.result.confidence
        points[confidence] = Point(confidence, k / len(rows), num_wrong / k, num_wrong)
    return list(points.values())
