"""Claims about a photo's geometry, and how far to doubt them if picture and scan differ."""

import math
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from .consensus import MOST_LOG


class Claim(NamedTuple):
    """Corrections (p,) of a geometry as they are expected: normally distributed, each by itself.

    Some claims are wrong altogether, in one respect or another; then that correction has a larger deviation.
    """

    expected: Array  # (p,)
    deviations: Array  # (p,)
    wrong_deviations: Array  # (p,) of wrong ones
    wrong_shares: Array  # (p,) of wrong ones among all

    @property
    def precision(self) -> Array:
        """Inverse variances (p,)."""
        return np.asarray(self.deviations**-2.0)

    def contradict(self, values: Array, information: Array) -> tuple[Array, Array]:
        """Return by how many deviations each correction (p,) is wrong if only it is, and their inverse.

        `values` (p,) are those of the picture, `information` (p, p) is the inverse of their covariance. It is
        the score test (Rao, 1948) of each correction, the others as claimed; the inverse deviation is that of
        the score.
        """
        P = np.diag(self.precision)
        S = P - P @ np.linalg.inv(information + P) @ P  # inverse of the covariance of picture less claim
        scores = S @ (values - self.expected)
        inverse = np.sqrt(np.maximum(np.diag(S), 1e-300))
        return np.asarray(scores / inverse), np.asarray(inverse)

    def doubt(self, values: Array, information: Array) -> float:
        """Return the probability that the claim is wrong in one respect, by the odds of each."""
        conflicts, inverse = self.contradict(values, information)
        wide = 1.0 + (self.wrong_deviations * inverse) ** 2  # of the variance, where it is wrong
        logs = np.minimum(0.5 * conflicts**2 * (1.0 - 1.0 / wide), MOST_LOG)
        odds = float(np.sum(self.wrong_shares / (1.0 - self.wrong_shares) * np.exp(logs) / np.sqrt(wide)))
        return odds / (1.0 + odds)

    def conflict(self, values: Array, information: Array) -> float:
        """Return the greatest number of deviations by which one correction is wrong."""
        return float(np.abs(self.contradict(values, information)[0]).max())


def marginal(values: Array, information: Array, claim: Claim, k: int) -> tuple[float, float]:
    """Return value and variance of one correction by the picture, the others as claimed.

    The variance is infinite if the picture says nothing of it.
    """
    precision = claim.precision
    precision[k] = 1e-12
    covariance = np.linalg.inv(information + np.diag(precision))
    mean = covariance @ (information @ values + precision * claim.expected)
    variance = float(covariance[k, k])
    return float(mean[k]), variance if variance < 1e6 else math.inf
