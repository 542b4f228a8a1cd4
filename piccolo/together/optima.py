"""Optima of the loss near a photo's own pose, whose distances count as errors of that pose.

A photo of bare walls fits poses along a line nearly equally well, and has optima all along it. The covariance
at one of them tells nothing of the others. So descents begin on both sides of the pose, along the two
directions that the photo determines least. Each end is weighted by its odds against the pose itself, as poses
elsewhere are.
"""

from collections.abc import Mapping

import numpy as np

from ..evidence.examine import complete, examine_each
from ..geometry.nearness import ONE_IN_BUNDLE
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian, add
from ..judge.candidate import Candidate, Selection
from ..judge.probability import LOCALIZED, log_odds
from ..judge.selection import assess
from ..localization.ladder import refine
from ..problem.problem import Problem
from ..problem.stages import FINE
from ..system.arrays import Array
from ..system.jobs.threads import Workers
from .bundle_search import Support
from .members import Member
from .relation import list_weak_steps, spread_over


def widen_unsure(
    members: Mapping[int, Member], supports: Mapping[int, Support], workers: Workers
) -> dict[int, Support]:
    """Return the evidence of photos, by number, with optima near the own poses of those not sure alone."""
    widened = dict(supports)
    for number, support in supports.items():
        member = members[number]
        is_sure = member.alone.status == LOCALIZED and member.is_best(support.own.pose)
        if support.gaussian is not None and support.shares.argmax() == 0 and not is_sure:
            problem = member.found.problem.forget()
            errors = spread_optima(problem, support.own, support.gaussian, workers)
            widened[number] = support._replace(gaussian=support.gaussian.blur(errors))
    return widened


def spread_optima(problem: Problem, own: Candidate, gaussian: PoseGaussian, workers: Workers) -> Array:
    """Return the errors (6, 6) of a photo's own pose by the optima near it."""

    def descend_from(step: Array) -> Pose:
        return refine(problem, add(own.pose, step), workers, FINE).pose

    steps = list_weak_steps(np.asarray(np.linalg.inv(gaussian.covariance), np.float64))
    ends = workers.map(descend_from, steps, "refine")
    near = [end for end in ends if ONE_IN_BUNDLE.holds(end, own.pose)]
    found = complete(problem, Selection(own, tuple(examine_each(problem, near, workers))), workers)
    odds = np.array([log_odds(standing, problem.method) for standing in assess(problem.profile, found)])
    return spread_over([one.pose for one in found.candidates], own.pose, np.exp(odds - odds.max()))
