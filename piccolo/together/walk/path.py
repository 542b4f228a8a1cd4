"""The path through the places of a walk's key frames: Markov localization (Fox, Burgard and Thrun, 1999).

Each key frame has a likelihood over the whole map, kept where it is not negligible. The camera walks from
place to place through free space, or moves as tracking or an odometry measured; anything else is a jump, with
low odds if the frames have times. A frame may also be at none of its places: the path then goes on from an
earlier frame.
Forward-backward (Rabiner 1989) finds the probability of each place.

Frames of one place have correlated errors. So key frames are some distance apart, and differences of odds as
small as between exact copies of a room do not distinguish places. The probabilities of a frame's poses follow
from the path.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...geometry.nearness import ONE_ANSWER
from ...geometry.pose import Pose, carry
from ...judge.result_parts import Gap
from ...problem.accuracy import Accuracy, Demand
from ...scan_map.camera_positions import FreeSpace
from ...system.arrays import Array, Mask
from .frames import JUMP_LOG, MOST_EXPECTED, MOST_ODDS, REACH_SLACK, Frame, Motion, State, state_centers

EVEN = 0.5  # probability: with less, a pose is more likely wrong than right
COPY_LOG_ODDS = 3.0  # copies of a place differ by less (2.1 in 50 probes), if one of them was scanned better
NEGLIGIBLE = -2.0 * JUMP_LOG  # [log] a way that leaves out more evidence is worse than two jumps
DRIFT = 0.05  # error of an odometry, as a share of the path that it measures


class Path(NamedTuple):
    """The probabilities of the places of a walk's key frames; other frames have empty arrays."""

    probabilities: list[Array]  # (S,) of each frame's states
    gaps: list[Gap | None]  # before each frame, if the frames have times

    def choose(self, k: int) -> int | None:
        """Return the likeliest state of a frame; None if it is more likely at none of them."""
        found = self.probabilities[k]
        return int(found.argmax()) if found.sum() > EVEN else None


# the values on which steps depend (states of two frames, which of them a walk may begin at), and the steps
_Known = tuple[list[State], list[State], bytes, Array]


class _Steps(NamedTuple):
    """Log odds of the steps from a key frame's states to those of a later one."""

    begin: int  # number of the column
    log: Array  # (S before, S)


class _Column(NamedTuple):
    """A key frame, with the log of the sum over all ways that lead to each state."""

    number: int  # of the frame
    emitted: Array  # (S,)
    steps: list[_Steps]
    forward: Array  # (S,) emissions included


def emissions(frame: Frame, tracked: float = -math.inf) -> tuple[Array, float]:
    """Return log odds (S,) of a key frame's states against none.

    The odds of the frame's best state, or of the best frame tracked from it if greater, are divided among its
    states: states that look worse than the best get less. The second result is the log of the effective
    number of states.
    """
    odds = np.array([state.log_odds for state in frame.states])
    tolerance = 0.0 if frame.is_localized_alone else COPY_LOG_ODDS
    behind = np.minimum(odds - odds.max() + tolerance, 0.0)
    log_alike = float(np.logaddexp.reduce(behind))
    best = min(max(float(odds.max()), tracked, -MOST_ODDS), MOST_ODDS)
    return best + behind - log_alike, log_alike


def log_transition(distance: Array, seconds: float, motion: Motion, expected: Array | float = 0.0) -> Array:
    """Return log odds (N,) that a camera has moved by distances [m] in a time [s], against any place.

    `expected` is the gain of a place within reach; a place out of reach has the odds of a jump.
    """
    excess = np.maximum(distance - motion.reach(seconds), 0.0)
    return np.maximum(expected - 0.5 * (excess / REACH_SLACK) ** 2, motion.jump_log)


