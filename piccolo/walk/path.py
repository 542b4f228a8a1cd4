"""The way through the poses of a walk's frames: a hidden Markov model, with frames that have no right pose.

A state is a pose of a frame; a frame may have none, and the way goes on from an earlier one. Viterbi (1967)
finds the likeliest way, forward-backward (Rabiner 1989) the probability of each pose. Frames of one place
err alike: what they say of one pose against another counts only as far as the camera has moved on, and only
beyond what exact copies of a room say against each other.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from .frames import MOST_ODDS, Frame, Motion, centers_of
from .free_space import FreeSpace

COPY_LOG_ODDS = 5.0  # copies of a place differ by as much where one of them was scanned better
SAME_PLACE = 1.5  # [m] poses nearer to each other are of one place, not of copies
TELLING_DISTANCE = 2.0  # [m] after which a frame says something new of its place
REACH_SLACK, REACH_SIGMA = 0.3, 0.25  # [m] beyond what a person walks; deviation of more
GAP_LOG = -9.0  # a jump to any place: lift, cut, pocket
MAX_SKIPPED = 25.0  # [log] frames that speak for their poses by more in all are not passed over
LONGEST_SKIP = 400  # frames


class Path(NamedTuple):
    """What the walk makes of its frames."""

    chosen: list[int | None]  # the state of each frame on the likeliest way; None for no pose
    probabilities: list[Array]  # (S,) of each frame's states
    gaps: list[tuple[float, float] | None]  # [m], [s] before a frame that no walking person reaches


def emissions(frames: Sequence[Frame]) -> list[Array]:
    """Log odds (S,) of each frame's states against none, as far as they tell something new."""
    found: list[Array] = []
    last: Array | None = None
    for frame in frames:
        odds, here = np.array([state.log_odds for state in frame.states]), centers_of(frame.states)
        if len(odds) == 0:
            found.append(odds)
            continue
        moved = TELLING_DISTANCE
        if last is not None:
            moved = float(np.linalg.norm(here[:, None] - last[None], axis=2).min())
        last, share = here, min(moved / TELLING_DISTANCE, 1.0)
        total = np.clip(np.logaddexp.reduce(odds), -MOST_ODDS, MOST_ODDS)
        of_place = odds[places_of(odds, here)]
        behind = -share * np.maximum(odds.max() - of_place - COPY_LOG_ODDS, 0.0) - (of_place - odds)
        found.append(total + behind - np.logaddexp.reduce(behind))
    return found


def places_of(odds: Array, centers: Array) -> NDArray[np.int64]:
    """Index (S,) of the likeliest pose in the place of each pose (S, 3) [m], by their log odds (S,)."""
    leaders: list[int] = []
    place = np.empty(len(odds), np.int64)
    for j in np.argsort(-odds, kind="stable"):
        here = [i for i in leaders if np.linalg.norm(centers[i] - centers[j]) < SAME_PLACE]
        leaders += [] if here else [int(j)]
        place[j] = here[0] if here else j
    return place


def log_transition(distance: Array, seconds: float, motion: Motion) -> Array:
    """Log probability (N,) that a camera has gone so far [m] in so many seconds, but for a constant."""
    excess = np.maximum(distance - motion.max_speed * seconds - REACH_SLACK, 0.0)
    return np.maximum(-0.5 * (excess / REACH_SIGMA) ** 2, GAP_LOG)


class _Steps(NamedTuple):
    """From a frame's states to those of a later one."""

    begin: int
    log: NDArray[np.float64]  # (S before, S)


