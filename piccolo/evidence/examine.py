"""Make candidates, and complete their evidence for the judge."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ..geometry.nearness import CONFIRMED
from ..geometry.pose import Pose
from ..judge.candidate import NO_CANDIDATE, Candidate, Selection
from ..judge.selection import list_drawn, select
from ..local_features.hypotheses import count_inliers
from ..problem.problem import Problem
from ..problem.profile import DRAWN_VIEW
from ..system.jobs.threads import Workers
from .comparison import compare
from .contradictions import contradictions
from .verification import draw_near, match_again, verify

DRAWN_CHANCE = 0.2  # correlation that wrong poses reach in a block of drawn edges, which are sharp


def examine(problem: Problem, pose: Pose, near: Candidate | None = None) -> Candidate:
    """Compare the scan at a pose with the photo.

    `near` is a candidate from which the pose was reached. The scan that was drawn at that candidate is used
    here too, if the two poses are near enough to each other.
    """
    comparison = compare(problem, pose)
    found = check_prior(problem, Candidate(pose, comparison.score, comparison))
    return found if near is None else replace(found, unoccluded=near.unoccluded, drawn=near.drawn)


def examine_again(problem: Problem, before: Candidate, workers: Workers) -> Candidate:
    """Compare the scan at a candidate's pose with the photo, whose calibration was another before.

    The scan that was drawn near the pose is the same, and is only matched again.
    """
    drawn = before.drawn and match_again(problem, before.drawn, workers)
    return examine(problem, before.pose, replace(before, unoccluded=None, drawn=drawn))


def check_prior(problem: Problem, candidate: Candidate) -> Candidate:
    """Return a candidate with its contradictions to the prior."""
    found = contradictions(problem.scan_map, candidate.pose, problem.prior)
    return replace(candidate, against_prior=found)


def examine_each(problem: Problem, poses: Sequence[Pose], workers: Workers) -> list[Candidate]:
    """Compare the scan at several poses with the photo."""
    return workers.map(partial(examine, problem), poses, "compare")


def count_agreeing(problem: Problem, candidate: Candidate, workers: Workers) -> Candidate:
    """Count the photo's features that agree with the scan drawn at a candidate.

    The features are counted that agree with the best pose near the candidate. If that pose is farther away,
    as it may be where surfaces are far, those that agree with the candidate itself are counted, if they are
    more than by chance.
    """
    drawn = draw_near(problem, candidate.pose, candidate.drawn, workers)
    found = verify(problem, candidate.pose, drawn.matches)
    count = found.num_matches
    if not CONFIRMED.holds(found.pose, candidate.pose):
        agreeing = count_inliers(drawn.matches, candidate.pose, problem.method.cos_agree)
        count = agreeing if agreeing > problem.method.chance_matches else 0
    return replace(candidate, num_matches=count, drawn=drawn)


def complete(problem: Problem, found: Selection, workers: Workers) -> Selection:
    """Complete the evidence of ranked candidates: the scan is drawn at the best, and at those that could win.

    In a scan without colours its edges are drawn at all of them.
    """

    def fill(candidate: Candidate) -> Candidate:
        if candidate.num_matches is not None:
            return candidate
        return count_agreeing(problem, candidate, workers)

    def fill_edges(candidate: Candidate) -> Candidate:
        if candidate.edge_score is not None:
            return candidate
        drawn = compare(problem, candidate.pose, DRAWN_VIEW)
        return replace(candidate, edge_score=drawn.score_beyond(DRAWN_CHANCE))

    if found.best is NO_CANDIDATE:
        return found
    if problem.profile.has_shape:
        return found.take([fill_edges(candidate) for candidate in found.candidates])
    if not problem.profile.uses_matches:
        return found
    ranked = [fill(found.best), *found.alternatives]
    is_rival = list_drawn(problem.profile, ranked)
    rivals = [h for h, is_one in zip(ranked, is_rival, strict=True) if is_one]
    filled = iter(workers.map(fill, rivals, "verify"))
    return found.take([next(filled) if is_one else h for h, is_one in zip(ranked, is_rival, strict=True)])


def choose(problem: Problem, found: Selection, workers: Workers) -> Selection:
    """Complete the evidence of ranked candidates, and select the best by all of it; the only way to select.

    Beside another best, further candidates may be rivals: their evidence is then completed too, but nothing
    is selected again.
    """
    chosen = select(problem.profile, complete(problem, found, workers))
    return complete(problem, chosen, workers)
