"""A walk as a whole: frames followed in time, those that were lost looked for again, then all together."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..coarse_to_fine.first_look import CLEAR_SCORE
from ..coarse_to_fine.localize import localize
from ..coarse_to_fine.query import prepare_query
from ..confidence.alternatives import MAX_ALTERNATIVES
from ..confidence.confidence import NOT_LOCALIZED, classify
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import MAX_DISTANCE, Array, Pose
from ..panorama import Panorama
from ..runtime.stopwatch import Stopwatch
from .frames import Frame, State, states_of
from .path import REACH_SLACK, Path, lattice_of
from .smoothing import smoothed
from .tracker import MAX_RADIUS, Follower, Tracker, follow, least_score
from .tracking import beside, found_near, states_at

MAX_SWEEPS = 4
FARTHEST = 12  # frames from one that is sure, in which lost ones are looked for
SURE = 0.5

Read = Callable[[int], Panorama | None]  # the picture of a frame; None if it can't be read


@dataclass(frozen=True)
class Gap:
    """A part of a walk that no walking person can have gone: a lift, a cut, a camera in a pocket."""

    distance: float  # [m]
    seconds: float


@dataclass(frozen=True)
class Alone:
    """What a frame is without regard to the others."""

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


def finished(tracker: Tracker, read: Read) -> Path:
    """The path of all frames that a tracker has followed; lost ones are looked for from their neighbours."""
    path = tracker.lattice.smoothed()
    tried: set[tuple[int, int]] = set()
    for _ in range(MAX_SWEEPS):
        num_found = 0
        for step in (-1, 1):
            for k in range(len(tracker.frames))[::step]:
                follower = _follower_of_lost(tracker, path, k, step, tried)
                panorama = read(k) if follower else None
                if follower and panorama is not None and panorama.is_valid.any():
                    num_found += _found_again(tracker, k, follower, panorama)
            path = lattice_of(tracker.frames, tracker.lattice.space, tracker.motion).smoothed()
        if num_found == 0:
            break
    return path


def _follower_of_lost(
    tracker: Tracker, path: Path, k: int, step: int, tried: set[tuple[int, int]]
) -> Follower | None:
    """Whence a frame that has no pose on the path is looked for: from the nearest that is sure, once."""
    chosen, frames = path.chosen[k], tracker.frames
    if chosen is not None and path.probabilities[k][chosen] > SURE:
        return None
    near = range(k - step, k - step * (FARTHEST + 1), -step)
    sure = next((m for m in near if _is_sure(tracker, path, m)), None)
    if sure is None or (k, sure) in tried:
        return None
    tried.add((k, sure))
    follower = _follower(tracker, path, sure, step)
    is_there = any(_is_within(tracker, follower, state, frames[k].time) for state in frames[k].states)
    return None if is_there else follower


def _found_again(tracker: Tracker, k: int, follower: Follower, panorama: Panorama) -> bool:
    """True if a frame has got a pose more, near where a follower leads."""
    frame = tracker.frames[k]
    query = prepare_query(panorama, tracker.scan_map, tracker.settings, tracker.workers)
    end = follow(query, follower, frame.time, tracker.motion)
    is_there = end.score >= least_score(follower)
    found = [end] if is_there else []
    radius = tracker.motion.max_speed * abs(frame.time - follower.time) + REACH_SLACK
    if not found and radius <= MAX_RADIUS:
        found = found_near(query, tracker.scan_map, follower.state.pose, radius, CLEAR_SCORE)
    if not found and not frame.states and radius <= MAX_RADIUS:
        return _searched_near(tracker, frame, follower, radius, panorama)
    if found and frame.states:
        more = beside(query, frame.states, found[0])
        frame.states += [] if more is None else [more]
        return more is not None
    if found:
        frame.states, frame.how = states_at(query, found), "tracked" if is_there else "near"
    return len(found) > 0


def _searched_near(
    tracker: Tracker, frame: Frame, follower: Follower, radius: float, panorama: Panorama
) -> bool:
    """True if a frame is found near a pose by all means, local features too."""
    x, y, z = (float(v) for v in tracker.scan_map.to_world(follower.state.pose).center_world)
    near = replace(tracker.settings.prior, near_world=(x, y, z), radius=radius)
    settings = replace(tracker.settings, prior=near)
    found = localize(tracker.scan_map, panorama, settings, tracker.workers, Stopwatch())
    if found.status == NOT_LOCALIZED:
        return False
    frame.states, frame.how = states_of(tracker.scan_map, found), "near"
    return True


def _is_sure(tracker: Tracker, path: Path, m: int) -> bool:
    """True for a frame whose pose the path knows, or that has just been found."""
    if not 0 <= m < len(tracker.frames) or not tracker.frames[m].states:
        return False
    chosen = path.chosen[m]
    if chosen is None or len(path.probabilities[m]) != len(tracker.frames[m].states):
        return len(path.probabilities[m]) != len(tracker.frames[m].states)
    return bool(path.probabilities[m][chosen] > SURE)


def _state_on(tracker: Tracker, path: Path, m: int) -> State:
    """The state of a sure frame: on the path, or what was found last."""
    states, chosen = tracker.frames[m].states, path.chosen[m]
    is_old = chosen is not None and len(path.probabilities[m]) == len(states)
    return states[chosen] if is_old and chosen is not None else states[-1]


def _follower(tracker: Tracker, path: Path, m: int, step: int) -> Follower:
    """The pose of a sure frame, and of the one before it in the direction of the sweep."""
    state, other = _state_on(tracker, path, m), m - step
    if _is_sure(tracker, path, other):
        earlier = _state_on(tracker, path, other)
        follower = Follower(state, tracker.frames[m].time, earlier.pose, tracker.frames[other].time)
        if _is_within(tracker, follower, earlier, tracker.frames[other].time):
            return follower
    return Follower(state, tracker.frames[m].time, None, 0.0)


def _is_within(tracker: Tracker, f: Follower, state: State, time: float) -> bool:
    """True for a state that a person can walk to."""
    reach = tracker.motion.max_speed * abs(time - f.time) + REACH_SLACK
    ends = state.pose.center_world[None]
    return bool(tracker.lattice.space.distance(f.state.pose.center_world, ends, 2.0 * reach)[0] <= reach)


def localizations_of(tracker: Tracker, path: Path) -> list[tuple[Localization, WalkFrame]]:
    """What a walk makes of each of its frames, poses smoothed together."""
    found = [
        localization_of(tracker, frame, probabilities, chosen)
        for frame, probabilities, chosen in zip(tracker.frames, path.probabilities, path.chosen, strict=True)
    ]
    sure = [k for k, f in enumerate(found) if f.pose is not None and f.covariance is not None and _is_on(f)]
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
    """What a frame is without regard to the others, if it was searched so."""
    a = frame.alone
    return None if a is None else Alone(a.status, a.confidence, a.pose)


def _is_on(found: Localization) -> bool:
    return found.confidence > SURE


def localization_of(tracker: Tracker, frame: Frame, probabilities: Array, chosen: int | None) -> Localization:
    """A frame with the probabilities that a walk gives its poses."""
    if not frame.states:
        return frame.alone or Localization()
    order = sorted(range(len(frame.states)), key=lambda j: (j != chosen, -probabilities[j]))
    best, values = frame.states[order[0]], [float(probabilities[j]) for j in order]
    if best.covariance is not None:
        values[0] *= math.erf(MAX_DISTANCE / (best.covariance.largest_std * math.sqrt(2.0)))
    none = max(1.0 - sum(values), 0.0)
    to_world, alone = tracker.scan_map.to_world, frame.alone
    is_own = alone is not None and alone.pose is not None and order[0] == 0 and frame.how == "alone"
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
        alone.loss if is_own and alone else None,
        alone.evidence if is_own and alone else None,
        others[:MAX_ALTERNATIVES],
        best.covariance,
    )
