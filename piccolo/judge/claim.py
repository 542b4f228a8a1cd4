"""Claims about a photo's geometry, and how far to doubt them if the picture contradicts them."""

import math
from typing import NamedTuple

import numpy as np

from ..system.arrays import Array
from .consensus import MOST_LOG

LEAST_SQUARE = 1e-200  # smaller ones count as this where it is divided by them
MANY = 1e12  # degrees of freedom of a deviation that is known


class PictureCorrections(NamedTuple):
    """Corrections (p,) of a geometry by a picture and a scan alone."""

    values: Array  # (p,)
    information: Array  # (p, p) inverse of their covariance
    of_blocks: Array  # (B, p, p) parts of the covariance that independent blocks would have by chance


class Claim(NamedTuple):
    """Corrections (p,) of a geometry as they are expected: normally distributed and independent.

    Some claims are wrong in one of the corrections, which then has a larger deviation.
    """

    expected: Array  # (p,)
    deviations: Array  # (p,)
    wrong_deviations: Array  # (p,) of corrections in which the claim is wrong
    wrong_shares: Array  # (p,) of claims that are wrong in each correction, among all

    @property
    def precision(self) -> Array:
        """Inverse variances (p,)."""
        return np.asarray(self.deviations**-2.0)

    def contradict(self, by_picture: PictureCorrections) -> tuple[Array, Array]:
        """Return by how many deviations the claim is wrong in each correction (p,), the others as claimed.

        It is the score test (Rao, 1948). Return also the inverse deviations (p,) of the corrections. A
        deviation that is estimated from few blocks is itself uncertain: the score follows Student's
        distribution, and is replaced by the score of a normal distribution that is as rare.
        """
        P = np.diag(self.precision)
        S = P - P @ np.linalg.inv(by_picture.information + P) @ P  # inverse covariance of picture less claim
        scores = S @ (by_picture.values - self.expected)
        inverse = np.sqrt(np.maximum(np.diag(S), 1e-300))
        of_picture = np.maximum(1.0 - np.einsum("ij,ij,i->j", S, S, 1.0 / np.diag(P)) / inverse**2, 0.0)
        freedom = count_variance_freedom(by_picture.of_blocks, S) / np.maximum(of_picture, 1e-6) ** 2
        return np.sign(scores) * as_normal(np.abs(scores) / inverse, freedom), np.asarray(inverse)

    def doubt(self, by_picture: PictureCorrections) -> float:
        """Return the probability that the claim is wrong in one correction, by the odds of each."""
        conflicts, inverse = self.contradict(by_picture)
        wide = 1.0 + (self.wrong_deviations * inverse) ** 2  # of the variance, where it is wrong
        logs = np.minimum(0.5 * conflicts**2 * (1.0 - 1.0 / wide), MOST_LOG)
        odds = float(np.sum(self.wrong_shares / (1.0 - self.wrong_shares) * np.exp(logs) / np.sqrt(wide)))
        return odds / (1.0 + odds)

    def conflict(self, by_picture: PictureCorrections) -> float:
        """Return the greatest number of deviations by which the claim is wrong in one correction."""
        return float(np.abs(self.contradict(by_picture)[0]).max())


def count_variance_freedom(of_blocks: Array, weights: Array) -> Array:
    """Return the degrees of freedom (n,) of the variances of sums of corrections, weighed by (p, n).

    The formula is that of Satterthwaite (1946) for an estimate from blocks (Bell and McCaffrey, 2002).
    """
    parts = np.einsum("in,bij,jn->bn", weights, of_blocks, weights)
    squares = np.maximum(np.square(parts).sum(axis=0), LEAST_SQUARE)
    freedom = np.square(parts.sum(axis=0)) / squares
    return np.asarray(np.where(freedom > 0.0, freedom, MANY))


def as_normal(deviations: Array, freedom: Array) -> Array:
    """Return the deviations (n,) of a normal distribution that are as rare as those of Student's.

    By the formula of Wallace (1959), which is off by 0.02 at most up to six deviations, from one degree of
    freedom on. SciPy's functions would take longer to import than most photos take.
    """
    squares = freedom * np.log1p(np.square(deviations) / freedom)
    wide = 8.0 * freedom + 3.0
    s_squared = np.square(0.184 * wide) / np.maximum(freedom * squares, LEAST_SQUARE)
    return np.asarray(np.sqrt(squares) * (1.0 - 2.0 / wide * np.sqrt(-np.expm1(-s_squared))))


def marginal(by_picture: PictureCorrections, claim: Claim, k: int) -> tuple[float, float]:
    """Return value and variance of one correction by the picture, the others as claimed.

    The variance is infinite if the picture does not determine it.
    """
    precision = claim.precision
    precision[k] = 1e-12
    covariance = np.linalg.inv(by_picture.information + np.diag(precision))
    mean = covariance @ (by_picture.information @ by_picture.values + precision * claim.expected)
    variance = float(covariance[k, k])
    return float(mean[k]), variance if variance < 1e6 else math.inf
