"""Choose the best candidate by all evidence, and decide whether it is sure: pure functions of candidates."""

import math
from collections.abc import Mapping, Sequence
from itertools import compress

import numpy as np

from ..problem.method import Method
from ..problem.profile import Profile
from .alternatives import alternative_poses, sort_by_score
from .candidate import MAX_COMPARED, NO_CHOICE, Candidate, Selection
from .probability import CONTRADICTED_ODDS, MOST_RATIO, Standing, log_odds

# Chosen: log odds of a mirrored photo against the photo as it is. Of 15 photos of a hospital none had more
# than 0.41; one of the mirrored photos of racks had 2.3.
LEAST_MIRRORED_ODDS = 1.0


def rank(candidates: Sequence[Candidate]) -> Selection:
    """Return the best candidate by score, and at most MAX_COMPARED elsewhere; NO_CHOICE if there are none."""
    if not candidates:
        return NO_CHOICE
    best = sort_by_score(candidates)[0]
    return Selection(best, tuple(alternative_poses(best, candidates, count=MAX_COMPARED)))


def list_drawn(profile: Profile, ranked: Sequence[Candidate]) -> list[bool]:
    """Return True for candidates at which the scan must be drawn: the best, and those that may beat it.

    The best comes first; its matches must be known. A pose can't win if it explains far less than a pose with
    which many features agree.
    """
    if not profile.uses_matches:
        return [False] * len(ranked)
    best, *others = ranked
    is_sure = (best.num_matches or 0) >= profile.method.sure_matches
    could_win = [not is_sure or h.score >= profile.method.rival_score * best.score for h in others]
    if profile.most_rivals is not None:
        allowed = list(np.cumsum(could_win) <= profile.most_rivals)
        could_win = [could and bool(allows) for could, allows in zip(could_win, allowed, strict=True)]
    return [True, *could_win]


def count_matches(profile: Profile, ranked: Sequence[Candidate]) -> list[int]:
    """Return the number of matches of each ranked candidate, the best first; 0 of those that can't win."""
    counts = zip(ranked, list_drawn(profile, ranked), strict=True)
    return [(h.num_matches or 0) if is_rival else 0 for h, is_rival in counts]


def assess_alone(profile: Profile, ranked: Sequence[Candidate]) -> list[Standing]:
    """Return the evidence for each of several candidates, not yet relative to the best, which is the first.

    Poses that contradict the prior share the odds that the prior is wrong.
    """
    is_wrong = [bool(h.against_prior) for h in ranked]
    log_prior = math.log(CONTRADICTED_ODDS / max(sum(is_wrong), 1))
    counts = count_matches(profile, ranked)
    standings = []
    for h, wrong, count in zip(ranked, is_wrong, counts, strict=True):
        num_matches = count if profile.uses_matches else None
        drawn = None if h.edge_score is None else h.edge_score * profile.discount
        of_prior = h.log_by_others + (log_prior if wrong else 0.0)
        score = profile.discount * h.score
        standings.append(Standing(1.0, score, num_matches, profile.evidence, of_prior, drawn))
    return standings


def assess(profile: Profile, found: Selection) -> list[Standing]:
    """Return the evidence for each candidate, compared with the best over the area that both views show."""
    ratios = [1.0, *(h.comparison.compute_ratio(found.best.comparison) for h in found.alternatives)]
    alone = assess_alone(profile, found.candidates)
    return [standing._replace(ratio=ratio) for standing, ratio in zip(alone, ratios, strict=True)]


