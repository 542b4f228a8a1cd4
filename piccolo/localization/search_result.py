"""What a search has come to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..confidence.alternatives import Hypothesis, alternative_poses, by_score
from ..geometry.pose import Pose

SURE_SCORE, SURE_RATIO = 0.05, 0.5  # least of the best; at most of the best elsewhere, by the best
SURE_MATCHES = 12  # wrong poses have 5, in alike places more, but then not the only ones
NEAR_RATIO = 0.6  # an alternative with this part of the best score is refined as carefully as the best


@dataclass(frozen=True)
class SearchResult:
    """What the search has come to: the best hypothesis, and the best ones elsewhere, best first."""

    best: Hypothesis
    alternatives: tuple[Hypothesis, ...]
    rival_ratio: float = 0.0  # the most that one of these explains of what both views show, by the best

    @property
    def margin(self) -> float:
        """Lead of the best in what both views show, by what it explains, in [-1, 1]; by score if less."""
        of_scores = max([0.0, *(h.score for h in self.alternatives)]) / max(self.best.score, 1e-9)
        return 1.0 - min(max(self.rival_ratio, of_scores), 2.0)

    def is_sure(self, num_matches: int) -> bool:
        """True if no other search need be made, with this many matches that agree with the best pose."""
        is_alone = self.margin >= 1.0 - SURE_RATIO
        return is_alone and self.best.score >= SURE_SCORE and num_matches >= SURE_MATCHES


NOTHING = SearchResult(Hypothesis(Pose(np.eye(3), np.zeros(3)), -1.0), ())


def found_among(hypotheses: Sequence[Hypothesis], count: int) -> SearchResult:
    """The best of some hypotheses, and at most `count` elsewhere; NOTHING if there are none."""
    if not hypotheses:
        return NOTHING
    best = by_score(hypotheses)[0]
    return SearchResult(best, tuple(alternative_poses(best.pose, hypotheses, count=count)))
