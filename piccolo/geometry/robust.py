"""Robust losses of residuals by their squares, and the weights that residuals have by them.

A weight is twice the derivative of the loss by the square: least squares with these weights, found anew at
each step, have the gradient of the loss.
"""

import numpy as np

from ..arrays import Array


def redescend(square: Array, limit: float) -> tuple[Array, Array]:
    """Return losses and weights (N,) of squares: all of a residual counts below the limit, little far beyond.

    The influence of a residual r falls as 1 / r^3 beyond, as by Geman and McClure's loss: redescending
    (Hampel, 1974).
    """
    share = np.minimum(1.0, limit / np.maximum(square, limit))
    return np.where(share < 1.0, limit * (1.0 - 0.5 * share), 0.5 * square), share**2
