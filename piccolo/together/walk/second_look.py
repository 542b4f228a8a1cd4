"""A second look at the frames of a walk, when all of them are known.

Likely places are refined, and frames are tracked at the places through which the path leads. Frames that are
not sure are searched near frames that are, and some of them in the whole scan, each by itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby, islice

import numpy as np

from ...geometry.pose import Pose, carry
from ...problem.accuracy import Demand
from ...problem.problem import Problem
from ...system.arguments import MIN_CONFIDENCE
from ...system.jobs.threads import Progress, one_blas_thread
from .expectation import ExpectedFrame, Followed
from .following import find_near, refine_state
from .frames import Frame
from .path import EVEN, Path, Ranked, believe, build_lattice
from .tracker import Tracker

MOST_SEARCHED = 12  # chosen: frames of a run that are searched by themselves, each as costly as a photo alone
Find = Callable[[Problem], Followed | None]


@one_blas_thread()
def finish_path(tracker: Tracker, show: Progress) -> tuple[Path, list[Ranked]]:
    """Find the path of all frames of a tracker, and the probable poses of each frame.

    The likely places of key frames are refined, frames that were tracked at another place than the path's are
    tracked again, and lost frames are searched near sure ones.
    """
    path, beliefs = _settle(tracker, show)
    if _search_unsure(tracker, beliefs, show):
        path, beliefs = _settle(tracker, show)
    return path, beliefs


def _settle(tracker: Tracker, show: Progress) -> tuple[Path, list[Ranked]]:
    """Refine and track frames where the path leads; return the path, and the probable poses of each frame."""
    num = len(tracker.frames)
    path = _refine_likely(tracker, show)
    beliefs = [believe(tracker.frames, path, k) for k in range(num)]
    both_ways = [*range(num)[::-1], *range(num)]  # a frame that is confirmed may confirm the next
    asked: dict[int, list[Pose]] = {}
    for k in show(iter(both_ways), len(both_ways), "look for lost frames"):
        near = [beliefs[m].states[0].pose for side in _list_sure(tracker.frames, beliefs, k) for m in side]
        if near != asked.get(k):
            _find_lost(tracker, path, beliefs, k)
            asked[k] = near
    path = _refine_likely(tracker, show)
    return path, [believe(tracker.frames, path, k) for k in range(num)]


def _search_unsure(tracker: Tracker, beliefs: Sequence[Ranked], show: Progress) -> bool:
    """Search the frames that the walk leaves unsure, each by itself; return True if any is found.

    A pose beyond reach of sure frames does not count. A frame that had a pose keeps it, unless the photo is
    sure of the new one by itself.
    """
    asked = list_unsure(tracker.frames, beliefs, tracker.settings.demand)
    is_any_found = False
    for k in show(iter(asked), len(asked), "search"):
        problem = tracker.problem_of(k)
        if problem is None:
            continue
        frame = tracker.frames[k]
        searched = replace(frame)
        tracker.search(problem, searched)
        is_better = searched.is_key and (searched.is_localized_alone or not frame.states)
        if is_better and _is_walked(tracker, beliefs, k, searched.states[0].pose):
            tracker.frames[k] = searched
            is_any_found = True
        frame.alone = searched.alone
    return is_any_found


def list_unsure(frames: Sequence[Frame], beliefs: Sequence[Ranked], demand: Demand) -> list[int]:
    """List frames that are not localized, and were not searched by themselves.

    Of each run of such frames only some are listed, evenly spread: from each that is found, the frames around
    it are tracked.
    """
    is_unsure = [
        frame.alone is None and not belief.is_enough(demand)
        for frame, belief in zip(frames, beliefs, strict=True)
    ]
    listed: list[int] = []
    for is_asked, run in groupby(range(len(frames)), key=lambda k: is_unsure[k]):
        numbers = list(run)
        step = -(-len(numbers) // MOST_SEARCHED)
        listed += numbers[step // 2 :: step] if is_asked else []
    return listed


def _refine_likely(tracker: Tracker, show: Progress) -> Path:
    """Refine the likely places of all key frames, until the path needs no others; return it."""
    space = tracker.lattice.space
    lattice = build_lattice(tracker.frames, space, tracker.motion)
    path = lattice.smooth()
    while rough := [k for k in range(len(tracker.frames)) if _list_rough(tracker, path, k)]:
        for k in show(iter(rough), len(rough), "refine"):
            _refine(tracker, path, k)
        lattice = build_lattice(tracker.frames, space, tracker.motion, lattice)
        path = lattice.smooth()
    return path


def _list_rough(tracker: Tracker, path: Path, k: int) -> list[int]:
    """List the rough states of a frame that are likely, or that together may make the best unsure."""
    found = path.probabilities[k]
    states = tracker.frames[k].states if len(found) else []
    rough = sorted((j for j, state in enumerate(states) if not state.is_refined), key=lambda j: -found[j])
    left = np.cumsum(found[rough][::-1])[::-1]  # of each state and all that are less likely
    limit = 1.0 - MIN_CONFIDENCE  # if all the rest have less, the best stays sure
    return [
        j
        for j, total in zip(rough, left, strict=True)
        if found[j] > limit or j == path.choose(k) or (total > limit and found.max() > EVEN)
    ]


def _refine(tracker: Tracker, path: Path, k: int) -> None:
    """Refine the likely places of a key frame."""
    frame = tracker.frames[k]
    problem = tracker.problem_of(k)
    for rough in [frame.states[j] for j in _list_rough(tracker, path, k)]:
        if problem is None:
            frame.states = [state for state in frame.states if state is not rough]
        else:
            frame.states = refine_state(problem, frame.states, rough, tracker.workers)


def _find_lost(tracker: Tracker, path: Path, beliefs: list[Ranked], k: int) -> None:
    """Track a frame that is not sure from where it is expected, or search it near sure ones."""
    frames = tracker.frames
    accuracy = tracker.settings.accuracy
    ways = _list_ways(tracker, beliefs, k)
    problem = tracker.problem_of(k) if ways else None
    if problem is None:
        return
    for begin, find in ways:
        found = find(problem)
        if found is None or not _is_walked(tracker, beliefs, k, found.state.pose):
            continue
        if found.is_alone or found.how == "tracked":
            before = frames[k]
            _hang(frames, path, k, begin, found)
            belief = believe(frames, path, k)
            if belief.confidence(accuracy) < beliefs[k].confidence(accuracy):
                frames[k] = before
                continue
            beliefs[k] = belief
            return


def _is_walked(tracker: Tracker, beliefs: Sequence[Ranked], k: int, pose: Pose) -> bool:
    """Return True if a frame's pose is within reach of the nearest sure frames."""
    frames = tracker.frames
    nearest = [side[0] for side in _list_sure(frames, beliefs, k)]
    reaches = [tracker.motion.reach(frames[k].time - frames[m].time) for m in nearest]
    distances = [pose.distance(beliefs[m].states[0].pose) for m in nearest]
    return all(d <= reach for d, reach in zip(distances, reaches, strict=True))


