"""A photo's way from its refined poses to a result: evidence is gathered, then the judge decides.

Photos that help each other end here too, each with a pose and probabilities to which others contributed.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

from ..evidence.contradictions import contradictions
from ..evidence.examine import complete
from ..evidence.focal_length import FocalFit, doubt_unconfirmed, fit_focal
from ..evidence.measuring import Fit, describe_geometry, measure
from ..geometry.pose_gaussian import PoseGaussian
from ..judge.belief import NOTHING, Belief, make_belief
from ..judge.candidate import Candidate, Selection
from ..judge.case import Case
from ..judge.conclude import conclude
from ..judge.probability import Mirrored, posterior, share_unmirrored
from ..judge.reasons import MIRRORED, Reason
from ..judge.result import Result, nothing_found
from ..judge.selection import assess, assess_mirrored, credit_copies, is_mirrored
from ..problem.accuracy import Demand
from ..problem.problem import Problem
from ..system.jobs.threads import Workers
from .copies import list_reported
from .ladder import settle
from .means import Means, Step, describe_selection
from .mirror import find_mirrored


class Found(NamedTuple):
    """The poses found for a photo, refined, with all evidence by which they are chosen."""

    problem: Problem
    selection: Selection
    fit: Fit | None  # None if the poses are faint, or nothing was fitted

    def forget(self) -> "Found":
        """Return the poses without the images and matches, which take memory."""
        return Found(self.problem.forget(), self.selection.forget(), self.fit)

    def confirm(self) -> "Found":
        """Return the poses with a camera that is as other photos say: a single one does not contradict it."""
        if not isinstance(self.fit, FocalFit):
            return self
        return self._replace(fit=self.fit._replace(conflict=0.0))


def judge(found: Found, means: Means, demand: Demand, may_promote: bool = True) -> Result:
    """Return the result for the best pose of a photo by itself.

    If `may_promote`, a copy of the best pose's place that turns out likelier becomes the best.
    """
    problem, selection, fit = found
    workers = means.workers
    if problem.is_mirrored:
        return nothing_found(MIRRORED, belief=NOTHING.rule_out(Reason.MIRRORED))
    measured = measure(problem, selection, fit, workers)
    if measured is None:
        return nothing_found()
    reported, is_copy = list_reported(problem, selection, means.effort, workers)
    standings = credit_copies(assess(problem.profile, reported), is_copy)
    std_of_fit = measured.errors.std_of_fit
    places = posterior(standings, std_of_fit, problem.method)[:-1]
    likeliest = int(places.argmax())
    if likeliest and is_copy[likeliest] and may_promote:
        other = promote(problem, selection, reported.candidates[likeliest], fit, workers)
        return judge(other, means, demand, may_promote=False)
    belief = make_belief(places, demand.accuracy.probability(measured.errors.gaussian))
    if isinstance(fit, FocalFit):
        fit = doubt_unconfirmed(fit, measured.errors.gaussian, demand.accuracy)
        if fit.of_difference is not None:
            measured = measured._replace(errors=measured.errors.widen(fit.of_difference))
    case = Case(reported, tuple(standings), measured, fit and describe_geometry(problem, fit))
    case = try_mirrored(problem, case, belief, means)
    places = posterior(standings, std_of_fit, problem.method, mirrored=case.mirrored)[:-1]
    belief = make_belief(places, belief.within).scale(
        share_unmirrored(standings, case.mirrored, problem.method)
    )
    return decide_case(problem, case, belief, means, demand.min_confidence)


def promote(
    problem: Problem, selection: Selection, copy: Candidate, fit: Fit | None, workers: Workers
) -> Found:
    """Put a copy of the best pose's place first, refined, with the evidence that belongs to it."""
    best = settle(problem, copy, workers)
    others = [h for h in selection.candidates if h.pose is not copy.pose]
    ratios = [h.comparison.compute_ratio(best.comparison) for h in others]
    promoted = complete(problem, Selection(best, tuple(others), max(ratios)), workers)
    if isinstance(fit, FocalFit):
        fit = fit_focal(problem, promoted.best, workers, is_first=False)
    return Found(problem, promoted, fit)


def gather_case(found: Found, gaussian: PoseGaussian, means: Means) -> Case | None:
    """Return the case of a photo whose pose was estimated from this photo and others together.

    `gaussian` is that pose in the map; the best candidate has the same pose. A pose that the photo itself
    rules out stays ruled out. None if the scan shows nothing there.
    """
    problem, selection, fit = found
    selection = complete(problem, selection, means.workers)
    measured = measure(problem, selection, fit, means.workers)
    if measured is None:
        return None
    measured = measured._replace(
        pose=gaussian.pose,
        errors=measured.errors._replace(gaussian=gaussian),
        contradicted=contradictions(problem.scan_map, gaussian.pose, problem.prior),
    )
    standings = tuple(assess(problem.profile, selection))
    return Case(selection, standings, measured, fit and describe_geometry(problem, fit))


def try_mirrored(problem: Problem, case: Case, belief: Belief, means: Means) -> Case:
    """Return a case with the evidence for the mirrored photo, which is searched if any pose is likely.

    It is not searched if that evidence is known.
    """
    best = case.found.best
    belief = doubt_geometry(case, belief)
    if case.mirrored is not None or belief.sound_places[-1] >= 1.0 - problem.method.worth_asking:
        return case
    return case._replace(mirrored=gather_mirrored(problem, best, means))


def gather_mirrored(problem: Problem, best: Candidate, means: Means) -> Mirrored:
    """Search the mirrored photo, and return the evidence for it."""
    mirrored = find_mirrored(problem, best, means.effort, means.workers)
    if mirrored is None:
        return Mirrored(None)
    standing = assess_mirrored(problem.profile, best, mirrored)
    return Mirrored(standing, is_mirrored(problem.method, best, mirrored))


def doubt_geometry(case: Case, belief: Belief) -> Belief:
    """Return a belief with the doubt about the photo's geometry: no pose is surer than what it rests on."""
    return belief if case.geometry is None else replace(belief, doubt=case.geometry.doubt)


def decide_case(problem: Problem, case: Case, belief: Belief, means: Means, min_confidence: float) -> Result:
    """Return the result of a case."""
    belief = doubt_geometry(case, belief)
    found = conclude(problem.scan_map, case, belief, min_confidence)
    means.trace.note("judged", partial(describe_case, problem, case, found.belief))
    return found


def describe_case(problem: Problem, case: Case, belief: Belief) -> Step:
    """Describe the evidence of a photo that the judge has read, and the belief that follows."""
    return {
        "place": list(belief.place),
        "within": belief.within,
        "doubt": belief.doubt,
        "ruled_out": sorted(belief.ruled_out),
        "standings": [standing._asdict() for standing in case.standings],
        "std_of_fit": case.measured.errors.std_of_fit,
        "conflict": case.geometry.conflict if case.geometry else 0.0,
        "is_mirrored": case.is_mirrored,
        "mirrored": case.mirrored and case.mirrored.standing and case.mirrored.standing._asdict(),
        **describe_selection(problem, case.found),
    }
