"""The focal length of a camera by all of its photos together, and how far to doubt the one that was given."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..geometry.robust import geman_mcclure

WRONG_SHARE = 0.02  # chosen: of given focal lengths, those that are wrong
WRONG_DEVIATION = 0.1  # chosen: deviation of the logarithm of a wrong one
MOST_LOG = 20.0  # of odds
MOST_CONFLICT = 4.0  # deviations between the focal length found and that given: more contradict it
LEAST_AGREEING_PHOTOS = 3  # that make a consensus
OUTLYING = 3.0  # deviations, the scale of weights: photos that differ more have less than a quarter
SHARED_DEVIATION = 0.003  # of an error that all photos of a camera share, as that of a calibration
NUM_UPDATES = 20  # of the weights


class Opinion(NamedTuple):
    """A focal length found in pictures."""

    off: float  # its logarithm, less that of the focal length given
    variance: float

    def conflict(self, prior_deviation: float) -> float:
        """Return how many deviations it is from what was given."""
        return abs(self.off) / math.sqrt(self.variance + prior_deviation**2)

    def doubt(self, prior_deviation: float) -> float:
        """Return the probability that the focal length given is wrong.

        Some belong to another picture or a crop, or are typing errors: then off with a deviation of a tenth,
        else as the variances say. Both are normal distributions of the logarithm.
        """
        spread = self.variance + prior_deviation**2
        wide = spread + WRONG_DEVIATION**2
        odds = WRONG_SHARE / (1.0 - WRONG_SHARE) * math.sqrt(spread / wide)
        odds *= math.exp(min(0.5 * self.off**2 * (1.0 / spread - 1.0 / wide), MOST_LOG))
        return odds / (1.0 + odds)

    def share_of_given(self, prior_deviation: float) -> float:
        """Return the share of what was given in the mean of both."""
        return self.variance / (self.variance + prior_deviation**2)


class Consensus:
    """The focal length of one camera by all of its photos together.

    Photos at a wrong place find any focal length: weights are those of Geman and McClure, from the
    median on. None stands for a photo that says nothing.
    """

    def __init__(self, opinions: Sequence[Opinion | None]) -> None:
        variances = [math.inf if one is None else one.variance for one in opinions]
        self._precision = 1.0 / np.array(variances)
        told = [one.off for one in opinions if one is not None]
        middle = float(np.median(told)) if told else 0.0
        self._off = np.array([middle if one is None else one.off for one in opinions])
        self._weights = self._precision
        for _ in range(NUM_UPDATES if told else 0):
            square = self._precision * (self._off - middle) ** 2
            self._weights = self._precision * geman_mcclure(square, OUTLYING**-2)[1]
            middle = self._weights @ self._off / self._weights.sum()

    def opinion(self, without: int | None = None, least: int = LEAST_AGREEING_PHOTOS) -> Opinion | None:
        """Return the opinion of all, or of all without one; None of fewer than `least`."""
        weights = self._weights.copy()
        if without is not None:
            weights[without] = 0.0
        if np.count_nonzero(weights) < least:
            return None
        off = weights @ self._off / weights.sum()
        scatter = weights**2 @ (self._off - off) ** 2 / weights.sum() ** 2
        variance = max(scatter, 1.0 / weights.sum()) + SHARED_DEVIATION**2
        return Opinion(float(off), float(variance))