def _list_ways(tracker: Tracker, beliefs: Sequence[Ranked], k: int) -> list[tuple[int, Find]]:
    """List the frames from which a frame may be found, and how."""
    frame = tracker.frames[k]
    belief = beliefs[k]
    ways: list[tuple[int, Find]] = []
    if frame.key is not None and belief.expected is not None:
        expected = ExpectedFrame(belief.expected, tracker.motion.reach(0.0), belief.expected)
        ways = [(frame.key, partial(find_near, expected=expected, means=tracker.means))]
    is_unsure = not (belief.is_enough(tracker.settings.demand) and belief.is_confirmed)
    is_kept = frame.is_key and belief.is_sure
    if is_unsure and not is_kept and (sides := _list_sure(tracker.frames, beliefs, k)):
        nearest = [side[0] for side in sides] if len(sides) > 1 else sides[0]
        near = [(m, beliefs[m].states[0].pose) for m in nearest]
        ways.append((sides[0][0], partial(tracker.find, frame=frame, near=near)))
    return ways


def _list_sure(frames: Sequence[Frame], beliefs: Sequence[Ranked], k: int) -> list[list[int]]:
    """List the two nearest sure frames after and before a frame, the side that is nearer in time first."""
    ways = range(k + 1, len(frames)), range(k - 1, -1, -1)
    sides = [list(islice((m for m in way if beliefs[m].is_sure), 2)) for way in ways]
    return sorted(filter(None, sides), key=lambda side: abs(frames[side[0]].time - frames[k].time))


def _hang(frames: list[Frame], path: Path, k: int, sure: int, found: Followed) -> None:
    """Give a frame the pose that was found from a sure frame, whose key frame is then its key frame too."""
    key = sure if frames[sure].is_key else frames[sure].key
    chosen = None if key is None else path.choose(key)
    if key is None or chosen is None:
        return
    at_key = frames[key].states[chosen].pose
    departed = frames[key].departed = frames[key].departed or at_key
    arrived = carry(found.state.pose, at_key, departed)
    frames[k] = replace(
        frames[k], states=[found.state], how=found.how, is_key=False, key=key, arrived=arrived, departed=None
    )
