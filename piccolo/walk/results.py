"""The results of a walk's frames: positions smoothed with a constant-acceleration prior."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES
from ..confidence.confidence import classify, probability_within
from ..confidence.covariance import PoseCovariance
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import Array, Pose, exp_so3
from .beliefs import Belief
from .frames import Frame
from .motion import Motion
from .path import EVEN, Gap, Path
from .tracker import Tracker

# A frame's pose and covariance, both in the world
Located = tuple[Pose, PoseCovariance]


@dataclass(frozen=True)
class Alone:
    """The result of a frame localized alone."""

    status: str
    confidence: float
    pose: Pose | None  # in the world


@dataclass(frozen=True)
class WalkFrame:
    """A frame's place in a walk."""

    time: float  # [s] from the walk's beginning; of frames without times their number
    frame: int  # from 0
    how: str  # where its pose comes from: "alone", "tracked", "near", or "none"
    alone: Alone | None  # if it was searched without regard to the others
    gap: Gap | None  # before it; None without times


def make_localizations(
    tracker: Tracker, path: Path, beliefs: Sequence[Belief]
) -> list[tuple[Localization, WalkFrame]]:
    """Return the result of each frame of a walk, poses smoothed together."""
    frames = tracker.frames
    found = [make_localization(tracker, f, belief) for f, belief in zip(frames, beliefs, strict=True)]
    sure = [k for k, f in enumerate(found) if f.pose and f.covariance and f.confidence > EVEN]
    located = [(f.pose, f.covariance) for k in sure if (f := found[k]).pose and f.covariance]
    begins = [0, *(n for n, k in enumerate(sure) if n and path.gaps[k]), len(sure)]
    for lo, hi in pairwise(begins):
        times = [frames[k].time for k in sure[lo:hi]]
        parts = smooth_positions(located[lo:hi], times, tracker.motion)
        for k, (pose, covariance) in zip(sure[lo:hi], parts, strict=True):
            found[k] = replace(found[k], pose=pose, covariance=covariance)
    return [
        (f, WalkFrame(frame.time, k, frame.how, result_alone(frame), gap))
        for k, (f, frame, gap) in enumerate(zip(found, frames, path.gaps, strict=True))
    ]


def result_alone(frame: Frame) -> Alone | None:
    """Return the result of a frame that was localized alone, else None."""
    a = frame.alone
    return None if a is None else Alone(a.status, a.confidence, a.pose)


def make_localization(tracker: Tracker, frame: Frame, belief: Belief) -> Localization:
    """Make a frame's result from its poses and the probabilities that the walk gives them."""
    if not belief.states:
        return frame.alone or Localization()
    best, *others = belief.states
    within = probability_within(best.covariance)
    confidence, *rest = (within * float(p) for p in belief.probabilities)
    none = max(1.0 - confidence - sum(rest), 0.0)
    to_world = tracker.scan_map.to_world
    is_own = frame.alone and frame.states and best is frame.states[0]
    own = frame.alone if is_own and frame.alone else Localization()
    found = [
        Alternative(to_world(s.pose), s.score or 0.0, None, p) for s, p in zip(others, rest, strict=True)
    ]
    return Localization(
        classify(np.array([confidence, *rest, none]), tracker.settings.min_confidence),
        confidence,
        none,
        to_world(best.pose),
        own.loss,
        own.evidence,
        tuple(found[:MAX_ALTERNATIVES]),
        best.covariance,
    )


def smooth_positions(located: Sequence[Located], times: Sequence[float], motion: Motion) -> list[Located]:
    """Smooth positions by small accelerations; return poses and covariances.

    Minimizes sum (x_k - z_k)' C_k^-1 (x_k - z_k) + sum |a_k|^2 / s^2 over the positions x_k, where a_k is the
    second difference by time of three consecutive frames and s the motion's deviation [m/s^2]. Rotations
    follow their positions by each frame's own covariance.
    """
    from scipy.sparse import block_diag, eye, kron  # noqa: PLC0415  # only walks wait for it
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    if len(located) < 3 or not motion.is_timed:
        return list(located)
    rows = acceleration_rows(times, motion)
    smooth = kron(rows.T @ rows, eye(3))
    own = [np.linalg.inv(c.matrix[3:, 3:]) for _, c in located]
    factor = splu((block_diag(own) + smooth).tocsc())
    centers = np.concatenate([pose.center_world for pose, _ in located])
    moves = factor.solve(-(smooth @ centers)).reshape(-1, 3)
    smoothed = []
    for k, (pose, covariance) in enumerate(located):
        part = slice(3 * k, 3 * k + 3)
        variance = factor.solve(np.eye(3 * len(located), 3, -3 * k))[part]
        smoothed.append(move_pose(pose, covariance, moves[k], variance))
    return smoothed


def acceleration_rows(times: Sequence[float], motion: Motion) -> Any:
    """Return the sparse matrix (N - 2, N) that takes positions to a_k / s."""
    from scipy.sparse import csr_matrix  # noqa: PLC0415

    steps = np.diff(times)
    before, after = steps[:-1], steps[1:]
    factors = np.array([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after])
    factors *= 2.0 / (before + after) / motion.max_acceleration
    # in a longer time a person can stop and walk back
    factors[:, np.maximum(before, after) > 2.0 * motion.speed / motion.max_acceleration] = 0.0
    row, offset = np.indices((len(before), 3))
    return csr_matrix((factors.T.ravel(), (row.ravel(), (row + offset).ravel())), (len(before), len(times)))


def move_pose(pose: Pose, covariance: PoseCovariance, move: Array, variance: Array) -> Located:
    """Move a pose by the smoothing of its position, and update its covariance.

    Rotation and position are jointly Gaussian: the rotation follows by C_wd C_dd^-1.
    """
    C = covariance.matrix
    gain = C[:3, 3:] @ np.linalg.inv(C[3:, 3:])
    matrix = C.copy()
    matrix[:3, :3] -= gain @ (C[3:, 3:] - variance) @ gain.T
    matrix[:3, 3:] = gain @ variance
    matrix[3:, :3] = matrix[:3, 3:].T
    matrix[3:, 3:] = variance
    turned = Pose(exp_so3(gain @ move) @ pose.R_cam_from_world, pose.center_world + move)
    return turned, replace(covariance, matrix=0.5 * (matrix + matrix.T))
