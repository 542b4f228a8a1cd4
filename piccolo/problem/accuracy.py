"""The accuracy that a user wants of a pose, and the probability that a pose has it."""

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import NamedTuple

from ..geometry.nearness import Nearness
from ..geometry.pose import MAX_DISTANCE, Pose
from ..geometry.pose_gaussian import PoseGaussian, probability_near, probability_of_ball, probability_of_turn
from ..system.arguments import check_fields
from ..system.arrays import Array
from ..system.errors import InputError

# [m] or [deg]: the limits that `relax` chooses from
ROUND = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0)
FREE_DEG = 180.0  # the largest error of a rotation: with this limit any rotation will do


@dataclass(frozen=True)
class Accuracy:
    """The largest errors with which a pose is exact enough.

    The `confidence` of a result is the probability that its pose is exact enough.

    Parameters
    ----------
    metres
        Largest error of the position [m], by default the paper's.
    degrees
        Largest error of the rotation [deg].

    Raises
    ------
    InputError
        A number is not above 0, or the rotation's is above 180.
    """

    metres: float = MAX_DISTANCE
    degrees: float = 5.0

    def __post_init__(self) -> None:
        """Refuse limits that are not above 0, an infinite distance, and angles above 180 degrees."""
        check_fields(self)
        if not 0.0 < self.metres < math.inf:
            raise InputError(f"`accuracy`: found {self.metres:g} m, wanted metres above 0")
        if not 0.0 < self.degrees <= FREE_DEG:
            raise InputError(f"`accuracy`: found {self.degrees:g} degrees, wanted above 0 and at most 180")

    def __str__(self) -> str:
        """Return the values as the option takes them; degrees are left out if they are the default."""
        turn = "" if self.degrees == Accuracy.degrees else f" {self.degrees:g}"
        return f"{self.metres:g}{turn}"

    @property
    def nearness(self) -> Nearness:
        """Limits of the distance and the angle to the true pose."""
        return Nearness(self.metres, math.radians(self.degrees))

    def probability(self, gaussian: PoseGaussian | None) -> float:
        """Return the probability that a pose with this Gaussian is exact enough; 1 if there is none."""
        return 1.0 if gaussian is None else math.prod(self.parts(gaussian.covariance))

    def parts(self, covariance: Array) -> tuple[float, float]:
        """Return the probability that the position is exact enough, and that the rotation is.

        The covariance (6, 6) [rad, m] has the rotation first. The probability that both are exact enough is
        at least the product of the two (Gaussian correlation inequality; Royen, 2014).
        """
        near = self.nearness
        of_position = probability_of_ball(covariance[3:, 3:], near.distance)
        return of_position, probability_of_turn(covariance[:3, :3], near.angle)

    def probability_at(self, pose: Pose, expected: PoseGaussian) -> float:
        """Return the probability that a pose is exact enough if the true one is distributed as `expected`."""
        return probability_near(pose, expected, self.nearness)

    def relax(self, covariance: Array, least: float) -> "Accuracy | None":
        """Return a larger accuracy that a pose with this covariance (6, 6) has with probability `least`.

        In each step the limit that the pose is less likely to keep, of metres and degrees, rises to the next
        number of ROUND. Return None if it would have to exceed the largest of them.
        """
        relaxed = self
        while math.prod(parts := relaxed.parts(covariance)) < least:
            name = "metres" if parts[0] <= parts[1] else "degrees"
            place = bisect_right(ROUND, getattr(relaxed, name))
            if place == len(ROUND):
                return None
            relaxed = replace(relaxed, **{name: ROUND[place]})
        return relaxed


PAPER_ACCURACY = Accuracy()  # the paper's line between correct and wrong


class Demand(NamedTuple):
    """The accuracy that a user wants, and the least probability of it that makes a pose localized."""

    accuracy: Accuracy
    min_confidence: float  # least probability that a localized pose is exact enough
