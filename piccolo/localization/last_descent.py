"""The best poses refined to the top of the ladder, until one stays the best."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ..confidence.alternatives import Hypothesis
from .ladder import climb_to_full, climb_unoccluded, settle
from .query import Query
from .selection import FAINT_SCORE, Selection, rank, select
from .verification import CHANCE_MATCHES, SURE_MATCHES, count_each

HOPELESS_SCORE = 0.02  # black, white and noisy pictures, and most photos of other places, have less
NEAR_SCORE = 0.6  # an alternative with this fraction of the best score is refined like the best
MAX_REFINED = 4  # alternatives


def refine_best(query: Query, hypotheses: Sequence[Hypothesis]) -> Selection:
    """Refine the best hypothesis and the alternatives that come near it, and select the best.

    If all are faint, only the best is refined first, on fine cells; if it stays faint, refinement ends.
    """
    found = rank(hypotheses)
    if found.best.score < HOPELESS_SCORE:
        return found
    if is_faint(query, found):
        best = climb_unoccluded(query, found.best.pose)[1]
        found = select(query, rank([best, *found.alternatives]))
        if is_faint(query, found):
            return found
    _, *of_others = count_each(query, found.best, found.alternatives)
    near: list[Hypothesis] = []
    far: list[Hypothesis] = []
    for h, count in zip(found.alternatives, of_others, strict=True):
        is_near = h.score > NEAR_SCORE * found.best.score or count >= SURE_MATCHES
        (near if is_near and len(near) < MAX_REFINED else far).append(h)
    if not near:
        best = climb_unoccluded(query, found.best.pose)[1]
        return settle_best(query, rank([best, *found.alternatives]))
    poses = [h.pose for h in (found.best, *near)]
    ends = query.workers.map(partial(climb_to_full, query), poses, "descend")
    return settle_best(query, select(query, rank([*ends, *far])))


def is_faint(query: Query, found: Selection) -> bool:
    """Return True if all poses are faint and no more features agree than by chance: refinement soon ends."""
    scores = [h.score for h in (found.best, *found.alternatives)]
    if max(scores) >= FAINT_SCORE:
        return False
    return max(count_each(query, found.best, found.alternatives)) <= CHANCE_MATCHES


def settle_best(query: Query, found: Selection) -> Selection:
    """Refine the best pose to convergence; repeat if another becomes the best."""
    at_rest: list[Hypothesis] = []
    with query.workers.beside(partial(query.surroundings_at, found.best.pose)):  # it hardly moves
        for _ in range(1 + len(found.alternatives)):
            best = settle(query, found.best)
            at_rest.append(best)
            found = select(query, replace(found, best=best))
            if any(found.best is h for h in at_rest):
                break
    return found
