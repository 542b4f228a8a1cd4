"""The results of a walk's frames: positions smoothed with a constant-acceleration prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES
from ..confidence.confidence import LOCALIZED
from ..confidence.covariance import describe_errors
from ..confidence.focal_length import MOST_CONFLICT
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import probability_within, std_of
from ..localization.judge import decide, take_pose
from ..localization.prior import contradictions
from ..optimize.smoothing import smooth_positions
from .frames import Frame
from .path import EVEN, Belief, Gap, Path
from .tracker import Tracker

LEAST_WALKED = 2.0  # [m] between frames by which an odometry is checked
LEAST_RATIOS = 4  # of distances; fewer say nothing
TOLD_SCALE = 0.03  # error of an odometry's scale that is reported


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
    motion = tracker.motion
    found = [make_localization(tracker, f, belief) for f, belief in zip(frames, beliefs, strict=True)]
    sure = [k for k, f in enumerate(found) if motion.is_timed and f.gaussian and f.confidence > EVEN]
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


def check_odometry(frames: Sequence[Frame], found: Sequence[Localization]) -> tuple[str, ...]:
    """Return a warning if the sure frames say that the odometry is too long or too short.

    Of the logarithms of ratios of distances the median counts, and their median deviation from it.
    """
    pairs = [(f.odometry, r.pose) for f, r in zip(frames, found, strict=True) if r.status == LOCALIZED]
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
    if abs(middle) < max(TOLD_SCALE, MOST_CONFLICT * std):
        return ()
    percent = 100.0 * abs(math.expm1(middle))
    return (f"`odometry`: it is {percent:.0f} % too {'long' if middle > 0.0 else 'short'}",)


def describe_frame(frames: Sequence[Frame], k: int, gap: Gap | None) -> WalkFrame:
    """Return a frame's place in the walk, after a gap if there is one."""
    frame = frames[k]
    own = frame.alone
    alone = Alone(own.status, own.confidence, own.pose) if own else None
    return WalkFrame(frame.time, k, frame.how, alone, gap)


def make_localization(tracker: Tracker, frame: Frame, belief: Belief) -> Localization:
    """Make a frame's result from its poses and the probabilities that the walk gives them."""
    if not belief.states:
        return frame.alone or Localization()
    best, *others = belief.states
    scan_map = tracker.scan_map
    within = probability_within(std_of(best.gaussian))
    rest = within * belief.probabilities[1 : 1 + MAX_ALTERNATIVES]
    p = np.array([within * belief.probabilities[0], *rest, 0.0])
    p[-1] = max(1.0 - p.sum(), 0.0)
    is_own = frame.alone and frame.states and best is frame.states[0]
    own = frame.alone if is_own and frame.alone else Localization()
    warnings = contradictions(scan_map, best.pose, tracker.settings.prior)
    alternatives = [Alternative(scan_map.to_world(s.pose), s.score or 0.0) for s in others[:MAX_ALTERNATIVES]]
    described = Localization(
        pose=scan_map.to_world(best.pose),
        loss=own.loss,
        evidence=own.evidence,
        alternatives=tuple(alternatives),
        covariance=describe_errors(best.gaussian, scan_map.R_map_from_world.T),
        warnings=warnings,
        is_ruled_out=bool(warnings),
        gaussian=best.gaussian,
    )
    return decide(described, p, tracker.settings.min_confidence)
