"""Which of some poses is the best for all that speaks for it, and whether that leaves any doubt."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..confidence.alternatives import Hypothesis, alternative_poses, by_score
from ..confidence.confidence import CLEAR_MATCHES, CONTRADICTED, Standing, log_odds
from ..geometry.pose import Pose
from ..local_features.hypotheses import count_matches
from .comparison import compare
from .prior import contradictions
from .query import Query

MAX_COMPARED = 8  # poses beside the best
SURE_SCORE = 0.05  # of the best, at least
SURE_MARGIN = 0.5  # of the best over the best elsewhere, at least
SURE_MATCHES = 12  # wrong poses have 5, in alike places more, but then not the only ones
CLEAR_SCORE, CLEAR_MARGIN = 0.3, 0.5  # at least, of whole views without features: see docs/METHOD.md


@dataclass(frozen=True)
class Selection:
    """The best hypothesis, and the best ones elsewhere, best first."""

    best: Hypothesis
    alternatives: tuple[Hypothesis, ...]
    rival_ratio: float = 0.0  # the most that one of these explains of what both views show, by the best

    @property
    def margin(self) -> float:
        """Lead of the best in what both views show, by what it explains, in [-1, 1]; by score if less."""
        of_scores = max([0.0, *(h.score for h in self.alternatives)]) / max(self.best.score, 1e-9)
        return 1.0 - min(max(self.rival_ratio, of_scores), 2.0)


NOTHING = Selection(Hypothesis(Pose(np.eye(3), np.zeros(3)), -1.0), ())


def rank(hypotheses: Sequence[Hypothesis], count: int = MAX_COMPARED) -> Selection:
    """The best of some hypotheses by score, and at most `count` elsewhere; NOTHING if there are none."""
    if not hypotheses:
        return NOTHING
    best = by_score(hypotheses)[0]
    return Selection(best, tuple(alternative_poses(best.pose, hypotheses, count=count)))


def standings_of(query: Query, best: Hypothesis, others: Sequence[Hypothesis]) -> list[Standing]:
    """What speaks for the best pose and for others elsewhere, compared over what both views show."""
    at_best = compare(query, best.pose)
    shares = [1.0, *(compare(query, h.pose).ratio_to(at_best) for h in others)]
    return [s._replace(share=v) for s, v in zip(standings_alone(query, [best, *others]), shares, strict=True)]


def standings_alone(query: Query, hypotheses: Sequence[Hypothesis]) -> list[Standing]:
    """What speaks for each of several poses by itself.

    Those that contradict the prior share the odds that it is wrong. Where no features are asked, each pose
    has as many matches as a clear view is worth.
    """
    is_wrong = [bool(contradictions(query.scan_map, h.pose, query.settings.prior)) for h in hypotheses]
    log_prior = math.log(CONTRADICTED / max(sum(is_wrong), 1))
    standings = []
    for h, wrong in zip(hypotheses, is_wrong, strict=True):
        num_matches = count_matches(query.matches, h.pose) if query.num_halves else CLEAR_MATCHES
        standings.append(Standing(1.0, h.score, num_matches, log_prior if wrong else 0.0))
    return standings


def select(query: Query, found: Selection) -> Selection:
    """Take the pose with the greatest odds as the best, and its margin over what both views show.

    As each two are compared over other parts of the sphere, three poses may beat each other in turn: the best
    is the one that is beaten least (minimax; Simpson 1969, Kramer 1977). The others follow by their odds.
    """
    if not found.alternatives:
        return found
    ranked = [found.best, *found.alternatives]
    seen = [compare(query, h.pose) for h in ranked]
    alone = standings_alone(query, ranked)
    shares = [[other.ratio_to(one) for other in seen] for one in seen]
    odds = np.array(
        [[log_odds(a._replace(share=v)) for a, v in zip(alone, row, strict=True)] for row in shares]
    )
    odds -= np.diag(odds)[:, None].copy()  # of each pose, a column, against each, a row
    worst = np.where(np.eye(len(ranked), dtype=bool), -np.inf, odds).max(axis=1)
    best = int(np.argmin(worst))
    others = [int(k) for k in np.argsort(-odds[best], kind="stable") if k != best]
    rival_ratio = max(shares[best][k] for k in others)
    return Selection(ranked[best], tuple(ranked[k] for k in others), rival_ratio)


def is_sure(query: Query, hypotheses: Sequence[Hypothesis]) -> bool:
    """True if the best of some hypotheses leaves no doubt: no other search need be made."""
    found = select(query, rank(hypotheses))
    if found.best.score < SURE_SCORE or found.margin < SURE_MARGIN:
        return False
    return count_matches(query.matches, found.best.pose) >= SURE_MATCHES


def is_clear(query: Query, hypotheses: Sequence[Hypothesis]) -> bool:
    """True if one pose explains a whole photo, and no other does."""
    found = select(query, rank(hypotheses))
    return found.best.score >= CLEAR_SCORE and found.margin >= CLEAR_MARGIN
