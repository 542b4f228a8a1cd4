"""The belief in a photo's poses, and the status that follows from it.

Three questions have separate answers: which place is right, whether the pose is exact enough there, and
whether the given geometry of the photo, as a focal length, is right. Only `Belief.probabilities` multiplies
the answers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..system.arrays import Array
from .probability import NOT_LOCALIZED, classify
from .reasons import Reason

UNCONFIRMED = 0.1  # chosen: doubt of given values that the photo can't confirm as exactly as is wanted


@dataclass(frozen=True)
class Belief:
    """Probabilities of a photo's poses, the best one first."""

    place: tuple[float, ...]  # (K + 1,) that the place of each of K poses is right, and that none of them is
    within: float = 1.0  # that the best pose is as exact as wanted if its place is right
    doubt: float = 0.0  # that the given geometry of the photo is wrong
    ruled_out: frozenset[Reason] = frozenset()  # reasons why no pose is right, whatever its probability

    @property
    def best_place(self) -> float:
        """Probability that the place of the best pose is right; 0 without a pose, and if it is ruled out."""
        return 0.0 if self.ruled_out or len(self.place) < 2 else self.place[0]

    @property
    def sound_places(self) -> Array:
        """Probabilities (K + 1,) that each place and the given geometry are right, and that none is."""
        sound = 0.0 if self.ruled_out else 1.0 - self.doubt
        return _complete(sound * np.array(self.place[:-1]))

    @property
    def probabilities(self) -> Array:
        """Probabilities (K + 1,) that each pose is right, as exact as wanted, and that none of them is."""
        return _complete(self.within * self.sound_places[:-1])

    def scale(self, factor: float) -> "Belief":
        """Return the belief with the probabilities of all places multiplied by a factor."""
        return replace(self, place=make_belief(factor * np.array(self.place[:-1])).place)

    def rule_out(self, *reasons: Reason) -> "Belief":
        """Return the belief with further reasons why no pose is right."""
        return replace(self, ruled_out=self.ruled_out.union(reasons))


def make_belief(places: Sequence[float] | Array, within: float = 1.0, doubt: float = 0.0) -> Belief:
    """Return a belief in places (K,) with these probabilities; that none is right has the rest."""
    return Belief(tuple(_complete(np.asarray(places, np.float64)).tolist()), within, doubt)


def _complete(poses: Array) -> Array:
    """Append to probabilities (K,) the rest, that none of them holds."""
    return np.append(poses, max(1.0 - poses.sum(), 0.0))


NOTHING = make_belief([])


class Decision(NamedTuple):
    """A status, and the probabilities (K + 1,) from which it follows."""

    status: str
    probabilities: Array


def decide(belief: Belief, min_confidence: float) -> Decision:
    """Decide whether a photo is localized; one without poses is not."""
    probabilities = belief.probabilities
    has_poses = len(probabilities) > 1
    return Decision(classify(probabilities, min_confidence) if has_poses else NOT_LOCALIZED, probabilities)