def motion_between(frames: Sequence[Frame], m: int, k: int) -> tuple[Pose, Pose, float] | None:
    """Return two poses that differ by the camera's motion from a key frame to another, and their error [m].

    The motion is that of tracking, if it led from the one to the other, else that of the odometry; None if
    there is neither.
    """
    before, frame = frames[m], frames[k]
    end = track_back(frames, m, k)
    if end is not None and before.departed is not None:
        return before.departed, end, ONE_ANSWER.distance
    poses = [f.odometry for f in frames[m : k + 1] if f.odometry is not None]
    if before.odometry is None or frame.odometry is None:
        return None
    steps = np.diff([pose.center_world for pose in poses], axis=0)
    walked = float(np.linalg.norm(steps, axis=1).sum())
    return before.odometry, frame.odometry, ONE_ANSWER.distance + DRIFT * walked


def track_back(frames: Sequence[Frame], m: int, k: int) -> Pose | None:
    """Return the pose of frame `k` by tracking from key frame `m`, perhaps through later ones, or None."""
    key = frames[k].key
    arrived = frames[k].arrived
    if key is None or arrived is None or not m < key < k:
        return arrived if key == m else None
    at_key = track_back(frames, m, key)
    departed = frames[key].departed
    return None if at_key is None or departed is None else carry(arrived, departed, at_key)


def is_moved(moved: tuple[Pose, Pose, float], starts: Sequence[State], ends: Sequence[State]) -> Mask:
    """Return True (S, N) for the steps from starts to ends that agree with a known motion."""
    begin, end, error = moved
    carried = [carry(end, begin, state.pose) for state in starts]
    centers = np.array([pose.center_world for pose in carried])
    distances = np.linalg.norm(centers[:, None] - state_centers(ends)[None], axis=2)
    R_carried = np.array([pose.R_cam_from_world for pose in carried]).reshape(-1, 9)
    R_ends = np.array([state.pose.R_cam_from_world for state in ends]).reshape(-1, 9)
    least_trace = 1.0 + 2.0 * math.cos(ONE_ANSWER.angle)
    is_turned_so = R_carried @ R_ends.T >= least_trace
    return np.asarray((distances < error) & is_turned_so)


