"""Select the best pose by all evidence, and decide whether it is sure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..confidence.alternatives import Hypothesis, alternative_poses, sort_by_score
from ..confidence.confidence import CONTRADICTED, Standing, log_odds
from ..geometry.pose import Pose
from .comparison import DRAWN_CHANCE, compare
from .prior import contradictions
from .query import Query
from .settings import DRAWN_VIEW
from .verification import SURE_MATCHES, count_each

MAX_COMPARED = 8  # alternatives of the best pose
FAINT_SCORE = 0.1  # a pose with less ends no search: the scan is not drawn to see whether it is sure
SURE_ODDS = 3.0  # [log] least odds of the best pose against any elsewhere: 20 to 1
CLEAR_SCORE = 0.3  # least score by whole views without features: see docs/METHOD.md
CLEAR_SHAPE = 0.1  # least score by edges
CLEAR_MARGIN = 0.5  # least margin by whole views


@dataclass(frozen=True)
class Selection:
    """The best hypothesis, and the best ones elsewhere, best first."""

    best: Hypothesis
    alternatives: tuple[Hypothesis, ...]
    rival_ratio: float = 0.0  # largest ratio of an alternative to the best, over what both views show

    @property
    def margin(self) -> float:
        """Relative lead of the best, at least -1: the lesser of those by score and over both views."""
        by_score = max([0.0, *(h.score for h in self.alternatives)]) / max(self.best.score, 1e-9)
        return max(1.0 - max(self.rival_ratio, by_score), -1.0)


NOTHING = Selection(Hypothesis(Pose(np.eye(3), np.zeros(3)), -1.0), ())


def rank(hypotheses: Sequence[Hypothesis]) -> Selection:
    """Return the best hypothesis by score, and at most MAX_COMPARED elsewhere; NOTHING if there are none."""
    if not hypotheses:
        return NOTHING
    best = sort_by_score(hypotheses)[0]
    return Selection(best, tuple(alternative_poses(best.pose, hypotheses, count=MAX_COMPARED)))


def assess_poses(query: Query, best: Hypothesis, others: Sequence[Hypothesis]) -> list[Standing]:
    """Return the evidence for the best pose and for others, compared over what both views show."""
    at_best = compare(query, best.pose)
    ratios = [1.0, *(compare(query, h.pose).compute_ratio(at_best) for h in others)]
    return [s._replace(ratio=v) for s, v in zip(assess_alone(query, [best, *others]), ratios, strict=True)]


def assess_alone(query: Query, hypotheses: Sequence[Hypothesis]) -> list[Standing]:
    """Return the evidence for each of several poses by itself, the best first.

    Features are not counted for a pose that can't win. Poses that contradict the prior share the odds that
    the prior is wrong.
    """
    is_wrong = [bool(contradictions(query.scan_map, h.pose, query.settings.prior)) for h in hypotheses]
    log_prior = math.log(CONTRADICTED / max(sum(is_wrong), 1))
    counts = count_each(query, hypotheses[0], hypotheses[1:])
    standings = []
    for h, wrong, count in zip(hypotheses, is_wrong, counts, strict=True):
        num_matches = count if query.uses_matches else None
        of_prior = log_prior if wrong else 0.0
        is_shape = query.evidence == "shape"
        # of few blocks chance explains more
        part = math.sqrt(query.photo.small.valid_share) if is_shape and query.photo.is_partial else 1.0
        drawn = compare(query, h.pose, DRAWN_VIEW).score_beyond(DRAWN_CHANCE) * part if is_shape else None
        standings.append(Standing(1.0, part * h.score, num_matches, query.evidence, of_prior, drawn))
    return standings


def select(query: Query, found: Selection) -> Selection:
    """Select the pose with the greatest odds, each pair compared over what both views show.

    Each pair is compared over another part of the sphere, so three poses may beat each other in turn. The
    best is the one that is beaten least (minimax; Simpson 1969, Kramer 1977); the others follow by odds.
    """
    if not found.alternatives:
        return found
    ranked = [found.best, *found.alternatives]
    seen = [compare(query, h.pose) for h in ranked]
    alone = assess_alone(query, ranked)
    ratios = [[other.compute_ratio(one) for other in seen] for one in seen]
    odds = np.array(
        [[log_odds(a._replace(ratio=v)) for a, v in zip(alone, row, strict=True)] for row in ratios]
    )
    odds -= np.diag(odds)[:, None].copy()  # of the pose of each column against that of each row
    worst = np.where(np.eye(len(ranked), dtype=bool), -np.inf, odds).max(axis=1)
    best = int(np.argmin(worst))
    others = [int(k) for k in np.argsort(-odds[best], kind="stable") if k != best]
    rival_ratio = max(ratios[best][k] for k in others)
    return Selection(ranked[best], tuple(ranked[k] for k in others), rival_ratio)


def is_sure(query: Query, hypotheses: Sequence[Hypothesis]) -> bool:
    """Return True if the best pose is not faint, and its matches and its odds end the search."""
    ranked = rank(hypotheses)
    if ranked.best.score < FAINT_SCORE:
        return False
    found = select(query, ranked)
    best, *others = assess_poses(query, found.best, found.alternatives)
    if (best.num_matches or 0) < SURE_MATCHES:
        return False
    return all(log_odds(best) - log_odds(other) >= SURE_ODDS for other in others)


def is_clear(query: Query, hypotheses: Sequence[Hypothesis]) -> bool:
    """Return True if one pose alone explains a whole photo."""
    found = select(query, rank(hypotheses))
    least = CLEAR_SHAPE if query.scan_map.has_shape else CLEAR_SCORE
    return found.best.score >= least and found.margin >= CLEAR_MARGIN
