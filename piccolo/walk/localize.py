"""The results of a walk's frames."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES
from ..confidence.confidence import classify
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import MAX_DISTANCE, Array, Pose
from .frames import Frame
from .path import Path
from .smoothing import smoothed
from .tracker import Tracker

SURE = 0.5  # frames with less are not smoothed with the others


@dataclass(frozen=True)
class Gap:
    """A part of a walk that no walking person can have gone: a lift, a cut, a camera in a pocket."""

    distance: float  # [m]
    seconds: float


@dataclass(frozen=True)
class Alone:
    """The result of a frame without regard to the others."""

    status: str
    confidence: float
    pose: Pose | None  # in the world


@dataclass(frozen=True)
class WalkFrame:
    """A frame as a walk has it."""

    time: float  # [s] from the walk's beginning; of frames without times their number
    frame: int  # from 0
    how: str  # where its pose comes from: "alone", "tracked", "near", or "none"
    alone: Alone | None  # if it was searched without regard to the others
    gap: Gap | None  # before it


def localizations_of(tracker: Tracker, path: Path) -> list[tuple[Localization, WalkFrame]]:
    """Return the result of each frame of a walk, poses smoothed together."""
    found = [
        localization_of(tracker, frame, probabilities, chosen)
        for frame, probabilities, chosen in zip(tracker.frames, path.probabilities, path.chosen, strict=True)
    ]
    sure = [k for k, f in enumerate(found) if f.pose and f.covariance and f.confidence > SURE]
    located = [(f.pose, f.covariance) for k in sure if (f := found[k]).pose and f.covariance]
    begins = [0, *(n for n, k in enumerate(sure) if n and path.gaps[k]), len(sure)]
    for lo, hi in pairwise(begins):
        times = [tracker.frames[k].time for k in sure[lo:hi]]
        parts = smoothed(located[lo:hi], times, tracker.motion)
        for k, (pose, covariance) in zip(sure[lo:hi], parts, strict=True):
            found[k] = replace(found[k], pose=pose, covariance=covariance)
    return [
        (f, WalkFrame(frame.time, k, frame.how, alone_of(frame), Gap(*gap) if gap else None))
        for k, (f, frame, gap) in enumerate(zip(found, tracker.frames, path.gaps, strict=True))
    ]


def alone_of(frame: Frame) -> Alone | None:
    """Return a frame's result without regard to the others, if it was searched so."""
    a = frame.alone
    return None if a is None else Alone(a.status, a.confidence, a.pose)


def accuracy_of(frame: Frame) -> float:
    """Probability that a frame has come to the very pose, if it is at the place where the walk has it.

    The frames around tell the place of one that is blurred or dark, but not where in it.
    """
    return 1.0 / (1.0 + math.exp(-frame.log_odds))


def localization_of(tracker: Tracker, frame: Frame, probabilities: Array, chosen: int | None) -> Localization:
    """A frame with the probabilities that a walk gives its poses."""
    if not frame.states:
        return frame.alone or Localization()
    order = sorted(range(len(frame.states)), key=lambda j: (j != chosen, -probabilities[j]))
    best = frame.states[order[0]]
    values = [float(probabilities[j]) for j in order]
    if best.covariance is not None:
        values[0] *= math.erf(MAX_DISTANCE / (best.covariance.largest_std * math.sqrt(2.0)))
    values[0] *= accuracy_of(frame)
    none = max(1.0 - sum(values), 0.0)
    to_world = tracker.scan_map.to_world
    is_own = frame.alone and frame.alone.pose is not None and order[0] == 0 and frame.how == "alone"
    own = frame.alone if is_own and frame.alone else Localization()
    status = classify(np.array([*values, none]), tracker.settings.min_confidence)
    others = tuple(
        Alternative(to_world(s.pose), s.score, None, s.num_matches, p)
        for s, p in zip([frame.states[j] for j in order[1:]], values[1:], strict=True)
    )
    return Localization(
        status,
        values[0],
        none,
        to_world(best.pose),
        own.loss,
        own.evidence,
        others[:MAX_ALTERNATIVES],
        best.covariance,
    )
