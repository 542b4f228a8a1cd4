"""The focal length of a camera by all of its photos together, and how far to doubt the one that was given."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

SLIPS = 0.02  # chosen: of given focal lengths, those that are wrong
SLIP = 0.1  # chosen: deviation of the logarithm of a wrong one
MOST_LOG = 50.0  # of odds
MOST_CONFLICT = 4.0  # deviations between the focal length found and that given: more contradict it
LEAST_PHOTOS = 3  # that make a consensus
OUTLYING = 3.0  # deviations: photos that differ more have less than a quarter of their weight
SHARED_DEVIATION = 0.003  # of an error that all photos of a camera share, as that of a calibration
NUM_UPDATES = 20  # of the weights


class Opinion(NamedTuple):
    """A focal length found in pictures."""

    off: float  # its logarithm, less that of the focal length given
    variance: float

    def conflict(self, given_deviation: float) -> float:
        """Return how many deviations it is from what was given."""
        return abs(self.off) / math.sqrt(self.variance + given_deviation**2)

    def doubt(self, given_deviation: float) -> float:
        """Return the probability that the focal length given is wrong.

        Some are: of another picture, a crop, a slip. Then they are off by a tenth; else by no more than the
        variance of the difference says. Both are normal distributions of the logarithm.
        """
        spread = self.variance + given_deviation**2
        wide = spread + SLIP**2
        odds = SLIPS / (1.0 - SLIPS) * math.sqrt(spread / wide)
        odds *= math.exp(min(0.5 * self.off**2 * (1.0 / spread - 1.0 / wide), MOST_LOG))
        return odds / (1.0 + odds)


def combine(opinions: Sequence[Opinion]) -> Opinion | None:
    """Combine the opinions of photos of one camera; None if they are too few.

    Photos at a wrong place find any focal length: weights are those of Geman and McClure's loss, from the
    weighted median on.
    """
    if len(opinions) < LEAST_PHOTOS:
        return None
    off, variance = np.array(opinions).T
    order = np.argsort(off, kind="stable")
    shares = np.cumsum(1.0 / variance[order])
    middle = off[order][np.searchsorted(shares, 0.5 * shares[-1])]
    for _ in range(NUM_UPDATES):
        weights = 1.0 / variance / (1.0 + (off - middle) ** 2 / (OUTLYING**2 * variance)) ** 2
        middle = weights @ off / weights.sum()
    scatter = weights**2 @ (off - middle) ** 2 / weights.sum() ** 2
    return Opinion(float(middle), float(max(scatter, 1.0 / weights.sum()) + SHARED_DEVIATION**2))
