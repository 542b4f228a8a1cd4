"""The poses that a frame of a walk may have by the path through all frames, and their probabilities."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from ..geometry.nearness import ONE_ANSWER
from ..geometry.pose import Pose, carry
from .frames import Frame, State
from .path import EVEN, Path


class Belief(NamedTuple):
    """A frame's poses, best first."""

    states: list[State]
    probabilities: Array  # (S,) that each is of the frame's place
    expected: Pose | None = None  # where tracking surely puts a frame, but where it was not refined

    @property
    def is_sure(self) -> bool:
        """True if the first pose more likely is right than not."""
        return len(self.states) > 0 and self.states[0].is_refined and bool(self.probabilities[0] > EVEN)


NOTHING = Belief([], np.empty(0))


def believe(frames: Sequence[Frame], path: Path, k: int) -> Belief:
    """Return what a path says of a frame: a key frame's places, or where it was tracked to from one."""
    frame = frames[k]
    if frame.is_key:
        return believe_key(frame.states, path.probabilities[k])
    return NOTHING if frame.key is None else believe_tracked(frames, path, k)


def believe_key(states: Sequence[State], probabilities: Array) -> Belief:
    """Return the states of a key frame, the likeliest first."""
    order = np.argsort(-probabilities, kind="stable")
    return Belief([states[j] for j in order], probabilities[order])


def believe_tracked(frames: Sequence[Frame], path: Path, k: int) -> Belief:
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
        return Belief([own, *states[1:]], probabilities)
    expected = carried[0] if probabilities[0] > EVEN else None
    probabilities[0] = min(probabilities[0], EVEN)  # nothing was seen there
    return Belief(states, probabilities, expected)


def probability_of_next(frames: Sequence[Frame], path: Path, k: int) -> float:
    """Return the probability of the place of the next key frame, if it was tracked from a frame's own.

    It is 1 if it was not, and 0.5 if there is a gap between the two.
    """
    after = next((n for n in range(k + 1, len(frames)) if frames[n].is_key), None)
    if after is None or frames[after].key != frames[k].key:
        return 1.0
    return EVEN if path.gaps[after] else float(path.probabilities[after].max(initial=0.0))
