"""The path through the poses of a walk's frames: a hidden Markov model, with frames that have no right pose.

A state is a pose of a frame; a frame may have none, and the path goes on from an earlier one. Viterbi (1967)
finds the likeliest path, forward-backward (Rabiner 1989) the probability of each pose. Frames of one place
have correlated errors: differences between poses count in proportion to the distance that the camera has
moved, and only beyond the differences between exact copies of a room.

The camera may also be at a place that no frame lists, such as an unlisted copy: tracking from frame to frame
supports that as well as the listed place. Only a search of the whole scan is evidence against it, and each
search has a limited weight.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from .frames import COPY_LOG_ODDS, MOST_ODDS, OTHER_LOG_ODDS, Frame, Motion, state_centers
from .free_space import FreeSpace

SAME_PLACE = 1.5  # [m] poses nearer to each other are of one place, not of copies
TELLING_DISTANCE = 2.0  # [m] after which a frame is new evidence of its place
REACH_SLACK = 0.3  # [m] beyond what a person walks
REACH_SIGMA = 0.25  # [m] deviation of more
GAP_LOG = -9.0  # a jump to any place: lift, cut, pocket
UNTIMED_GAP_LOG = -4.0  # of frames without times
JUMPED = -2.0  # less is a jump
MOST_EXPECTED = 3.0  # [log] that a pose gains by being where it was to be expected
MAX_SKIPPED = 25.0  # [log] frames whose poses have more odds together are not skipped
LONGEST_SKIP = 400  # frames
TELLING_LOG = 5.0  # evidence of a search of the whole scan against places that it did not list
LEAST_TOLD = 0.3  # fraction of it that another search at the same place adds
LOST_LOG = -3.0  # that a camera is at an unlisted place, if a frame is not where tracking led
FOLLOWED_LOG = -6.0  # that it comes from there to a pose that was tracked from another
UNLISTED = -1  # in place of the number of a state


class Path(NamedTuple):
    """The likeliest path through a walk's frames."""

    chosen: list[int | None]  # the state of each frame on the likeliest way; None for no pose
    probabilities: list[Array]  # (S,) of each frame's states
    gaps: list[tuple[float, float] | None]  # [m], [s] before a frame that no walking person reaches


def emissions(frames: Sequence[Frame]) -> list[Array]:
    """Return log odds (S,) of each frame's states against none, counting only new evidence."""
    found: list[Array] = []
    last: Frame | None = None
    for frame in frames:
        odds = np.array([state.log_odds for state in frame.states])
        if len(odds) == 0:
            found.append(odds)
            continue
        share = 1.0 if last is None else fraction_moved(last, frame)
        last = frame
        total = np.clip(np.logaddexp.reduce(odds), -MOST_ODDS, MOST_ODDS)
        of_place = odds[group_by_place(odds, state_centers(frame.states))]
        behind = -new_differences(odds.max() - of_place, share) - (of_place - odds)
        found.append(total + behind - np.logaddexp.reduce(behind))
    return found


def new_differences(behind: Array, share: float) -> Array:
    """Return the log differences (S,) of poses to the best that count in a frame.

    `share` is the fraction of the frame that is new. Differences between copies count only by that
    fraction; other poses just score lower.
    """
    is_other = np.clip((behind - COPY_LOG_ODDS) / (OTHER_LOG_ODDS - COPY_LOG_ODDS), 0.0, 1.0)
    return np.asarray(is_other * behind + (1.0 - is_other) * share * np.maximum(behind - COPY_LOG_ODDS, 0.0))


def fraction_moved(before: Frame, frame: Frame) -> float:
    """Return the fraction of a new place that a frame shows, by the least distance moved since another."""
    starts, ends = (state_centers(f.likely) for f in (before, frame))
    moved = float(np.linalg.norm(ends[:, None] - starts[None], axis=2).min())
    return min(moved / TELLING_DISTANCE, 1.0)


def group_by_place(odds: Array, centers: Array) -> NDArray[np.int64]:
    """Return the index (S,) of the likeliest pose within SAME_PLACE of each pose (S, 3), by log odds (S,)."""
    leaders: list[int] = []
    place = np.empty(len(odds), np.int64)
    for j in np.argsort(-odds, kind="stable"):
        here = [i for i in leaders if np.linalg.norm(centers[i] - centers[j]) < SAME_PLACE]
        leaders += [] if here else [int(j)]
        place[j] = here[0] if here else j
    return place


