"""The results of a walk's frames, when all of them are known; positions are smoothed by accelerations."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from ...evidence.contradictions import contradictions
from ...geometry.pose_gaussian import PoseGaussian, add
from ...judge.alternatives import MAX_ALTERNATIVES
from ...judge.belief import make_belief
from ...judge.conclude import take_pose
from ...judge.consensus import MOST_CONFLICT
from ...judge.pose_covariance import describe_errors
from ...judge.probability import LOCALIZED
from ...judge.reasons import explain
from ...judge.result import Result, nothing_found
from ...judge.result_parts import Alone, Alternative, Gap, WalkFrame
from ...system.arrays import Array
from ...system.jobs.threads import Progress, no_progress
from .frames import Frame
from .path import EVEN, Ranked
from .second_look import finish_path
from .tracker import Tracker

LEAST_WALKED = 2.0  # [m] between frames by which an odometry is checked
LEAST_RATIOS = 4  # ratios of distances by which an odometry is checked
REPORTED_SCALE = 0.03  # error of an odometry's scale: a larger one is reported


def make_localizations(tracker: Tracker, show: Progress = no_progress) -> list[tuple[Result, WalkFrame]]:
    """Return the result of each frame of a walk, given all frames; poses are smoothed together."""
    path, beliefs = finish_path(tracker, show)
    frames = tracker.frames
    motion = tracker.motion
    found = [make_localization(tracker, f, belief) for f, belief in zip(frames, beliefs, strict=True)]
    sure = [k for k, f in enumerate(found) if motion.is_timed and f.gaussian and f.place_probability > EVEN]
    located = [gaussian for k in sure if (gaussian := found[k].gaussian)]
    begins = [0, *(n for n, k in enumerate(sure) if n and path.gaps[k]), len(sure)]
    for lo, hi in pairwise(begins):
        times = [frames[k].time for k in sure[lo:hi]]
        parts = smooth_positions(located[lo:hi], times, motion.max_acceleration, motion.speed)
        for k, gaussian in zip(sure[lo:hi], parts, strict=True):
            found[k] = take_pose(found[k], gaussian, tracker.scan_map)
    notes = check_odometry(frames, found)
    for k, frame in enumerate(frames):
        if frame.odometry is not None:
            found[k] = replace(found[k], warnings=found[k].warnings + notes)
    return [(f, describe_frame(frames, k, path.gaps[k])) for k, f in enumerate(found)]


def check_odometry(frames: Sequence[Frame], found: Sequence[Result]) -> tuple[str, ...]:
    """Return a warning if the odometry's distances are longer or shorter than those between sure frames.

    The median of the logarithms of the ratios is compared with its deviation and with REPORTED_SCALE.
    """
    pairs = [(f.odometry, r.best_pose) for f, r in zip(frames, found, strict=True) if r.status == LOCALIZED]
    sure = [(odometry, pose) for odometry, pose in pairs if odometry and pose]
    ratios = []
    begin = 0
    for k in range(len(sure)):
        walked = sure[k][0].distance(sure[begin][0])
        if walked >= LEAST_WALKED:
            ratios.append(math.log(walked / max(sure[k][1].distance(sure[begin][1]), 0.1 * walked)))
            begin = k
    if len(ratios) < LEAST_RATIOS:
        return ()
    middle = float(np.median(ratios))
    std = 1.4826 * float(np.median(np.abs(np.array(ratios) - middle))) / math.sqrt(len(ratios))
    if abs(middle) < max(REPORTED_SCALE, MOST_CONFLICT * std):
        return ()
    percent = 100.0 * abs(math.expm1(middle))
    return (f"`odometry`: it is {percent:.0f} % too {'long' if middle > 0.0 else 'short'}",)


def describe_frame(frames: Sequence[Frame], k: int, gap: Gap | None) -> WalkFrame:
    """Return a frame's place in the walk, after a gap if there is one."""
    frame = frames[k]
    own = frame.alone
    alone = Alone(own.status, own.confidence, own.best_pose) if own else None
    return WalkFrame(frame.time, k, frame.how, alone, gap)


def make_localization(tracker: Tracker, frame: Frame, ranked: Ranked) -> Result:
    """Make a frame's result from its poses and the probabilities that the walk gives them."""
    if not ranked.states:
        found = frame.alone or nothing_found()
        is_beyond = found.status == LOCALIZED  # it is beyond reach of the others, and contradicts them
        least = tracker.settings.min_confidence
        return found.take_belief(found.belief.scale(EVEN), least) if is_beyond else found
    best, *others = ranked.states
    others = others[:MAX_ALTERNATIVES]
    scan_map = tracker.scan_map
    is_own = best.is_refined and best.end is None  # then the pose is that of its own search
    own = frame.alone if is_own and frame.alone else nothing_found()
    contradicted = contradictions(scan_map, best.pose, tracker.settings.prior)
    within = tracker.settings.accuracy.probability(best.gaussian)
    belief = make_belief(ranked.probabilities[: 1 + len(others)], within)
    described = Result(
        best_pose=scan_map.to_world(best.pose),
        loss=own.loss,
        evidence=own.evidence,
        alternatives=tuple(Alternative(scan_map.to_world(s.pose), s.score or 0.0) for s in others),
        covariance=describe_errors(best.gaussian, scan_map.R_map_from_world.T),
        warnings=tuple(map(explain, contradicted)),
        gaussian=best.gaussian,
    )
    belief = belief.rule_out(*(c.reason for c in contradicted))
    return described.take_belief(belief, tracker.settings.min_confidence)


def smooth_positions(
    located: Sequence[PoseGaussian], times: Sequence[float], max_acceleration: float, max_speed: float
) -> list[PoseGaussian]:
    """Smooth the positions of a walking camera by small accelerations; return poses and covariances.

    Minimizes sum (x_k - z_k)' C_k^-1 (x_k - z_k) + sum |a_k|^2 / s^2 over the positions x_k, where a_k is the
    second difference by time of three consecutive frames and s its deviation `max_acceleration` [m/s^2].
    Rotations follow their positions by each frame's own covariance. Errors that all frames have in common are
    not smoothed. Frames so far apart in time that a camera at `max_speed` [m/s] can stop and turn back
    between them do not constrain each other.
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
    # in a longer time than this, a person can stop and walk back
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
