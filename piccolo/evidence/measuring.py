"""Measurements of the best candidate: how well it explains a photo, and how well the photo fixes it."""

import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..judge.candidate import Selection
from ..judge.case import Geometry, Measured
from ..judge.result_parts import Evidence
from ..judge.selection import count_matches
from ..optimize.sampling_loss import sampling_loss
from ..problem.problem import Problem
from ..system.jobs.threads import Workers
from ..views.zbuffer import visible_points
from .claimed_sphere import SphereFit
from .contradictions import contradictions
from .covariance import estimate_pose_errors
from .focal_length import FocalFit
from .occlusion import compare_occlusion, measure_agreement

Fit = FocalFit | SphereFit


def measure(problem: Problem, found: Selection, fit: Fit | None, workers: Workers) -> Measured | None:
    """Measure how well the best candidate explains a photo, and how well the photo fixes the pose.

    Pose and loss are those of `estimate_pose_errors`; the evidence is that of the candidate. None if there is
    no pose, or no point is visible from it.
    """
    if found.best.score < 0.0:
        return None
    pose = found.best.pose
    points, coarse = problem.surroundings_at(pose)

    measures: list[Callable[[], Any]] = [
        partial(estimate_pose_errors, problem, found.best, workers),  # takes longest
        partial(compare_occlusion, points, problem.given, pose),
        partial(measure_agreement, coarse, problem.photo.panorama, pose),
    ]
    errors, occlusion, agreement = workers.map(operator.call, measures, "evaluate")
    explained, contradicted = occlusion.fractions()
    end = errors.gaussian.pose if errors.gaussian else pose
    loss = sampling_loss(visible_points(points, end.center_world), problem.colors(), end)
    if not math.isfinite(loss):
        return None
    num_matches = count_matches(problem.profile, found.candidates)
    uses_matches = problem.profile.uses_matches
    evidence = Evidence(
        score=found.best.score,
        margin=found.margin,
        agreement=agreement.value,
        explained_fraction=explained,
        contradicted_fraction=contradicted,
        seen_fraction=agreement.seen_fraction,
        num_matches=num_matches[0] if uses_matches else None,
        alternative_matches=max(num_matches[1:], default=0) if uses_matches else None,
    )
    errors = errors.widen(fit.pose_covariance) if fit else errors
    return Measured(end, errors, loss, evidence, contradictions(problem.scan_map, end, problem.prior))


def describe_geometry(problem: Problem, fit: Fit) -> Geometry:
    """Return the geometry of a photo by its fit, as the judge reads it."""
    std = math.sqrt(float(np.linalg.eigvalsh(fit.pose_covariance[3:, 3:])[-1]))
    found = Geometry(problem.given.cameras, fit.doubt, fit.conflict, std)
    if isinstance(fit, FocalFit):
        return found._replace(
            focal_length=fit.focal_length(problem.given), worst_correction=fit.worst_correction
        )
    return found if fit.is_claimed else found._replace(sphere=fit.describe())
