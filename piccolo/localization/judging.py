"""A photo's way from its refined poses to a result: evidence is gathered, then the judge decides.

Photos that help each other end here too, each with a pose and probabilities that others told.
"""

from functools import partial
from typing import NamedTuple

from ..arrays import Array
from ..confidence.confidence import posterior
from ..confidence.localization import Localization
from ..evidence.examine import complete
from ..evidence.focal_length import FocalFit, doubt_unconfirmed, fit_focal
from ..evidence.measuring import Fit, describe_geometry, measure
from ..geometry.pose_gaussian import PoseGaussian, probability_within
from ..jobs.threads import Workers
from ..judge.candidate import Candidate, Selection
from ..judge.case import Case
from ..judge.decide import conclude, doubt_given
from ..judge.selection import assess, credit_copies, is_mirrored
from ..problem.prior import contradictions
from ..problem.problem import Problem
from .copies import list_reported
from .ladder import settle
from .means import Means, Step, describe_selection
from .mirror import find_mirrored

WORTH_ASKING = 0.2  # least probability of all poses together, for which the mirrored photo is tried


class Found(NamedTuple):
    """The poses found for a photo, refined."""

    problem: Problem
    selection: Selection
    fit: Fit | None  # None if the poses are faint, or nothing was fitted

    def forget(self) -> "Found":
        """Return this without what takes memory."""
        return Found(self.problem.forget(), self.selection.forget(), self.fit)


def judge(found: Found, means: Means, min_confidence: float, may_promote: bool = True) -> Localization:
    """Return the result for the best pose of a photo by itself.

    If `may_promote`, a copy of the best pose's place that turns out likelier becomes the best.
    """
    problem, selection, fit = found
    workers = means.workers
    selection = complete(problem, selection, workers)
    measured = measure(problem, selection, fit, workers)
    if measured is None:
        return Localization()
    reported, is_copy = list_reported(problem, selection, means.effort, workers)
    standings = credit_copies(assess(problem.profile, reported), is_copy)
    within = probability_within(measured.errors.gaussian)
    probabilities = posterior(standings, measured.errors.std_of_fit, within)
    likeliest = int(probabilities[:-1].argmax())
    if likeliest and is_copy[likeliest] and may_promote:
        other = promote(problem, selection, reported.ranked[likeliest], fit, workers)
        return judge(other, means, min_confidence, may_promote=False)
    if isinstance(fit, FocalFit):
        fit = doubt_unconfirmed(fit, measured.errors.gaussian)
    case = Case(reported, tuple(standings), measured, fit and describe_geometry(problem, fit))
    return decide_case(problem, case, probabilities, means, min_confidence)


def promote(
    problem: Problem, selection: Selection, copy: Candidate, fit: Fit | None, workers: Workers
) -> Found:
    """Make a copy of the best pose's place the best."""
    best = settle(problem, copy, workers)
    others = [h for h in selection.ranked if h.pose is not copy.pose]
    ratios = [h.seen.compute_ratio(best.seen) for h in others]
    promoted = complete(problem, Selection(best, tuple(others), max(ratios)), workers)
    if isinstance(fit, FocalFit):
        fit = fit_focal(problem, promoted.best, workers, is_first=False)
    return Found(problem, promoted, fit)


def judge_together(
    found: Found,
    gaussian: PoseGaussian,
    probabilities: Array,
    means: Means,
    min_confidence: float,
) -> Localization:
    """Return the result of a photo whose pose is what it and others say together.

    `gaussian` is that pose in the map; the best candidate has the same pose. `probabilities` (K + 1,) are of
    it, of each alternative and of none, by all photos together, each that the pose is within 0.1 m. The doubt
    about a focal length is not in them. What the photo itself rules out stays so.
    """
    problem, selection, fit = found
    selection = complete(problem, selection, means.workers)
    measured = measure(problem, selection, fit, means.workers)
    if measured is None:
        return Localization()
    measured = measured._replace(
        pose=gaussian.pose,
        errors=measured.errors._replace(gaussian=gaussian),
        contradicted=contradictions(problem.scan_map, gaussian.pose, problem.prior),
    )
    standings = tuple(assess(problem.profile, selection))
    case = Case(selection, standings, measured, fit and describe_geometry(problem, fit))
    return decide_case(problem, case, probabilities, means, min_confidence)


def decide_case(
    problem: Problem, case: Case, probabilities: Array, means: Means, min_confidence: float
) -> Localization:
    """Return the result of a case; the mirrored photo is searched if any pose is likely."""
    probabilities = doubt_given(probabilities, case.geometry)
    best = case.found.best
    if probabilities[-1] < 1.0 - WORTH_ASKING:
        mirrored = find_mirrored(problem, best, means.effort, means.workers)
        case = case._replace(is_mirrored=is_mirrored(best, mirrored))
    means.trace.note("judged", partial(describe_case, problem, case, probabilities))
    return conclude(problem.scan_map, case, probabilities, min_confidence)


def describe_case(problem: Problem, case: Case, probabilities: Array) -> Step:
    """Describe what the judge read of a photo, and the probabilities of its poses and of none."""
    geometry = case.geometry
    errors = case.measured.errors
    return {
        "probabilities": probabilities.tolist(),
        "standings": [standing._asdict() for standing in case.standings],
        "within": probability_within(errors.gaussian),
        "std_of_fit": errors.std_of_fit,
        "doubt": geometry.doubt if geometry else 0.0,
        "conflict": geometry.conflict if geometry else 0.0,
        "is_mirrored": case.is_mirrored,
        **describe_selection(problem, case.found),
    }
