"""What speaks for each of several poses, and which of them is the best for all of it."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import CLEAR_MATCHES, CONTRADICTED, Standing, log_odds
from ..geometry.pose import Pose
from ..local_features.hypotheses import count_matches
from .comparison import compare
from .prior import contradictions
from .query import Query
from .search_result import SearchResult


def num_matches_of(query: Query, pose: Pose) -> int:
    """How many features of the photo agree with a pose; where none is asked, what a clear view is worth."""
    return count_matches(query.matches, pose) if query.by_features else CLEAR_MATCHES


def standings_of(query: Query, best: Hypothesis, others: Sequence[Hypothesis]) -> list[Standing]:
    """What speaks for the best pose and for others elsewhere, compared over what both views show."""
    at_best = compare(query, best.pose)
    shares = [1.0, *(compare(query, h.pose).ratio_to(at_best) for h in others)]
    return [s._replace(share=v) for s, v in zip(standings_alone(query, [best, *others]), shares, strict=True)]


def standings_alone(query: Query, poses: Sequence[Hypothesis]) -> list[Standing]:
    """Return what speaks for each of several poses by itself.

    Those that contradict the prior share the odds that it is wrong.
    """
    is_wrong = [bool(contradictions(query.scan_map, h.pose, query.settings.prior)) for h in poses]
    log_prior = math.log(CONTRADICTED / max(sum(is_wrong), 1))
    return [
        Standing(1.0, h.score, num_matches_of(query, h.pose), log_prior if wrong else 0.0)
        for h, wrong in zip(poses, is_wrong, strict=True)
    ]


def odds_by_pair(query: Query, poses: Sequence[Hypothesis]) -> NDArray[np.float64]:
    """Log odds (N, N) of each pose, a column, against each, a row, over what the two show."""
    seen = list(query.workers.map(lambda h: compare(query, h.pose), poses, "compare"))
    alone = standings_alone(query, poses)
    odds = [
        [log_odds(a._replace(share=c.ratio_to(best))) for a, c in zip(alone, seen, strict=True)]
        for best in seen
    ]
    return np.array(odds) - np.diag(odds)[:, None]


def fairly_selected(query: Query, found: SearchResult) -> SearchResult:
    """The same with the margin over what both views show, and as best the pose with the greatest odds.

    As each two are compared over other parts of the sphere, three poses may beat each other in turn: the best
    is the one that is beaten least (minimax; Simpson 1969, Kramer 1977). The others follow by their odds.
    """
    if not found.alternatives:
        return found
    ranked = [found.best, *found.alternatives]
    odds = odds_by_pair(query, ranked)
    worst = np.where(np.eye(len(ranked), dtype=bool), -np.inf, odds).max(axis=1)
    best = int(np.argmin(worst))
    order = [int(k) for k in np.argsort(-odds[best], kind="stable") if k != best]
    others, at_best = tuple(ranked[k] for k in order), compare(query, ranked[best].pose)
    rival_ratio = max(compare(query, h.pose).ratio_to(at_best) for h in others)
    return replace(found, best=ranked[best], alternatives=others, rival_ratio=rival_ratio)