def select(profile: Profile, found: Selection) -> Selection:
    """Select the candidate with the greatest odds, each pair compared over the area that both views show.

    Each pair is compared over another part of the sphere, so three poses may beat each other in turn. The
    best is the one that is beaten least (minimax; Simpson 1969, Kramer 1977); the others follow by odds.
    """
    if not found.alternatives:
        return found
    method = profile.method
    ranked = found.candidates
    alone = assess_alone(profile, ranked)
    ratios = [[other.comparison.compute_ratio(one.comparison) for other in ranked] for one in ranked]
    odds = np.array(
        [[log_odds(a._replace(ratio=v), method) for a, v in zip(alone, row, strict=True)] for row in ratios]
    )
    odds -= np.diag(odds)[:, None].copy()  # of the pose of each column against that of each row
    worst = np.where(np.eye(len(ranked), dtype=bool), -np.inf, odds).max(axis=1)
    best = int(np.argmin(worst))
    others = [int(k) for k in np.argsort(-odds[best], kind="stable") if k != best]
    rival_ratio = max(ratios[best][k] for k in others)
    return Selection(ranked[best], tuple(ranked[k] for k in others), rival_ratio)


def is_sure(profile: Profile, found: Selection) -> bool:
    """Return True if the matches of the selected candidate and its odds against the others end the search."""
    method = profile.method
    best, *others = assess(profile, found)
    if (best.num_matches or 0) < method.sure_matches:
        return False
    odds = log_odds(best, method)
    return all(odds - log_odds(other, method) >= method.sure_odds for other in others)


def is_clear(profile: Profile, found: Selection) -> bool:
    """Return True if one candidate alone explains a whole photo."""
    return found.best.score >= profile.clear_score and found.margin >= profile.method.clear_margin


def is_faint(profile: Profile, found: Selection) -> bool:
    """Return True if all scores are faint and no more features agree than by chance: refinement soon ends."""
    if max(h.score for h in found.candidates) >= profile.method.faint_score:
        return False
    return max(count_matches(profile, found.candidates)) <= profile.method.chance_matches


def assess_mirrored(profile: Profile, best: Candidate, mirrored: Candidate) -> Standing:
    """Return the evidence for the best pose of the mirrored photo, compared with the photo as it is."""
    (alone,) = assess_alone(profile, [mirrored])
    ratio = mirrored.score / best.score if best.score > 0.0 else MOST_RATIO
    return alone._replace(ratio=ratio)


def explains_more(method: Method, mirrored: Candidate, own: Candidate) -> bool:
    """Return True if the mirrored photo is explained better; in a symmetric scene both are about equal."""
    return mirrored.score > method.mirror_ratio * own.score


def is_mirrored(method: Method, own: Candidate, mirrored: Candidate) -> bool:
    """Return True if a photo fits better mirrored: a pose explains more, and more features agree with it."""
    if not explains_more(method, mirrored, own):
        return False
    return (mirrored.num_matches or 0) > (own.num_matches or 0)


def select_mirrored(differences: Mapping[int, float], one_is_mirrored: bool) -> list[int]:
    """List which of linked photos were mirrored.

    `differences` has the log odds of each mirrored photo less those of the photo as it is. The largest
    difference, for or against, decides for all: that photo shows the most. Similar things may link a mirrored
    photo with one that is not; so if one is known to be mirrored, each photo is decided by its own too.
    """
    if max(differences.values(), key=abs, default=0.0) >= LEAST_MIRRORED_ODDS:
        return list(differences)
    return [k for k, value in differences.items() if one_is_mirrored and value >= LEAST_MIRRORED_ODDS]


def credit_copies(standings: Sequence[Standing], is_copy: Sequence[bool]) -> list[Standing]:
    """Give every copy of a place the greatest number of matches among the copies.

    The number of matches depends on how well a copy was scanned, not on whether the photo was taken there.
    The same holds for edges: in a scan without colours every copy gets the best pose's evidence.
    """
    if standings[0].evidence == "shape":
        best = standings[0]
        credited = [best._replace(log_prior=s.log_prior) for s in standings]
        return [c if copied else s for c, s, copied in zip(credited, standings, is_copy, strict=True)]
    most = max((s.num_matches or 0 for s in compress(standings, is_copy)), default=0)
    pairs = zip(standings, is_copy, strict=True)
    return [s._replace(num_matches=most) if copied else s for s, copied in pairs]
