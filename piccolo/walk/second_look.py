"""A second search of doubtful frames, when the frames after them are known too."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import LOCALIZED, NOT_LOCALIZED
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Progress, no_progress
from ..localization.localize import localize
from ..localization.query import Query, prepare_query
from ..localization.selection import CLEAR_SCORE
from ..localization.settings import METHOD
from ..panorama import Panorama
from .frames import MAX_STEP, Frame, Motion, State, list_states, state_centers
from .path import REACH_SLACK, Path, build_lattice, group_by_place
from .tracker import (
    MAX_RADIUS,
    Follower,
    Tracker,
    associate,
    find_near,
    follow,
    follow_all,
    is_same,
    least_score,
    make_states,
)

MAX_SWEEPS = 4
FARTHEST = 12  # frames from one that is sure, in which lost ones are looked for
SURE = 0.5
CERTAIN = 0.98
LEAST_ODDS = 0.0
MIN_GAIN = 1.1  # of the score, by which a pose replaces one nearby
LEAST_STEP = 0.5  # [m] several photos of one place are no steps
MOST_STEPS = 0.9  # of the steps found: the longest is LONGER than so many of them
LONGER = 1.5
MOST_RIVALS = 4  # places of a frame that are followed to its neighbours

Read = Callable[[int], Panorama | None]  # the picture of a frame; None if it can't be read


@one_blas_thread
def finish(tracker: Tracker, read: Read, show: Progress = no_progress) -> Path:
    """Find the path of all frames of a tracker, and search doubtful and lost ones again.

    If the path is in doubt, each place that a frame may show is searched for in its neighbours too, so that
    no copy loses because it was not listed. Then lost frames are searched for from sure ones.
    """
    num = len(tracker.frames)
    tracker.motion = estimate_motion(tracker)
    path = _path_of(tracker)
    for step in (1, -1):
        unsure = [k for k in range(num)[::step] if not _is_certain(path, k)]
        for k in show(iter(unsure), len(unsure), "look for copies"):
            _complete(tracker, k, step, read)
    path = _path_of(tracker)
    tried: set[tuple[int, int]] = set()
    searched: set[int] = set()
    for _ in range(MAX_SWEEPS):
        num_found = 0
        for step in (-1, 1):
            for k in show(iter(range(num)[::step]), num, "look for lost frames"):
                follower = _follower_of_lost(tracker, path, k, step, tried)
                panorama = read(k) if follower else None
                if follower and panorama is not None and panorama.is_valid.any():
                    num_found += _find_again(tracker, k, follower, panorama, searched)
            path = _path_of(tracker)
        if num_found == 0:
            break
    return path


def estimate_motion(tracker: Tracker) -> Motion:
    """Estimate the motion of the camera, if it is not given, from the frames that are localized alone."""
    motion = tracker.motion
    if motion.is_timed or not motion.is_guess:
        return motion
    alone = [f.alone.pose if f.alone and f.alone.status == LOCALIZED else None for f in tracker.frames]
    pairs = [(a.center_world, b.center_world) for a, b in pairwise(alone) if a is not None and b is not None]
    steps = [step for a, b in pairs if (step := float(np.linalg.norm(b - a))) >= LEAST_STEP]
    longest = LONGER * float(np.quantile(steps, MOST_STEPS, method="higher")) if steps else 0.0
    return replace(motion, max_speed=max(MAX_STEP, longest), is_guess=False)


def _path_of(tracker: Tracker) -> Path:
    return build_lattice(tracker.frames, tracker.lattice.space, tracker.motion).smooth()


def _is_certain(path: Path, k: int) -> bool:
    """Return True if a frame's pose is certain on the path."""
    chosen = path.chosen[k]
    return chosen is not None and bool(path.probabilities[k][chosen] > CERTAIN)


def _complete(tracker: Tracker, k: int, step: int, read: Read) -> None:
    """Add to a frame the reachable places of the frame a step before it that it lacks."""
    frame = tracker.frames[k]
    if not frame.states or not 0 <= k - step < len(tracker.frames):
        return
    missing = [f for f in _rivals(tracker, k - step) if not _is_reached(tracker, f, k)]
    panorama = read(k) if missing else None
    if panorama is None:
        return
    query = tracker.prepare(panorama)
    for follower, end in zip(missing, follow_all(query, missing, frame.time, tracker.motion), strict=True):
        more = associate(query, frame.states, end)
        if more is not None and _is_within(tracker, follower, more, frame.time):
            frame.states.append(more)


def _rivals(tracker: Tracker, m: int) -> list[Follower]:
    """Return the likelier poses of a frame, one a place; empty if there is only one."""
    likely = tracker.frames[m].likely
    if len(likely) < 2:
        return []
    odds = np.array([state.log_odds for state in likely])
    places = {int(j) for j in group_by_place(odds, state_centers(likely))}
    leaders = sorted(places, key=lambda j: (-odds[j], j))[:MOST_RIVALS]
    return [Follower(likely[j], tracker.frames[m].time) for j in leaders] if len(leaders) > 1 else []


