"""Robust least squares on a few unknowns outside of kernels: the damped steps of Gauss and Newton.

Minimised is the sum over observations k of rho(|r_k|^2), with residuals r_k (m,), predicted less observed in
deviations, and a loss rho of `geometry.robust`. With weights w_k by rho, and derivatives J_k (m, n) of r_k by
a step of the unknowns,

    gradient = sum_k w_k J_k^T r_k,    matrix = sum_k w_k J_k^T J_k,

and the step d solves (matrix + damping diag(matrix)) d = -gradient. If it does not lower the loss, it is not
taken and the damping rises (Levenberg, 1944; Marquardt, 1963).
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from ..system.arrays import Array
from .levenberg_marquardt import FALL, FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING

# chosen: factor of the damping after a step that is not taken. A lens takes few steps, and with 8, as kernels
# have, it ends elsewhere.
REFUSED = 6.0
TINY_DAMPING = 1e-9  # that makes matrices invertible, as in kernels
Robust = Callable[[Array], tuple[Array, Array]]  # losses and weights (N,) of squares (N,)
State = TypeVar("State")


class Equations(NamedTuple):
    """A loss, and the normal equations of a step of n unknowns."""

    loss: float
    gradient: Array  # (n,)
    matrix: Array  # (n, n)

    def solve(self, damping: float = 0.0) -> Array:
        """Return the step (n,)."""
        damped = self.matrix + np.diag(damping * self.matrix.diagonal() + TINY_DAMPING)
        return np.asarray(-np.linalg.solve(damped, self.gradient), np.float64)

    def add_known(self, off: Array, information: Array) -> "Equations":
        """Add what is known beforehand: its information (n, n), and how far off (n,) the unknowns are."""
        slopes = information @ off
        loss = self.loss + 0.5 * float(off @ slopes)
        return Equations(loss, self.gradient + slopes, self.matrix + information)


def whiten(covariances: Array, errors: Array) -> Array:
    """Return errors (N, m) or their derivatives (N, m, n) in deviations, by covariances (N, m, m)."""
    columns = errors if errors.ndim == 3 else errors[..., None]
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariances), columns).reshape(errors.shape))


def sum_observations(residuals: Array, J: Array, robust: Robust) -> Equations:
    """Sum the equations of residuals (N, m) in deviations with derivatives (N, m, n)."""
    losses, weights = robust(np.square(residuals).sum(axis=1))
    weighted = weights[:, None, None] * J
    gradient = np.einsum("kmi,km->i", weighted, residuals)
    return Equations(float(losses.sum()), gradient, np.einsum("kmi,kmj->ij", weighted, J))


def minimize(
    equations: Callable[[State], Equations],
    move: Callable[[State, Array], State],
    start: State,
    num_steps: int,
    settled: float,
) -> tuple[State, Equations]:
    """Take at most `num_steps`, until one is shorter than `settled`; return the best state."""
    state = start
    found = equations(state)
    damping = FIRST_DAMPING
    for _ in range(num_steps):
        step = found.solve(damping)
        moved = move(state, step)
        after = equations(moved)
        if after.loss > found.loss:
            damping *= REFUSED
            if damping > MOST_DAMPING:
                break
            continue
        state = moved
        found = after
        damping = max(FALL * damping, LEAST_DAMPING)
        if np.linalg.norm(step) < settled:
            break
    return state, found
