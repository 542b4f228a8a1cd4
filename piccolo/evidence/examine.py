"""Make candidates with their evidence, complete for those who decide."""

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
from .verification import draw_near, verify

DRAWN_CHANCE = 0.2  # correlation of a block's drawn edges that wrong poses reach: these are sharper


def examine(problem: Problem, pose: Pose, near: Candidate | None = None) -> Candidate:
    """Compare the scan at a pose with the photo.

    `near` is a candidate from which the pose was reached: what was drawn there serves here too, if it is near
    enough.
    """
    seen = compare(problem, pose)
    found = check_prior(problem, Candidate(pose, seen.score, seen))
    return found if near is None else replace(found, unoccluded=near.unoccluded, drawn=near.drawn)


def check_prior(problem: Problem, candidate: Candidate) -> Candidate:
    """Return a candidate with what was given that its pose contradicts."""
    found = contradictions(problem.scan_map, candidate.pose, problem.prior)
    return replace(candidate, against_prior=found)


def examine_each(problem: Problem, poses: Sequence[Pose], workers: Workers) -> list[Candidate]:
    """Compare the scan at several poses with the photo."""
    return workers.map(partial(examine, problem), poses, "compare")


def count_agreeing(problem: Problem, candidate: Candidate, workers: Workers) -> Candidate:
    """Count the photo's features that agree with the scan drawn at a candidate.

    They are those of the best pose near it. If that is farther away, as it may be where surfaces are far,
    they are those that agree with the candidate itself, if there are more than by chance.
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

    It is completed once more for who reads the evidence beside another best; nothing is selected again.
    """
    chosen = select(problem.profile, complete(problem, found, workers))
    return complete(problem, chosen, workers)
