"""The focal length of a camera by all of its photos together, and how far to doubt the given one."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..geometry.robust import geman_mcclure

WRONG_SHARE = 0.02  # chosen: share of given focal lengths that are wrong
WRONG_DEVIATION = 0.1  # chosen: deviation of the logarithm of a wrong one
MOST_LOG = 20.0  # logarithm of odds, at most
MOST_CONFLICT = 4.0  # deviations between an estimate and the given focal length: more contradict it
LEAST_AGREEING_PHOTOS = 3  # photos that make a consensus
OUTLYING = 3.0  # deviations, the scale of weights: photos that differ by more weigh less than a quarter
SHARED_DEVIATION = 0.003  # of an error that all photos of a camera share, as that of a calibration
NUM_UPDATES = 20  # rounds in which the photos' weights are computed again


class Opinion(NamedTuple):
    """A focal length estimated from pictures."""

    off: float  # its logarithm, less that of the given focal length
    variance: float

    def conflict(self, prior_deviation: float) -> float:
        """Return how many deviations it is from the given focal length."""
        return abs(self.off) / math.sqrt(self.variance + prior_deviation**2)

    def doubt(self, prior_deviation: float) -> float:
        """Return the probability that the given focal length is wrong.

        Some given focal lengths belong to another picture or a crop, or are typing errors: their logarithm is
        normally distributed with WRONG_DEVIATION, that of right ones as the variances say.
        """
        spread = self.variance + prior_deviation**2
        wide = spread + WRONG_DEVIATION**2
        odds = WRONG_SHARE / (1.0 - WRONG_SHARE) * math.sqrt(spread / wide)
        odds *= math.exp(min(0.5 * self.off**2 * (1.0 / spread - 1.0 / wide), MOST_LOG))
        return odds / (1.0 + odds)

    def share_of_given(self, prior_deviation: float) -> float:
        """Return the weight of the given focal length in its mean with this one."""
        return self.variance / (self.variance + prior_deviation**2)


class Consensus:
    """The focal length of one camera by all of its photos together.

    A photo that was found at a wrong place gives any focal length. So photos are weighted as by Geman and
    McClure, beginning at the median. None stands for a photo without an opinion.
    """

    def __init__(self, opinions: Sequence[Opinion | None]) -> None:
        variances = [math.inf if one is None else one.variance for one in opinions]
        self._precision = 1.0 / np.array(variances)
        offs = [one.off for one in opinions if one is not None]
        middle = float(np.median(offs)) if offs else 0.0
        self._off = np.array([middle if one is None else one.off for one in opinions])
        self._weights = self._precision
        for _ in range(NUM_UPDATES if offs else 0):
            square = self._precision * (self._off - middle) ** 2
            self._weights = self._precision * geman_mcclure(square, OUTLYING**-2)[1]
            middle = self._weights @ self._off / self._weights.sum()

    def opinion(self, without: int | None = None, least: int = LEAST_AGREEING_PHOTOS) -> Opinion | None:
        """Return the opinion of all photos, or of all but one; None if fewer than `least` have an opinion."""
        weights = self._weights.copy()
        if without is not None:
            weights[without] = 0.0
        if np.count_nonzero(weights) < least:
            return None
        off = weights @ self._off / weights.sum()
        scatter = weights**2 @ (self._off - off) ** 2 / weights.sum() ** 2
        variance = max(scatter, 1.0 / weights.sum()) + SHARED_DEVIATION**2
        return Opinion(float(off), float(variance))
