"""The positions of a walk together: each frame's own, and that nobody is jerked about."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..confidence.covariance import PoseCovariance
from ..geometry.pose import Array, Pose, exp_so3
from .frames import Motion

BANDS = 6  # of the information matrix beside its diagonal: two frames of three coordinates
PRIOR_FLOOR = 1e-6  # [m^2] least variance of a position
LONGEST_STEP = 3.0  # [s] frames farther apart say nothing of each other's acceleration

# A frame's pose and covariance, both in the world
Located = tuple[Pose, PoseCovariance]


def smoothed(located: Sequence[Located], times: Sequence[float], motion: Motion) -> list[Located]:
    """Poses, and their covariances, that agree best with their own and with small accelerations.

    Minimizes sum (x_k - z_k)' C_k^-1 (x_k - z_k) + sum |a_k|^2 / s^2 over the positions x_k, where a_k is the
    second difference by times of three frames in a row and s the motion's deviation [m/s^2]. Rotations follow
    their positions by each frame's own covariance.
    """
    from scipy.linalg import solveh_banded  # noqa: PLC0415  # only walks wait for it

    if len(located) < 3:
        return list(located)
    own = [c.matrix[3:, 3:] + PRIOR_FLOOR * np.eye(3) for _, c in located]
    information = np.zeros((BANDS + 3, 3 * len(located)))
    right = np.zeros(3 * len(located))
    for k, covariance in enumerate(own):
        _add(information, k, k, np.asarray(np.linalg.inv(covariance)))
    rows = acceleration_rows(times, motion)
    for k, row in rows:
        for i in range(3):
            for j in range(i, 3):
                _add(information, k + i, k + j, np.eye(3) * row[i] * row[j])
        a = sum(row[i] * located[k + i][0].center_world for i in range(3))
        for i in range(3):
            right[3 * (k + i) : 3 * (k + i) + 3] -= row[i] * a
    moves = solveh_banded(information, right).reshape(-1, 3)
    variances = marginal_covariances(information)
    return [
        moved(pose, covariance, move, variance)
        for (pose, covariance), move, variance in zip(located, moves, variances, strict=True)
    ]


def acceleration_rows(times: Sequence[float], motion: Motion) -> list[tuple[int, Array]]:
    """First of three frames, and the factors (3,) of their positions in a_k / s."""
    rows = []
    for k in range(len(times) - 2):
        before, after = np.diff(times[k : k + 3])
        if max(before, after) > LONGEST_STEP:
            continue
        row = np.array([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after]) * 2.0 / (before + after)
        rows.append((k, row / motion.max_acceleration))
    return rows


def marginal_covariances(information: NDArray[np.float64]) -> list[Array]:
    """Covariances (3, 3) of each position by the banded information matrix, upper form."""
    from scipy.linalg import cho_solve_banded, cholesky_banded  # noqa: PLC0415

    n = information.shape[1] // 3
    factor = cholesky_banded(information)
    found = []
    for k in range(n):  # few hundred frames: a solution each
        right = np.zeros((3 * n, 3))
        right[3 * k : 3 * k + 3] = np.eye(3)
        found.append(cho_solve_banded((factor, False), right)[3 * k : 3 * k + 3])
    return found


def moved(pose: Pose, covariance: PoseCovariance, move: Array, variance: Array) -> Located:
    """A pose whose position was moved by what other frames say, and the covariance then.

    Rotation and position are jointly Gaussian: the one follows the other by C_wd C_dd^-1.
    """
    C = covariance.matrix
    gain = C[:3, 3:] @ np.linalg.inv(C[3:, 3:] + PRIOR_FLOOR * np.eye(3))
    matrix = C.copy()
    matrix[:3, :3] -= gain @ (C[3:, 3:] - variance) @ gain.T
    matrix[:3, 3:] = gain @ variance
    matrix[3:, :3] = matrix[:3, 3:].T
    matrix[3:, 3:] = variance
    turned = Pose(exp_so3(gain @ move) @ pose.R_cam_from_world, pose.center_world + move)
    return turned, replace(covariance, matrix=0.5 * (matrix + matrix.T))


def _add(banded: NDArray[np.float64], k: int, j: int, block: Array) -> None:
    """Add a block (3, 3) of frames k <= j to a banded matrix in upper form."""
    for a in range(3):
        for b in range(3):
            off = 3 * (j - k) + b - a
            if off >= 0:
                banded[-1 - off, 3 * j + b] += block[a, b]
