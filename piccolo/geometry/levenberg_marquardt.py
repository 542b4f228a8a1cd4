"""Levenberg-Marquardt on a pose: one loop, in Python for any objective and compiled for those in kernels."""

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..system.arrays import Array
from ..system.kernels.jit import copy_to, kernel

NUM_SUMS = 29  # loss, count, gradient (6), upper triangle of the normal matrix (21)
LOSS = 0  # where they begin
COUNT_SUM = 1
GRADIENT = 2
MATRIX = 8
MAX_TURN = 0.15  # [rad] a step: farther away the matrix means nothing
MAX_MOVE = 0.3  # [m]
FIRST_DAMPING = 1e-3  # of the diagonal
LEAST_DAMPING = 1e-6
MOST_DAMPING = 1e4
FALL = 0.2  # of the damping after a step that was taken
RISE = 8.0  # and one that was not
# Float32 sums differ by this fraction from one pose to the next: a smaller rise counts as none. Without it
# rounding ends a descent, some hundredths of a millimetre from the minimum.
LOSS_ROUNDING = 1e-7

Problem = TypeVar("Problem")


@kernel
def retract(
    R_cam_from_world: Array, center_world: Array, step: Array, R_new: Array, center_new: Array
) -> float:
    """Write R <- exp([w]x) R and t <- t + R^T d for a limited step; return its length [rad + m].

    The exponential is a series, exact in float64 below MAX_TURN: kernels can't call `pose.exp_so3`.
    """
    R = R_cam_from_world
    turn = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    move = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    limit = min(1.0, MAX_TURN / max(turn, 1e-30), MAX_MOVE / max(move, 1e-30))
    angle = turn * limit
    wx = step[0] * limit
    wy = step[1] * limit
    wz = step[2] * limit
    a = 1.0 - angle * angle / 6.0 + angle**4 / 120.0
    b = 0.5 - angle * angle / 24.0 + angle**4 / 720.0
    E = np.empty((3, 3))
    E[0, 0] = 1.0 - b * (wy * wy + wz * wz)
    E[1, 1] = 1.0 - b * (wx * wx + wz * wz)
    E[2, 2] = 1.0 - b * (wx * wx + wy * wy)
    E[0, 1] = b * wx * wy - a * wz
    E[1, 0] = b * wx * wy + a * wz
    E[0, 2] = b * wx * wz + a * wy
    E[2, 0] = b * wx * wz - a * wy
    E[1, 2] = b * wy * wz - a * wx
    E[2, 1] = b * wy * wz + a * wx
    for i in range(3):
        center_new[i] = center_world[i] + limit * (R[0, i] * step[3] + R[1, i] * step[4] + R[2, i] * step[5])
        for j in range(3):
            R_new[i, j] = E[i, 0] * R[0, j] + E[i, 1] * R[1, j] + E[i, 2] * R[2, j]
    return angle + move * limit


@kernel
def solve_damped(  # noqa: C901, PLR0912  # Cholesky by hand: LAPACK costs more for 6 x 6
    sums: Array, damping: float, step: Array
) -> bool:
    """Write the damped Gauss-Newton step (6,), by Cholesky; return False if the matrix is not positive."""
    A = np.empty((6, 6))
    m = MATRIX
    for a in range(6):
        for b in range(a, 6):
            A[a, b] = A[b, a] = sums[m]
            m += 1
    for a in range(6):
        A[a, a] += damping * A[a, a] + 1e-9
        step[a] = -sums[GRADIENT + a]
    for a in range(6):
        for b in range(a):
            A[a, a] -= A[a, b] * A[a, b]
        if A[a, a] <= 0.0:
            return False
        A[a, a] = math.sqrt(A[a, a])
        for c in range(a + 1, 6):
            for b in range(a):
                A[c, a] -= A[c, b] * A[a, b]
            A[c, a] /= A[a, a]
    for a in range(6):
        for b in range(a):
            step[a] -= A[a, b] * step[b]
        step[a] /= A[a, a]
    for k in range(6):
        a = 5 - k
        for b in range(a + 1, 6):
            step[a] -= A[b, a] * step[b]
        step[a] /= A[a, a]
    return True


def levenberg_marquardt(
    equations: Callable[[Problem, Array, Array, Array], None],
) -> Callable[[Problem, int, float, Array, Array], float]:
    """Make a descent for `equations(problem, R, t, sums)`, which writes the sums (29,) of normal_equations.

    The descent takes a problem, the number of iterations at most, a tolerance [rad + m], and R (3, 3) and
    t (3,), in which it leaves the best pose found; it returns the loss there. Compile it with `kernel` if
    `equations` is one.
    """

    def descend(
        problem: Problem, num_iterations: int, tolerance: float, R_cam_from_world: Array, center_world: Array
    ) -> float:
        R = R_cam_from_world
        t = center_world
        sums = np.empty(NUM_SUMS)
        new_sums = np.empty(NUM_SUMS)
        step = np.empty(6)
        R_new = np.empty((3, 3))
        t_new = np.empty(3)
        copy_to(R_new, R)
        copy_to(t_new, t)
        sums[LOSS] = np.inf
        damping = FIRST_DAMPING / FALL
        length = np.inf
        # There is one call of the equations, as each would be compiled in; the first accepts the start.
        for left in range(num_iterations, -1, -1):
            equations(problem, R_new, t_new, new_sums)
            if new_sums[LOSS] <= sums[LOSS] * (1.0 + LOSS_ROUNDING):
                copy_to(R, R_new)
                copy_to(t, t_new)
                copy_to(sums, new_sums)
                damping = max(damping * FALL, LEAST_DAMPING)
            else:
                damping *= RISE
            # infinite: the start has no loss, and the sums give no step
            if length < tolerance or damping > MOST_DAMPING or left == 0 or math.isinf(sums[LOSS]):
                break
            if not solve_damped(sums, damping, step):
                break
            length = retract(R, t, step, R_new, t_new)
        loss: float = sums[LOSS]
        return loss

    return descend
