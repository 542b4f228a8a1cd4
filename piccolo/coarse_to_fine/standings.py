"""What speaks for each of several poses, and which of them is the best for all of it."""

from collections.abc import Sequence
from dataclasses import replace

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import Standing, log_odds
from ..local_features.hypotheses import count_matches
from .comparison import compare
from .query import Query
from .search_result import SearchResult


def standings_of(query: Query, best: Hypothesis, others: Sequence[Hypothesis]) -> list[Standing]:
    """What speaks for the best pose and for others elsewhere, compared over what both views show."""
    at_best = compare(query, best.pose)
    shares = [1.0, *(compare(query, h.pose).ratio_to(at_best) for h in others)]
    return [
        Standing(share, h.score, count_matches(query.matches, h.pose))
        for share, h in zip(shares, [best, *others], strict=True)
    ]


def fairly_selected(query: Query, found: SearchResult) -> SearchResult:
    """The same with the margin over what both views show, and as best the pose with the greatest odds."""
    if not found.alternatives:
        return found
    ranked = [found.best, *found.alternatives]
    list(query.workers.map(lambda h: compare(query, h.pose), ranked, "compare"))
    odds = [log_odds(standing) for standing in standings_of(query, found.best, found.alternatives)]
    best = max(range(len(ranked)), key=lambda k: odds[k])
    others = tuple(h for k, h in enumerate(ranked) if k != best)
    at_best = compare(query, ranked[best].pose)
    rival_ratio = max(compare(query, h.pose).ratio_to(at_best) for h in others)
    return replace(found, best=ranked[best], alternatives=others, rival_ratio=rival_ratio)