class Lattice:
    """The frames so far; it grows frame by frame."""

    def __init__(self, space: FreeSpace, motion: Motion) -> None:
        self.space = space
        self.motion = motion
        self.frames: list[Frame] = []
        self.known: dict[tuple[int, int], _Known] = {}  # steps of two frames, as they were last
        self.columns: list[_Column] = []
        self.ended: list[float] = [0.0]  # log of the sum over ways that end before each column

    def add(self, frame: Frame, tracked: float = -math.inf) -> None:
        """Add the next frame in time; `tracked` are the log odds of frames that were tracked from it."""
        self.frames.append(frame)
        if frame.is_key:
            self._append_column(len(self.frames) - 1, tracked)

    def change_last(self) -> None:
        """Compute the last frame's column again, as this key frame has other states now."""
        self.columns.pop()
        self.ended.pop()
        self._append_column(len(self.frames) - 1)

    def _append_column(self, k: int, tracked: float = -math.inf) -> None:
        frame = self.frames[k]
        emitted, log_alike = emissions(frame, tracked)
        steps = self._steps_to(k, log_alike)
        begins = (self.columns[s.begin].forward for s in steps)
        ways = [np.logaddexp.reduce(f[:, None] + s.log, axis=0) for f, s in zip(begins, steps, strict=True)]
        forward = emitted + np.logaddexp.reduce([np.zeros(len(emitted)), *ways])
        self.columns.append(_Column(k, emitted, steps, forward))
        total = np.logaddexp.reduce(self.columns[-1].forward)
        self.ended.append(float(np.logaddexp(self.ended[-1], total)))

    def _steps_to(self, k: int, log_alike: float) -> list[_Steps]:
        """Return the steps to a key frame from all earlier ones from which the path may lead to it."""
        steps: list[_Steps] = []
        passed = 0.0
        for n in range(len(self.columns) - 1, -1, -1):
            column = self.columns[n]
            steps.append(_Steps(n, self._step_once(column, k, MOST_EXPECTED + log_alike)))
            passed += max(float(np.logaddexp.reduce(column.emitted)), 1.0)
            if passed > NEGLIGIBLE:
                break
        return steps

    def _step_once(self, column: _Column, k: int, most_expected: float) -> Array:
        """Return `_step`, kept from before if no state of the two frames has changed."""
        m = column.number
        states = self.frames[m].states, self.frames[k].states
        is_likely = column.forward >= column.forward.max() + JUMP_LOG
        known = self.known.get((m, k))
        is_same = known is not None and known[0] is states[0] and known[1] is states[1]
        if known is None or not is_same or known[2] != is_likely.tobytes():
            steps = self._step(m, k, is_likely, most_expected)
            known = self.known[m, k] = (*states, is_likely.tobytes(), steps)
        return known[3]

    def _step(self, m: int, k: int, is_likely: Mask, most_expected: float) -> Array:
        """Return log odds (S before, S) of the steps from a key frame to another.

        Walks begin only at places that `is_likely` (S before,), as those far less likely than the best do not
        matter.
        """
        starts, ends = self.frames[m].states, self.frames[k].states
        if moved := motion_between(self.frames, m, k):
            return np.where(is_moved(moved, starts, ends), most_expected, self.motion.jump_log)
        last, begins = self._last_tracked(m, k)
        begins = [pose for pose, likely in zip(begins, is_likely, strict=True) if likely]
        centers = np.array([pose.center_world for pose in begins])
        seconds = self.frames[k].time - self.frames[last].time
        least_jump = math.sqrt(2.0 * (most_expected - self.motion.jump_log))  # [deviations] beyond reach
        limit = self.motion.reach(seconds) + REACH_SLACK * least_jump
        distances = self.space.distances(centers, state_centers(ends), limit)
        fractions = np.array([[self.space.fraction_within(start, limit)] for start in centers])
        expected = np.minimum(-np.log(fractions), most_expected)
        log = np.full((len(starts), len(ends)), self.motion.jump_log)
        log[is_likely] = log_transition(distances, seconds, self.motion, expected)
        return log

    def _last_tracked(self, m: int, k: int) -> tuple[int, list[Pose]]:
        """Return the last frame before `k` that was tracked from key frame `m`, and its poses."""
        states = self.frames[m].states
        departed = self.frames[m].departed
        for n in range(k - 1, m, -1):
            arrived = self.frames[n].arrived
            if self.frames[n].key == m and arrived is not None and departed is not None:
                return n, [carry(arrived, departed, state.pose) for state in states]
        return m, [state.pose for state in states]

    def filter_path(self) -> Path:
        """Return the path of the last key frames, back to the newest from which frames are tracked.

        The probabilities of a key frame use the frames up to it, not later ones.
        """
        path = self._empty_path()
        for column, ended in zip(self.columns[::-1], self.ended[::-1], strict=False):
            path.probabilities[column.number] = np.exp(column.forward - ended)
            if self.frames[column.number].departed is not None:
                break
        return path

    def smooth(self) -> Path:
        """Return the probability of each state by all frames."""
        path = self._empty_path()
        backward = [np.zeros(len(column.emitted)) for column in self.columns]
        for n in range(len(self.columns) - 1, -1, -1):
            column = self.columns[n]
            for s in column.steps:
                ways = s.log + (column.emitted + backward[n])[None]
                backward[s.begin] = np.logaddexp(backward[s.begin], np.logaddexp.reduce(ways, axis=1))
        for column, onward in zip(self.columns, backward, strict=True):
            path.probabilities[column.number] = np.exp(column.forward + onward - self.ended[-1])
        self._note_gaps(path)
        return path

    def _empty_path(self) -> Path:
        return Path([np.empty(0)] * len(self.frames), [None] * len(self.frames))

    def _note_gaps(self, path: Path) -> None:
        """Write the gaps between likely states."""
        likely = [path.probabilities[column.number] > EVEN for column in self.columns]
        found = [(n, int(is_likely.argmax())) for n, is_likely in enumerate(likely) if is_likely.any()]
        for (m, i), (n, j) in pairwise(found):
            column = self.columns[n]
            log = next((s.log[i, j] for s in column.steps if s.begin == m), 0.0)
            if self.motion.is_timed and log <= self.motion.jump_log:
                before = self.frames[self.columns[m].number]
                after = self.frames[column.number]
                metres = after.states[j].pose.distance(before.states[i].pose)
                path.gaps[column.number] = Gap(metres, after.time - before.time)


