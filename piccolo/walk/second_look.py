"""A second look at a walk's frames, when the frames after them are known too."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

from ..confidence.confidence import MIN_CONFIDENCE
from ..geometry.pose import Pose
from ..jobs.blas import one_blas_thread
from ..jobs.threads import Progress, no_progress
from ..panorama import Panorama
from .beliefs import Belief, believe
from .frames import Frame
from .motion import carry
from .path import Path, build_lattice
from .tracker import Expected, Found, Tracker, expect, find_near, refine_state

Read = Callable[[int], Panorama | None]  # the picture of a frame; None if it can't be read


@one_blas_thread
def finish(tracker: Tracker, read: Read, show: Progress = no_progress) -> tuple[Path, list[Belief]]:
    """Find the path of all frames of a tracker, and what each may be.

    The likely places of key frames are refined, frames that were tracked elsewhere are tracked there, and
    lost ones are looked for from sure ones.
    """
    num = len(tracker.frames)
    path = _refine_likely(tracker, read, show)
    for k in show(iter(range(num)[::-1]), num, "look for lost frames"):
        _find_lost(tracker, path, k, read)
    path = _refine_likely(tracker, read, show)
    return path, [believe(tracker.frames, path, k) for k in range(num)]


def _refine_likely(tracker: Tracker, read: Read, show: Progress) -> Path:
    """Refine the likely places of all key frames, until the path needs no others; return it."""
    space = tracker.lattice.space
    lattice = build_lattice(tracker.frames, space, tracker.motion)
    path = lattice.smooth()
    while rough := [k for k in range(len(tracker.frames)) if _list_rough(tracker, path, k)]:
        for k in show(iter(rough), len(rough), "refine"):
            _refine(tracker, path, k, read)
        lattice = build_lattice(tracker.frames, space, tracker.motion, lattice)
        path = lattice.smooth()
    return path


def _list_rough(tracker: Tracker, path: Path, k: int) -> list[int]:
    """List the likely states of a frame that were not refined."""
    is_likely = path.probabilities[k] > 1.0 - MIN_CONFIDENCE  # less leaves another sure
    return [
        j
        for j, state in enumerate(tracker.frames[k].states)
        if not state.is_refined and len(is_likely) and (is_likely[j] or j == path.choose(k))
    ]


def _refine(tracker: Tracker, path: Path, k: int, read: Read) -> None:
    """Refine the likely places of a key frame."""
    frame = tracker.frames[k]
    panorama = read(k)
    query = None if panorama is None else tracker.prepare(panorama)
    for rough in [frame.states[j] for j in _list_rough(tracker, path, k)]:
        others = [state for state in frame.states if state is not rough]
        frame.states = others if query is None else refine_state(query, frame.states, rough)


def _find_lost(tracker: Tracker, path: Path, k: int, read: Read) -> None:
    """Track a frame that is not sure from where it is to be expected, or look for it near sure ones.

    These are later ones if possible, as the tracker came from earlier ones.
    """
    frame = tracker.frames[k]
    belief = believe(tracker.frames, path, k)
    ways: list[tuple[int, Expected]] = []
    if frame.key is not None and belief.expected is not None:
        reach = tracker.motion.reach(0.0)
        ways = [(frame.key, Expected(belief.expected, reach, belief.expected))]
    if not belief.is_sure and (near := _list_sure(tracker, path, k, 1) or _list_sure(tracker, path, k, -1)):
        poses = [(tracker.frames[m], pose) for m, pose in near]
        ways.append((near[0][0], expect(frame, poses, tracker.motion)))
    panorama = read(k) if ways else None
    if panorama is None or not panorama.is_valid.any():
        return
    query = tracker.prepare(panorama)
    found = ((begin, find_near(query, expected)) for begin, expected in ways)
    begin, end = next(((b, f) for b, f in found if f is not None and f.is_alone), (k, None))
    if end is not None:
        _hang(tracker.frames, path, k, begin, end)


def _list_sure(tracker: Tracker, path: Path, k: int, step: int) -> list[tuple[int, Pose]]:
    """List the nearest two sure frames in one direction, with their poses."""
    numbers = range(k + step, len(tracker.frames) if step > 0 else -1, step)
    beliefs = ((m, believe(tracker.frames, path, m)) for m in numbers)
    return list(islice(((m, belief.states[0].pose) for m, belief in beliefs if belief.is_sure), 2))


def _hang(frames: list[Frame], path: Path, k: int, sure: int, found: Found) -> None:
    """Give a frame a pose beside a sure one, whose key frame is then its key frame too."""
    key = sure if frames[sure].is_key else frames[sure].key
    chosen = None if key is None else path.choose(key)
    if key is None or chosen is None:
        return
    at_key = frames[key].states[chosen].pose
    departed = frames[key].departed = frames[key].departed or at_key
    arrived = carry(found.state.pose, at_key, departed)
    frames[k] = replace(
        frames[k], states=[found.state], how="tracked", is_key=False, key=key, arrived=arrived, departed=None
    )
