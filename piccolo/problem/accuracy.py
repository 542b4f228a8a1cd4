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

ROUND = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0)  # [m] or [deg] that are proposed
FREE_DEG = 180.0  # of a rotation that may be any


@dataclass(frozen=True)
class Accuracy:
    """Largest errors of a pose that is exact enough: `confidence` is the probability of that.

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
        """Refuse what no pose can be, or every pose is."""
        check_fields(self)
        if not 0.0 < self.metres < math.inf:
            raise InputError(f"`accuracy`: found {self.metres:g} m, wanted metres above 0")
        if not 0.0 < self.degrees <= FREE_DEG:
            raise InputError(f"`accuracy`: found {self.degrees:g} degrees, wanted above 0 and at most 180")

    def __str__(self) -> str:
        """Return the option's values, without degrees that are the default."""
        turn = "" if self.degrees == Accuracy.degrees else f" {self.degrees:g}"
        return f"{self.metres:g}{turn}"

    @property
    def nearness(self) -> Nearness:
        """Limits of the distance and the angle to the true pose."""
        return Nearness(self.metres, math.radians(self.degrees))

    def probability(self, found: PoseGaussian | None) -> float:
        """Return the probability that a pose is so exact, by its Gaussian; 1 for None."""
        return 1.0 if found is None else math.prod(self.parts(found.covariance))

    def parts(self, covariance: Array) -> tuple[float, float]:
        """Return the probabilities that position and rotation are so exact, by a covariance (6, 6).

        Both hold at least with the product of them (Gaussian correlation inequality; Royen, 2014).
        """
        near = self.nearness
        of_position = probability_of_ball(covariance[3:, 3:], near.distance)
        return of_position, probability_of_turn(covariance[:3, :3], near.angle)

    def probability_at(self, pose: Pose, expected: PoseGaussian) -> float:
        """Return the probability that a pose is so exact, if the true one is as another Gaussian has it."""
        return probability_near(pose, expected, self.nearness)

    def relax(self, covariance: Array, least: float) -> "Accuracy | None":
        """Return an accuracy of round numbers that a pose has with a probability of `least` or more.

        Of position and rotation that is relaxed which is less likely exact enough. None if nothing suffices.
        """
        asked = self
        while math.prod(parts := asked.parts(covariance)) < least:
            name = "metres" if parts[0] <= parts[1] else "degrees"
            place = bisect_right(ROUND, getattr(asked, name))
            if place == len(ROUND):
                return None
            asked = replace(asked, **{name: ROUND[place]})
        return asked


PAPER_ACCURACY = Accuracy()  # the paper's line between correct and wrong


class Demand(NamedTuple):
    """The accuracy that a user wants of a pose, and how sure of it one must be that is called localized."""

    accuracy: Accuracy
    min_confidence: float  # that it is so exact