class Lattice:
    """The frames so far, with the logs of all ways that lead to each state; grows frame by frame."""

    def __init__(self, space: FreeSpace, motion: Motion) -> None:
        self.space, self.motion = space, motion
        self.frames: list[Frame] = []
        self.emitted: list[Array] = []
        self.steps: list[list[_Steps]] = []
        self.forward: list[Array] = []  # sums over ways, emissions included
        self.best: list[Array] = []  # of the best way
        self.back: list[list[tuple[int, int] | None]] = []

    def add(self, frame: Frame) -> None:
        """The next frame in time."""
        self.frames.append(frame)
        self.emitted = emissions(self.frames) if len(self.frames) < 2 else [*self.emitted, self._emission()]
        k = len(self.frames) - 1
        steps = self._steps_to(k)
        self.steps.append(steps)
        num = len(frame.states)
        sums, best = np.zeros(num), np.zeros(num)  # the way begins here
        back: list[tuple[int, int] | None] = [None] * num
        for s in steps:
            sums = np.logaddexp(sums, np.logaddexp.reduce(self.forward[s.begin][:, None] + s.log, axis=0))
            ways = self.best[s.begin][:, None] + s.log
            for j in range(num):
                i = int(ways[:, j].argmax())
                if ways[i, j] > best[j]:
                    best[j], back[j] = ways[i, j], (s.begin, i)
        self.forward.append(sums + self.emitted[k])
        self.best.append(best + self.emitted[k])
        self.back.append(back)

    def _emission(self) -> Array:
        """Of the last frame."""
        before = next((f for f in reversed(self.frames[:-1]) if f.states), None)
        return emissions([before, self.frames[-1]] if before else self.frames[-1:])[-1]

    def _steps_to(self, k: int) -> list[_Steps]:
        """Steps from all earlier frames from which the way may lead to a frame."""
        ends, steps, passed = centers_of(self.frames[k].states), list[_Steps](), 0.0
        if len(ends) == 0:
            return []
        for m in range(k - 1, max(k - 1 - LONGEST_SKIP, -1), -1):
            frame = self.frames[m]
            if not frame.states:
                continue
            seconds = self.frames[k].time - frame.time
            limit = self.motion.max_speed * seconds + REACH_SLACK + 5.0 * REACH_SIGMA
            distances = [self.space.distance(c, ends, limit) for c in centers_of(frame.states)]
            steps.append(_Steps(m, log_transition(np.array(distances), seconds, self.motion)))
            passed += max(float(np.logaddexp.reduce(self.emitted[m])), 0.0)
            if passed > MAX_SKIPPED:
                break
        return steps

    def filtered(self) -> Array:
        """Probability (S,) of each state of the last frame by all that was before."""
        ends = [0.0, *(float(np.logaddexp.reduce(f)) for f in self.forward if len(f))]
        return np.asarray(np.exp(self.forward[-1] - np.logaddexp.reduce(ends)))

    def smoothed(self) -> Path:
        """The likeliest way, and the probability of each state by all frames."""
        backward = [np.zeros(len(f.states)) for f in self.frames]
        for k in range(len(self.frames) - 1, -1, -1):
            for s in self.steps[k]:
                onward = s.log + (self.emitted[k] + backward[k])[None]
                backward[s.begin] = np.logaddexp(backward[s.begin], np.logaddexp.reduce(onward, axis=1))
        total = np.logaddexp.reduce([0.0, *(float(np.logaddexp.reduce(f)) for f in self.forward if len(f))])
        probabilities = [np.exp(f + b - total) for f, b in zip(self.forward, backward, strict=True)]
        chosen = self._likeliest()
        return Path(chosen, probabilities, self._gaps(chosen))

    def _likeliest(self) -> list[int | None]:
        chosen: list[int | None] = [None] * len(self.frames)
        ends = [(float(b.max()), k, int(b.argmax())) for k, b in enumerate(self.best) if len(b)]
        end = max(ends, default=(-math.inf, 0, 0))
        at = (end[1], end[2]) if end[0] > 0.0 else None
        while at is not None:
            chosen[at[0]] = at[1]
            at = self.back[at[0]][at[1]]
        return chosen

    def _gaps(self, chosen: Sequence[int | None]) -> list[tuple[float, float] | None]:
        gaps: list[tuple[float, float] | None] = [None] * len(self.frames)
        before: tuple[int, int] | None = None
        for k, j in enumerate(chosen):
            if j is None:
                continue
            if before is not None:
                m, i = before
                log = next((s.log[i, j] for s in self.steps[k] if s.begin == m), GAP_LOG)
                if log < GAP_LOG / 2.0:
                    there, here = self.frames[m].states[i].pose, self.frames[k].states[j].pose
                    metres = float(np.linalg.norm(here.center_world - there.center_world))
                    gaps[k] = metres, self.frames[k].time - self.frames[m].time
            before = k, j
        return gaps


def lattice_of(frames: Sequence[Frame], space: FreeSpace, motion: Motion) -> Lattice:
    """The lattice of frames in their order."""
    lattice = Lattice(space, motion)
    for frame in frames:
        lattice.add(frame)
    return lattice