def log_transition(distance: Array, seconds: float, motion: Motion, expected: Array | float = 0.0) -> Array:
    """Return log odds (N,) that a camera has moved by distances [m] in a time [s], against any place.

    `expected` is the gain of a place within reach; a place out of reach has the odds of a jump.
    """
    excess = np.maximum(distance - motion.max_speed * seconds - REACH_SLACK, 0.0)
    jump = GAP_LOG if motion.is_timed else UNTIMED_GAP_LOG
    return np.maximum(expected - 0.5 * (excess / REACH_SIGMA) ** 2, jump)


def log_leaving(log: Array, frame: Frame) -> Array:
    """Return log odds (S,) of leaving states for an unlisted place, from the steps (S, N) to a frame."""
    is_kept = (log.max(axis=1) > JUMPED) & (frame.how == "tracked" or frame.is_telling)
    return np.asarray(np.where(is_kept, GAP_LOG, LOST_LOG))


def log_entering(frame: Frame) -> float:
    """Return the log odds of coming from an unlisted place to a frame's poses."""
    return 0.0 if frame.how == "alone" else FOLLOWED_LOG


class _Steps(NamedTuple):
    """Log odds of the steps from a frame's states to those of a later one."""

    begin: int
    log: NDArray[np.float64]  # (S before, S)


class _Unlisted(NamedTuple):
    """Paths that lead to a frame at an unlisted place."""

    emitted: float = 0.0
    forward: float = 0.0  # sum over ways, emissions included
    best: float = 0.0  # of the best way
    back: tuple[int, int] | None = None  # frame and state before


