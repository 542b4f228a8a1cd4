"""What a search has come to."""

from dataclasses import dataclass

import numpy as np

from ..confidence.alternatives import Hypothesis, score_margin
from ..geometry.pose import Pose

CONFIDENT_SCORE, CONFIDENT_MARGIN = 0.25, 0.15  # with less, another attempt is made
NEAR_RATIO = 0.4  # an alternative with this part of the best score is refined as carefully as the best


@dataclass(frozen=True)
class SearchResult:
    """What the search has come to: the best hypothesis, and the best ones elsewhere, best first."""

    best: Hypothesis
    alternatives: tuple[Hypothesis, ...]

    @property
    def margin(self) -> float:
        """Lead of the best score over the best elsewhere, or over 0."""
        return score_margin(self.best.score, self.alternatives)

    @property
    def is_confident(self) -> bool:
        """True if no other attempt need be made."""
        return self.best.score >= CONFIDENT_SCORE and self.margin >= CONFIDENT_MARGIN

    @property
    def near(self) -> list[Hypothesis]:
        """The alternatives that come near the best."""
        return [h for h in self.alternatives if h.score > NEAR_RATIO * self.best.score]


NOTHING = SearchResult(Hypothesis(Pose(np.eye(3), np.zeros(3)), -1.0), ())
