"""The hint of a photo whose place is certain, but whose pose is not as exact as wanted."""

import math
from dataclasses import replace

from ..problem.accuracy import Accuracy, Demand
from .pose_covariance import PoseCovariance

TOLD_DIGITS = 2  # of an error that is told; it is rounded up
NUM_HALVINGS = 20
ROUNDING = 1e-6  # of a step, by which a number may be above


def explain_accuracy(place: float, covariance: PoseCovariance, demand: Demand) -> str | None:
    """Return a line with the accuracy that would accept a pose whose place has a probability.

    None if the place is not certain, if the pose is as exact as wanted by its own covariance, and if no
    accuracy is enough.
    """
    if place < demand.min_confidence:
        return None
    asked = demand.accuracy
    least = demand.min_confidence / place
    enough = asked.relax(covariance.matrix, least)
    if enough is None or enough == asked:
        return None
    told = []
    if enough.metres > asked.metres:
        reach = _find_reach(asked.metres, enough, covariance, least, "metres")
        told.append(f"the position only to {_round_up(reach)} m")
    if enough.degrees > asked.degrees:
        reach = _find_reach(asked.degrees, enough, covariance, least, "degrees")
        told.append(f"the rotation only to {_round_up(reach)} deg")
    return f"the place is certain, {' and '.join(told)}: `accuracy` {enough} would accept it"


def _find_reach(
    least_reach: float, enough: Accuracy, covariance: PoseCovariance, least: float, name: str
) -> float:
    """Return the least limit, of metres or degrees, with which an accuracy is enough."""
    low = least_reach
    high = getattr(enough, name)
    for _ in range(NUM_HALVINGS):
        middle = 0.5 * (low + high)
        if math.prod(replace(enough, **{name: middle}).parts(covariance.matrix)) < least:
            low = middle
        else:
            high = middle
    return float(high)


def _round_up(value: float) -> str:
    """Return a number with TOLD_DIGITS digits, not below it."""
    step = 10.0 ** (math.floor(math.log10(value)) + 1 - TOLD_DIGITS)
    return f"{step * math.ceil(value / step - ROUNDING):.{TOLD_DIGITS}g}"