class Lattice:
    """The frames so far, with the logs of all paths that lead to each state; it grows frame by frame.

    A path begins at an unlisted place, with a log of 0.
    """

    def __init__(self, space: FreeSpace, motion: Motion) -> None:
        self.space = space
        self.motion = motion
        self.frames: list[Frame] = []
        self.emitted: list[Array] = []
        self.steps: list[list[_Steps]] = []
        self.forward: list[Array] = []  # sums over ways, emissions included
        self.best: list[Array] = []  # of the best way
        self.back: list[list[tuple[int, int] | None]] = []
        self.unlisted: list[_Unlisted] = []
        self.ended: float = -math.inf  # the sum over ways that end at a state

    def add(self, frame: Frame) -> None:
        """Add the next frame in time."""
        self.frames.append(frame)
        k = len(self.frames) - 1
        before = next((f for f in reversed(self.frames[:-1]) if f.states), None)
        self.emitted.append(emissions([before, frame] if before else [frame])[-1])
        steps = self._steps_to(k)
        self.steps.append(steps)
        unlisted, begin = (self.unlisted[-1], (k - 1, UNLISTED)) if k else (_Unlisted(), None)
        self.unlisted.append(self._unlisted_at(k, unlisted))
        num = len(frame.states)
        sums = np.full(num, log_entering(frame) + unlisted.forward)
        best = np.full(num, log_entering(frame) + unlisted.best)
        back: list[tuple[int, int] | None] = [begin] * num
        for s in steps:
            sums = np.logaddexp(sums, np.logaddexp.reduce(self.forward[s.begin][:, None] + s.log, axis=0))
            ways = self.best[s.begin][:, None] + s.log
            for j in range(num):
                i = int(ways[:, j].argmax())
                if ways[i, j] > best[j]:
                    best[j] = ways[i, j]
                    back[j] = (s.begin, i)
        self.forward.append(sums + self.emitted[k])
        self.ended = float(np.logaddexp(self.ended, np.logaddexp.reduce(self.forward[k])))
        self.best.append(best + self.emitted[k])
        self.back.append(back)

    def _unlisted_at(self, k: int, before: "_Unlisted") -> "_Unlisted":
        """Extend the unlisted paths to a frame.

        A frame that is not telling supports unlisted places as much as the best listed one.
        """
        gained = max([0.0, *(float(s.log.max()) for s in self.steps[k])])
        emitted = float(self.emitted[k].max(initial=-math.inf)) + gained
        emitted = max(emitted - self._new_fraction(k) * (TELLING_LOG + gained), 0.0)
        forward = before.forward
        best = before.best
        back = (k - 1, UNLISTED) if k else None
        for s in self.steps[k]:
            leave = log_leaving(s.log, self.frames[k])
            forward = float(np.logaddexp(forward, np.logaddexp.reduce(self.forward[s.begin] + leave)))
            ways = self.best[s.begin] + leave
            if ways.max() > best:
                best = float(ways.max())
                back = (s.begin, int(ways.argmax()))
        return _Unlisted(emitted, forward + emitted, best + emitted, back)

    def _new_fraction(self, k: int) -> float:
        """Return the fraction of a whole search's evidence that is new in a frame."""
        frame = self.frames[k]
        if not frame.is_telling:
            return 0.0
        last = next((f for f in reversed(self.frames[:k]) if f.is_telling), None)
        return 1.0 if last is None else max(fraction_moved(last, frame), LEAST_TOLD)

    def _steps_to(self, k: int) -> list[_Steps]:
        """Return the steps to a frame from all earlier frames from which the path may lead to it."""
        ends = state_centers(self.frames[k].states)
        steps: list[_Steps] = []
        passed = 0.0
        if len(ends) == 0:
            return []
        for m in range(k - 1, max(k - 1 - LONGEST_SKIP, -1), -1):
            frame = self.frames[m]
            if not frame.states:
                continue
            seconds = self.frames[k].time - frame.time
            limit = self.motion.max_speed * seconds + REACH_SLACK + 5.0 * REACH_SIGMA
            starts = state_centers(frame.states)
            distances = [self.space.distance(start, ends, limit) for start in starts]
            expected = np.array([[self._expected(start, limit)] for start in starts])
            steps.append(_Steps(m, log_transition(np.array(distances), seconds, self.motion, expected)))
            passed += max(float(np.logaddexp.reduce(self.emitted[m])), 0.0)
            if passed > MAX_SKIPPED:
                break
        return steps

    def _expected(self, start: Array, reach: float) -> float:
        """Return the log odds that a pose within a reach [m] gains: the more, the less of the map lies there.

        A frame's own odds assume that all places of the map are equally likely.
        """
        return min(-math.log(self.space.fraction_within(start, reach)), MOST_EXPECTED)

    def filter_last(self) -> Array:
        """Return the probability (S,) of each state of the last frame, given all frames so far."""
        return np.asarray(np.exp(self.forward[-1] - self._total()))

    def _total(self) -> float:
        """Return the log of the sum over all paths."""
        return float(np.logaddexp(self.unlisted[-1].forward, self.ended))

    def smooth(self) -> Path:
        """Return the likeliest path, and the probability of each state given all frames."""
        backward = [np.zeros(len(f.states)) for f in self.frames]
        unlisted = 0.0
        for k in range(len(self.frames) - 1, -1, -1):
            onward = self.emitted[k] + backward[k]
            unlisted += self.unlisted[k].emitted
            for s in self.steps[k]:
                leave = log_leaving(s.log, self.frames[k]) + unlisted
                ways = np.concatenate([s.log + onward[None], leave[:, None]], axis=1)
                backward[s.begin] = np.logaddexp(backward[s.begin], np.logaddexp.reduce(ways, axis=1))
            unlisted = float(np.logaddexp.reduce([unlisted, *(log_entering(self.frames[k]) + onward)]))
        total = self._total() if self.frames else 0.0
        probabilities = [np.exp(f + b - total) for f, b in zip(self.forward, backward, strict=True)]
        chosen = self._likeliest()
        return Path(chosen, probabilities, self._gaps(chosen))

    def _likeliest(self) -> list[int | None]:
        chosen: list[int | None] = [None] * len(self.frames)
        if not self.frames:
            return chosen
        ends = [(float(b.max()), (k, int(b.argmax()))) for k, b in enumerate(self.best) if len(b)]
        ends.append((self.unlisted[-1].best, (len(self.frames) - 1, UNLISTED)))
        at: tuple[int, int] | None = max(ends)[1]
        while at is not None:
            k, j = at
            chosen[k] = None if j == UNLISTED else j
            at = self.unlisted[k].back if j == UNLISTED else self.back[k][j]
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
                if log < JUMPED:
                    ends = state_centers([self.frames[m].states[i], self.frames[k].states[j]])
                    metres = float(np.linalg.norm(ends[1] - ends[0]))
                    gaps[k] = metres, self.frames[k].time - self.frames[m].time
            before = k, j
        return gaps


def build_lattice(frames: Sequence[Frame], space: FreeSpace, motion: Motion) -> Lattice:
    """Build the lattice of frames in their order."""
    lattice = Lattice(space, motion)
    for frame in frames:
        lattice.add(frame)
    return lattice