def _is_reached(tracker: Tracker, f: Follower, k: int, least_odds: float = -math.inf) -> bool:
    """Return True if a frame has a pose above the log odds within walking distance."""
    frame = tracker.frames[k]
    states = [state for state in frame.states if state.log_odds > least_odds]
    return any(_is_within(tracker, f, state, frame.time) for state in states)


def _follower_of_lost(
    tracker: Tracker, path: Path, k: int, step: int, tried: set[tuple[int, int]]
) -> Follower | None:
    """Return the nearest sure pose from which to search for a lost frame, each pair of frames once."""
    chosen = path.chosen[k]
    if chosen is not None and path.probabilities[k][chosen] > SURE:
        return None
    near = range(k - step, k - step * (FARTHEST + 1), -step)
    sure = next((m for m in near if _is_sure(tracker, path, m)), None)
    if sure is None or (k, sure) in tried:
        return None
    tried.add((k, sure))
    follower = _make_follower(tracker, path, sure, step)
    return None if _is_reached(tracker, follower, k, LEAST_ODDS) else follower


def _find_again(tracker: Tracker, k: int, follower: Follower, panorama: Panorama, searched: set[int]) -> bool:
    """Search for a frame near a follower, by features only once; return True if it gains a pose."""
    frame = tracker.frames[k]
    query = prepare_query(panorama, tracker.scan_map, tracker.settings, tracker.workers)
    end = follow(query, follower, frame.time, tracker.motion)
    is_there = end.score >= least_score(follower)
    found = [end] if is_there else []
    radius = tracker.motion.max_speed * abs(frame.time - follower.time) + REACH_SLACK
    if not found and radius <= MAX_RADIUS:
        found = find_near(query, follower.state.pose, radius, CLEAR_SCORE)
    if not found and not frame.states and radius <= MAX_RADIUS and k not in searched:
        searched.add(k)
        return _search_near(tracker, frame, follower, radius, panorama)
    if found and frame.states:
        return _join(query, frame, found[0])
    if found:
        frame.put(make_states(query, found), "tracked" if is_there else "near")
    return len(found) > 0


def _join(query: Query, frame: Frame, found: Hypothesis) -> bool:
    """Add a pose to a frame, or replace a worse one nearby; return True if the frame has changed."""
    for j, state in enumerate(frame.states):
        if is_same(state.pose, found.pose) and found.score > MIN_GAIN * state.score:
            frame.states[j] = make_states(query, [found])[0]
            return True
    more = associate(query, frame.states, found)
    frame.states += [] if more is None else [more]
    return more is not None


def _search_near(
    tracker: Tracker, frame: Frame, follower: Follower, radius: float, panorama: Panorama
) -> bool:
    """Search for a frame near a pose by local features; return True if it is found."""
    x, y, z = (float(v) for v in tracker.scan_map.to_world(follower.state.pose).center_world)
    near = replace(tracker.settings.prior, near_world=(x, y, z), radius=radius)
    settings = replace(tracker.settings, prior=near)
    method = METHOD._replace(uses_search=False)
    found = localize(tracker.scan_map, panorama, settings, tracker.workers, Stopwatch(), method)
    if found.status == NOT_LOCALIZED:
        return False
    frame.put(list_states(tracker.scan_map, found), "near")
    return True


def _is_sure(tracker: Tracker, path: Path, m: int) -> bool:
    """Return True for a frame with a sure pose on the path, or found since the path was made."""
    if not 0 <= m < len(tracker.frames) or not tracker.frames[m].states:
        return False
    chosen = path.chosen[m]
    if chosen is None or len(path.probabilities[m]) != len(tracker.frames[m].states):
        return len(path.probabilities[m]) != len(tracker.frames[m].states)
    return bool(path.probabilities[m][chosen] > SURE)


def _state_on(tracker: Tracker, path: Path, m: int) -> State:
    """Return the state of a sure frame: on the path, or the last one found."""
    states = tracker.frames[m].states
    chosen = path.chosen[m]
    is_old = chosen is not None and len(path.probabilities[m]) == len(states)
    return states[chosen] if is_old and chosen is not None else states[-1]


def _make_follower(tracker: Tracker, path: Path, m: int, step: int) -> Follower:
    """Make a follower from a sure frame and the one before it in the direction of the sweep."""
    state = _state_on(tracker, path, m)
    other = m - step
    if _is_sure(tracker, path, other):
        earlier = _state_on(tracker, path, other)
        follower = Follower(state, tracker.frames[m].time, earlier.pose, tracker.frames[other].time)
        if _is_within(tracker, follower, earlier, tracker.frames[other].time):
            return follower
    return Follower(state, tracker.frames[m].time)


def _is_within(tracker: Tracker, f: Follower, state: State, time: float) -> bool:
    """Return True if a person can walk to a state."""
    reach = tracker.motion.max_speed * abs(time - f.time) + REACH_SLACK
    ends = state.pose.center_world[None]
    return bool(tracker.lattice.space.distance(f.state.pose.center_world, ends, 2.0 * reach)[0] <= reach)
