"""Candidates: poses that may be right, each with its evidence. The judge reads it, and computes none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..geometry.pose import Pose
from ..geometry.sphere import CHANCE_CORRELATION, NUM_BLOCKS
from ..local_features.matching import Located, Matches
from ..problem.photo_images import PhotoImages
from ..system.arrays import Array, Mask
from .reasons import Contradiction

CONTRADICTS = 0.1  # a block with a lower correlation is left out of the local means and deviations
LEAST_SHARED = 0.3  # of the area of the poorer of two views: if they share less, they are not compared
MAX_COMPARED = 8  # alternatives of the best pose


class Comparison(NamedTuple):
    """Agreement of photo and scan at a pose, by blocks of the photo."""

    correlation: Array  # (blocks,) of locally normalised colours, 0 where nothing is shared
    area: Array  # (blocks,) fractions of the sphere that both show and do not contradict
    visible_area: Array  # (blocks,) that both show
    valid_area: float  # of the sphere that the photo shows

    @property
    def score(self) -> float:
        """Area explained beyond chance, divided by the area that the photo shows, in [0, 1]."""
        return self.score_beyond(CHANCE_CORRELATION)

    def score_beyond(self, chance: float) -> float:
        """Return the score if `chance` is the correlation of a block that is reached by chance."""
        beyond = np.maximum(self.correlation - chance, 0.0) / (1.0 - chance)
        return float(beyond @ self.area) / max(self.valid_area, 1e-9)

    @property
    def contradicts(self) -> Mask:
        """Mask (blocks,) of the blocks that contradict the scan, by an occluder or as the pose is wrong."""
        return (self.correlation < CONTRADICTS) & (self.visible_area > 0.0)

    def compute_ratio(self, other: "Comparison") -> float:
        """Return the ratio of the area explained by this pose to another's, over blocks that both views show.

        Over all blocks, a pose from which more of the scan is seen would gain by that alone. 0 if hardly any
        block is shared.
        """
        shared = np.minimum(self.visible_area, other.visible_area)
        if shared.sum() < LEAST_SHARED * min(self.visible_area.sum(), other.visible_area.sum()):
            return 0.0
        mine, others = (np.maximum(c.correlation - CHANCE_CORRELATION, 0.0) @ shared for c in (self, other))
        return float(mine / max(others, 1e-9))


class Unoccluded(NamedTuple):
    """A photo without its blocks that contradict the scan at a pose."""

    contradicts: bytes  # the mask of these blocks
    photo: PhotoImages


class Drawn(NamedTuple):
    """The scan drawn near a pose, on a grid of poses, and the matches of a photo with it."""

    key: bytes  # of the pose of the grid
    picture: Located  # at that pose; without keypoints if the photo has none
    matches: Matches


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that may be right, with the evidence that was computed for it so far."""

    pose: Pose  # in the map
    score: float  # score of `comparison`
    comparison: Comparison  # of the photo and the scan as seen from the pose
    against_prior: tuple[Contradiction, ...] = ()  # prior knowledge that the pose contradicts
    log_by_others: float = 0.0  # log odds by where other photos were taken
    num_matches: int | None = None  # features that agree with the drawn scan; None: it was not drawn
    edge_score: float | None = None  # of the scan's edges drawn at the pose, in a scan without colours
    is_climbed: bool = False  # no perturbation improves it
    # images made for this pose, which serve for poses near it too
    unoccluded: Unoccluded | None = None
    drawn: Drawn | None = None

    def forget(self) -> "Candidate":
        """Return the candidate without the images and matches, which take memory."""
        return replace(self, unoccluded=None, drawn=None)


_EMPTY = np.zeros(NUM_BLOCKS)
NO_CANDIDATE = Candidate(Pose(np.eye(3), np.zeros(3)), -1.0, Comparison(_EMPTY, _EMPTY, _EMPTY, 0.0))


@dataclass(frozen=True)
class Selection:
    """The best candidate, and the best candidates at other places, best first."""

    best: Candidate
    alternatives: tuple[Candidate, ...]
    rival_ratio: float = 0.0  # largest ratio of an alternative to the best, over what both views show

    @property
    def candidates(self) -> list[Candidate]:
        """The best candidate, then the others."""
        return [self.best, *self.alternatives]

    @property
    def margin(self) -> float:
        """Relative lead of the best, at least -1: by score, or over what both views show if that is less."""
        by_score = max([0.0, *(h.score for h in self.alternatives)]) / max(self.best.score, 1e-9)
        return max(1.0 - max(self.rival_ratio, by_score), -1.0)

    def take(self, ranked: Sequence[Candidate]) -> "Selection":
        """Return the selection with these candidates, the best first."""
        return replace(self, best=ranked[0], alternatives=tuple(ranked[1:]))

    def forget(self) -> "Selection":
        """Return the selection without the images and matches, which take memory."""
        return self.take([candidate.forget() for candidate in self.candidates])


NO_CHOICE = Selection(NO_CANDIDATE, ())
