"""The hint of a photo whose place is certain, but whose pose is not as exact as wanted."""

import math
from dataclasses import replace

from ..problem.accuracy import Accuracy, Demand
from .pose_covariance import PoseCovariance

HINT_DIGITS = 2  # of an error in the hint; it is rounded up
NUM_HALVINGS = 20
ROUNDING = 1e-6  # of the last digit, by which an error may be above its number


def explain_accuracy(place: float, covariance: PoseCovariance, demand: Demand) -> str | None:
    """Return a line that names the accuracy with which a pose would be accepted.

    `place` is the probability that its place is right. None if the place is not certain, if the pose is
    already as exact as wanted by its covariance, or if no accuracy is enough.
    """
    if place < demand.min_confidence:
        return None
    wanted = demand.accuracy
    least = demand.min_confidence / place
    enough = wanted.relax(covariance.matrix, least)
    if enough is None or enough == wanted:
        return None
    errors = []
    if enough.metres > wanted.metres:
        reach = _find_reach(wanted.metres, enough, covariance, least, "metres")
        errors.append(f"the position only to {_round_up(reach)} m")
    if enough.degrees > wanted.degrees:
        reach = _find_reach(wanted.degrees, enough, covariance, least, "degrees")
        errors.append(f"the rotation only to {_round_up(reach)} deg")
    return f"the place is certain, {' and '.join(errors)}: `accuracy` {enough} would accept it"


def _find_reach(
    least_reach: float, enough: Accuracy, covariance: PoseCovariance, least: float, name: str
) -> float:
    """Return the smallest number of the field `name`, metres or degrees, with which an accuracy is enough."""
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
    """Return a number in words, rounded up to HINT_DIGITS digits."""
    step = 10.0 ** (math.floor(math.log10(value)) + 1 - HINT_DIGITS)
    return f"{step * math.ceil(value / step - ROUNDING):.{HINT_DIGITS}g}"