def build_lattice(
    frames: Sequence[Frame], space: FreeSpace, motion: Motion, before: Lattice | None = None
) -> Lattice:
    """Build the lattice of frames in their order; columns that have not changed are taken from `before`."""
    lattice = Lattice(space, motion)
    if before is not None:
        lattice.known = before.known
    tracked = np.full(len(frames), -np.inf)
    for frame in frames:
        if frame.key is not None and frame.states:
            tracked[frame.key] = max(tracked[frame.key], frame.states[0].log_odds)
    for frame, best in zip(frames, tracked, strict=True):
        lattice.add(frame, float(best))
    return lattice


class Ranked(NamedTuple):
    """A frame's poses, best first."""

    states: list[State]
    probabilities: Array  # (S,) that each is of the frame's place
    expected: Pose | None = None  # pose that surely follows from tracking, but was not refined

    @property
    def is_sure(self) -> bool:
        """True if the first pose is more likely right than wrong."""
        return len(self.states) > 0 and self.states[0].is_refined and bool(self.probabilities[0] > EVEN)

    @property
    def is_confirmed(self) -> bool:
        """True if the photo is sure of the first pose, by itself or by a frame beside."""
        return any(state.is_sure for state in self.states[:1])

    def is_enough(self, demand: Demand) -> bool:
        """Return True if the first pose is right with the confidence demanded."""
        return self.confidence(demand.accuracy) >= demand.min_confidence

    def confidence(self, accuracy: Accuracy) -> float:
        """Return the probability that the first pose is as exact as `accuracy`; 0 if there is no pose."""
        if not self.states:
            return 0.0
        return float(self.probabilities[0]) * accuracy.probability(self.states[0].gaussian)


NOTHING = Ranked([], np.empty(0))


def believe(frames: Sequence[Frame], path: Path, k: int) -> Ranked:
    """Return a frame's poses with their probabilities by a path: of a key frame, or by tracking."""
    frame = frames[k]
    if frame.is_key:
        return believe_key(frame.states, path.probabilities[k])
    return NOTHING if frame.key is None else believe_tracked(frames, path, k)


def believe_key(states: Sequence[State], probabilities: Array) -> Ranked:
    """Return the states of a key frame, the likeliest first."""
    order = np.argsort(-probabilities, kind="stable")
    return Ranked([states[j] for j in order], probabilities[order])


def believe_tracked(frames: Sequence[Frame], path: Path, k: int) -> Ranked:
    """Return the poses to which a frame was tracked, from each place where its key frame may be."""
    frame = frames[k]
    key = frame.key
    if key is None or frame.arrived is None or not frames[key].is_key or path.choose(key) is None:
        return NOTHING
    at_key = believe_key(frames[key].states, path.probabilities[key])
    own = frame.states[0]
    credible = 1.0 / (1.0 + math.exp(-own.log_odds - own.gain))
    probabilities = credible * np.minimum(at_key.probabilities, probability_of_next(frames, path, k))
    departed = frames[key].departed or at_key.states[0].pose
    carried = [carry(frame.arrived, departed, state.pose) for state in at_key.states]
    states = [State(pose, own.log_odds) for pose in carried]
    if ONE_ANSWER.holds(carried[0], own.pose):
        return Ranked([own, *states[1:]], probabilities)
    expected = carried[0] if probabilities[0] > EVEN else None
    probabilities[0] = min(probabilities[0], EVEN)  # the photo was not compared with the scan there
    return Ranked(states, probabilities, expected)


def probability_of_next(frames: Sequence[Frame], path: Path, k: int) -> float:
    """Return the probability of the next key frame's place, if the frame `k` has the same key frame.

    It is 1 if the next key frame was tracked from another one, and 0.5 if there is a gap before it.
    """
    after = next((n for n in range(k + 1, len(frames)) if frames[n].is_key), None)
    if after is None or frames[after].key != frames[k].key:
        return 1.0
    return EVEN if path.gaps[after] else float(path.probabilities[after].max(initial=0.0))
