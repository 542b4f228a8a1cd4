"""Robust losses of residuals by their squares, and the weights that residuals have by them.

A weight is twice the derivative of the loss by the square: least squares with these weights, found anew at
each step, have the gradient of the loss. Those with `inline` are for kernels.
"""

import math
from typing import TypeVar

import numpy as np

from ..system.arrays import Array, Array32
from ..system.kernels.jit import F1, HALF, Scalar, inline_kernel

Number = TypeVar("Number", Scalar, Array, Array32)


def geman_mcclure(square: Number, inverse_scale2: Scalar) -> tuple[Number, Number]:
    """Return loss, 1/2 r^2 / (1 + r^2 / s^2), and weight: far above the scale s no residual has influence.

    Geman and McClure, "Bayesian image analysis: an application to single photon emission tomography" (1985).
    At the scale a weight is a quarter.
    """
    s = F1 / (F1 + square * inverse_scale2)
    return HALF * square * s, s * s


def redescend(square: Array, limit: float) -> tuple[Array, Array]:
    """Return losses and weights (N,) of squares: all of a residual counts below the limit, little far beyond.

    Beyond, the influence falls as 1 / r^3, as by Geman and McClure's loss. Losses by which it falls are
    called redescending (Hampel, "The influence curve and its role in robust estimation", 1974).
    """
    share = np.minimum(1.0, limit / np.maximum(square, limit))
    return np.where(share < 1.0, limit * (1.0 - 0.5 * share), 0.5 * square), share**2


@inline_kernel
def inline_absolute(square: Scalar, least: Scalar) -> tuple[Scalar, Scalar]:
    """Return a residual's length, and the weight 1 / length of the least sum of lengths (Weiszfeld, 1937).

    A residual shorter than `least` has the weight 1 / `least`.
    """
    length = math.sqrt(square)
    return length, F1 / max(length, least)


def weigh_absolute(residuals: Array, least: float) -> Array:
    """Return the weights (N,) of residuals by `inline_absolute`."""
    return np.asarray(1.0 / np.maximum(np.abs(residuals), least))


inline_geman_mcclure = inline_kernel(geman_mcclure)
