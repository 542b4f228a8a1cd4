"""Positions measured one after another, smoothed by small accelerations."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arrays import Array
from ..geometry.pose_gaussian import PoseGaussian, add


def smooth_positions(
    located: Sequence[PoseGaussian], times: Sequence[float], max_acceleration: float, max_speed: float
) -> list[PoseGaussian]:
    """Smooth the positions of a walking camera by small accelerations; return poses and covariances.

    Minimizes sum (x_k - z_k)' C_k^-1 (x_k - z_k) + sum |a_k|^2 / s^2 over the positions x_k, where a_k is the
    second difference by time of three consecutive frames and s its deviation `max_acceleration` [m/s^2].
    Rotations follow their positions by each frame's own covariance. Errors in common stay. Frames so far
    apart in time that a camera at `max_speed` [m/s] can stop and turn back between them do not constrain each
    other.
    """
    from scipy.sparse import block_diag, eye, kron  # noqa: PLC0415  # only walks wait for it
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    if len(located) < 3:
        return list(located)
    rows = acceleration_rows(times, max_acceleration, max_speed)
    smooth = kron(rows.T @ rows, eye(3))
    own = [np.linalg.inv(one.own[3:, 3:]) for one in located]
    factor = splu((block_diag(own) + smooth).tocsc())
    centers = np.concatenate([one.pose.center_world for one in located])
    moves = factor.solve(-(smooth @ centers)).reshape(-1, 3)
    smoothed = []
    for k, one in enumerate(located):
        part = slice(3 * k, 3 * k + 3)
        variance = factor.solve(np.eye(3 * len(located), 3, -3 * k))[part]
        smoothed.append(move_pose(one, moves[k], variance))
    return smoothed


def acceleration_rows(times: Sequence[float], max_acceleration: float, max_speed: float) -> Any:
    """Return the sparse matrix (N - 2, N) that takes positions to a_k / s."""
    from scipy.sparse import csr_matrix  # noqa: PLC0415

    steps = np.diff(times)
    before, after = steps[:-1], steps[1:]
    factors = np.array([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after])
    factors *= 2.0 / (before + after) / max_acceleration
    # in a longer time a person can stop and walk back
    factors[:, np.maximum(before, after) > 2.0 * max_speed / max_acceleration] = 0.0
    row, offset = np.indices((len(before), 3))
    return csr_matrix((factors.T.ravel(), (row.ravel(), (row + offset).ravel())), (len(before), len(times)))


def move_pose(located: PoseGaussian, move: Array, variance: Array) -> PoseGaussian:
    """Move a pose by the smoothing of its position, and update its covariance.

    Rotation and position are jointly Gaussian: the rotation follows by C_wd C_dd^-1.
    """
    C = located.own
    gain = C[:3, 3:] @ np.linalg.inv(C[3:, 3:])
    own = C.copy()
    own[:3, :3] -= gain @ (C[3:, 3:] - variance) @ gain.T
    own[:3, 3:] = gain @ variance
    own[3:, :3] = own[:3, 3:].T
    own[3:, 3:] = variance
    pose = add(located.pose, np.concatenate([gain @ move, move]))
    return PoseGaussian(pose, 0.5 * (own + own.T), located.common)
