"""A photo that is expected near a given pose: the pose to which it descends, and how likely that is right."""

from dataclasses import replace
from typing import NamedTuple

from ..evidence.comparison import compare
from ..evidence.contradictions import contradictions
from ..evidence.covariance import estimate_covariance
from ..evidence.examine import complete
from ..evidence.verification import draw_near, verify
from ..geometry.nearness import RIGHT
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian
from ..judge.candidate import Candidate, Selection
from ..judge.case import UNKNOWN_ERRORS
from ..judge.probability import Standing, posterior
from ..judge.selection import assess_alone
from ..problem.problem import Problem
from ..problem.stages import FULL, NEARLY
from ..system.jobs.threads import Workers
from .ladder import climb_from_afar, refine, settle
from .last_descent import HOPELESS_SCORE


class Near(NamedTuple):
    """A pose near one that was given, and how likely it is."""

    end: Candidate
    gaussian: PoseGaussian | None  # the pose with its covariance; None where the points do not fix it
    place: float  # probability that its place is right


def refine_near(problem: Problem, start: Pose, workers: Workers) -> Near:
    """Descend from a pose and from poses around it, then on the points, and judge the end (`assess_end`).

    A partial photo converges slowly: its descent goes on until it settles.
    """
    middle, seen_from = climb_from_afar(problem, start, workers)
    pose = refine(problem, middle, workers, FULL).pose
    compared = compare(problem, pose, seen_from=seen_from if pose.distance(seen_from) < NEARLY else pose)
    end = Candidate(pose, compared.score, compared, contradictions(problem.scan_map, pose, problem.prior))
    if problem.profile.settles_near:
        end = settle(problem, end, workers)
    errors = UNKNOWN_ERRORS
    if end.score >= HOPELESS_SCORE:
        sees_same = end.pose.distance(middle) < NEARLY
        errors = estimate_covariance(problem, end, workers, middle if sees_same else None)
    standing = assess_end(problem, end, workers)
    place = float(posterior([standing], errors.std_of_fit, problem.method)[0])
    return Near(end, errors.gaussian, place)


def assess_end(problem: Problem, end: Candidate, workers: Workers) -> Standing:
    """Return the evidence for a pose by whole views, and for a narrow photo also by its matches there.

    A pose is fitted to the matches with the photos beside, and one without these. Matches of a fitted pose
    that is elsewhere do not count; of the two counts the larger is taken.
    """
    by_views = problem.by_views()
    (standing,) = assess_alone(by_views.profile, complete(by_views, Selection(end, ()), workers).candidates)
    if not problem.profile.is_narrow:
        return standing
    drawn = draw_near(problem, end.pose, end.drawn, workers).matches
    found = [verify(some, end.pose, drawn) for some in (problem, replace(problem, beside=()))]
    own = [v.num_matches for v in found if RIGHT.holds(v.pose, end.pose)]
    return standing._replace(num_matches=max(own, default=0), evidence=problem.profile.evidence)
