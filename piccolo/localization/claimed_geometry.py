"""The geometry that a photo claims is compared with the scan; the poses are refined with the one found."""

import math
import operator
from dataclasses import replace
from functools import partial

import numpy as np

from ..evidence.claimed_sphere import (
    CLAIM,
    NO_CORRECTION,
    SPHERE_CURVATURE,
    SphereFit,
    count_deviations,
    make_freedom,
    search_geometry,
)
from ..evidence.examine import examine, examine_again, examine_each
from ..evidence.focal_length import FOCAL_WIDTHS, FocalFit, fit_focal, list_matches
from ..evidence.lens_matches import fit_matches
from ..evidence.self_calibration import FreeEnd, descend_freely, estimate_corrections
from ..geometry.pose import Pose, rotate_points
from ..geometry.pose_gaussian import add
from ..judge.candidate import Selection
from ..photo.camera import Camera, Mount
from ..photo.camera.corrections import FOCAL, Corrections
from ..photo.camera.model import whole_sphere
from ..photo.panorama import Panorama
from ..problem.problem import Problem
from ..problem.stages import Limits
from ..system.arrays import Array, Array32
from ..system.jobs.threads import Workers
from .ladder import climb_unoccluded, settle
from .last_descent import refine_best

MIN_CALIBRATED_SCORE_LEFT = 0.95  # fraction of the score that a pose must keep with another focal length
MAX_CALIBRATIONS = 4  # fits of a focal length
SUSPECT = 0.8  # deviations between claim and picture, from which other geometries are searched
CONTRADICTED_DEVIATIONS = 3.0  # between claim and picture, from which another geometry may replace the claim
MIN_RETAKE_GAIN = 1.1  # least score with another geometry, as a multiple of the score with the claim
MOST_ROUNDS = 6
CHECK_LIMITS = Limits(1.0, 8, 1e-3)
FULL_LIMITS = Limits(0.7, 15, 1e-4)  # on points, where the claim does not hold
HERE_LIMITS = Limits(0.7, 1, 1e-4)  # on points, where the claim holds: the end shows how exact it is


def calibrate(problem: Problem, found: Selection, workers: Workers) -> tuple[Problem, Selection, FocalFit]:
    """Fit the focal length at the best pose, and refine the poses with it, until it hardly changes.

    At wrong poses it may change no less from fit to fit; then it is not fitted again. The last change is
    applied too, so that the focal length found lies between the given one and that of the picture.
    """
    problem, found = follow_matches(problem, found, workers)
    fit = fit_focal(problem, found.best, workers)
    before = math.inf
    for _ in range(MAX_CALIBRATIONS):
        change = float(np.abs(fit.change).max())
        if fit.is_at_rest or change >= before:
            break
        before = change
        problem, found = refine_with(problem, found, fit.change, fit.move(found.best.pose), workers)
        fit = fit_focal(problem, found.best, workers, is_first=False)
    left = find_change_left(problem.given, fit)
    if left.any():
        moved = add(found.best.pose, fit.motion @ left)
        problem, found = refine_with(problem, found, left, moved, workers)
    return problem, found, fit._replace(change=fit.change - left)


def find_change_left(panorama: Panorama, fit: FocalFit) -> Array:
    """Return the change (p,) that brings the focal length between those of the picture and of the prior."""
    prior = panorama.focal_prior
    assert prior is not None
    left = np.zeros_like(fit.change)
    if fit.opinion is not None:
        now = math.log(panorama.cameras[0].camera.focal[0] / prior.focal)
        least, most = sorted((0.0, fit.opinion.off))
        left[0] = min(max(now, least), most) - now
    return left


def refine_with(
    problem: Problem, found: Selection, change: Array, best: Pose, workers: Workers
) -> tuple[Problem, Selection]:
    """Refine the poses with another calibration, the best one from `best`."""
    problem = recalibrate(problem, change, workers)
    before = [replace(found.best, pose=best), *found.alternatives]
    examined = workers.map(partial(examine_again, problem, workers=workers), before, "compare")
    return problem, refine_best(problem, examined, workers)


def follow_matches(problem: Problem, found: Selection, workers: Workers) -> tuple[Problem, Selection]:
    """Replace the focal length by the one with which most matches agree, if the two clearly differ."""
    matches = list_matches(problem, found.best, workers)
    by_matches = fit_matches(problem.method, problem.given.cameras[0], found.best.pose, matches, FOCAL_WIDTHS)
    change = float(by_matches.values[FOCAL])
    if abs(change) * math.sqrt(by_matches.information) < problem.method.clear_deviations:
        return problem, found
    other = refine_with(problem, found, np.array([change]), by_matches.pose, workers)
    return other if other[1].best.score > MIN_CALIBRATED_SCORE_LEFT * found.best.score else (problem, found)


def recalibrate(problem: Problem, change: Array, workers: Workers) -> Problem:
    """Prepare the problem again with another calibration; its matches stay, with other rays."""
    given = problem.given
    before = given.cameras[0]
    after = before.with_camera(before.camera.change(*change))
    taken = given.resample(after.camera, given.rgb.shape[1])
    beside = tuple(m._replace(rays=_turn_rays(m.rays, before, after)) for m in problem.beside)
    return replace(problem.retake(taken), beside=beside)


def _turn_rays(rays: Array32, before: Mount, after: Mount) -> Array32:
    pixels, _ = before.camera.pixels(rotate_points(rays.astype(np.float64), before.rotation))
    found, _ = after.camera.rays(pixels)
    return np.asarray(rotate_points(found, before.rotation.T), np.float32)


def calibrate_sphere(
    problem: Problem, found: Selection, workers: Workers
) -> tuple[Problem, Selection, SphereFit]:
    """Compare the part of the sphere that a panorama claims with the scan; refine if it is wrong."""
    camera = whole_sphere(*problem.given.rgb.shape[1::-1])
    freedom = make_freedom(camera)
    pose = found.best.pose
    cells = problem.view_at(pose, "fine")
    points = problem.view_at(pose, "points")
    fine = problem.photo.image("fine")
    full = problem.photo.image("full")
    descents = [
        partial(descend_freely, cells, fine, freedom, pose, NO_CORRECTION, CHECK_LIMITS),
        partial(descend_freely, points, full, freedom, pose, NO_CORRECTION, HERE_LIMITS),
    ]
    ends = workers.map(operator.call, descents, "fit the panorama")
    estimate, here = (estimate_corrections(end, SPHERE_CURVATURE) for end in ends)
    is_suspect = count_deviations(estimate) > SUSPECT
    other = retake_as_found(problem, found, camera, workers) if is_suspect else None
    if other is not None:
        return other
    conflict = CLAIM.conflict(estimate.by_picture)
    doubt = CLAIM.doubt(estimate.by_picture)
    return problem, found, SphereFit(camera, here, True, conflict, doubt)


def retake_as_found(
    problem: Problem, found: Selection, claimed: Camera, workers: Workers
) -> tuple[Problem, Selection, SphereFit] | None:
    """Search other geometries; return problem and poses with one that explains clearly more, else None.

    A geometry that explains less than the claimed one is not refined. One that still changes after all rounds
    is not known. The other poses are refined with the geometry found, not in each round.
    """
    end = search_geometry(problem, found.best.pose, claimed, workers)
    if count_deviations(estimate_corrections(end, SPHERE_CURVATURE)) < CONTRADICTED_DEVIATIONS:
        return None
    camera = claimed
    for _ in range(MOST_ROUNDS):
        camera = Corrections(Mount(camera)).apply(end.values)
        retaken = problem.retake(problem.given.retake(camera))
        start = examine(retaken, end.pose)
        if start.score < found.best.score:
            return None
        best = settle(retaken, climb_unoccluded(retaken, start, workers), workers)
        end = descend_on_points(retaken, best.pose, camera)
        if np.all(np.abs(end.values) < CLAIM.deviations):
            break
    else:
        return None
    if best.score < MIN_RETAKE_GAIN * found.best.score:
        return None
    others = examine_each(retaken, [h.pose for h in found.alternatives], workers)
    refined = refine_best(retaken, [best, *others], workers)
    end = descend_on_points(retaken, refined.best.pose, camera)
    fit = SphereFit(camera, estimate_corrections(end, SPHERE_CURVATURE), is_claimed=False)
    return retaken, refined, fit


def descend_on_points(problem: Problem, pose: Pose, camera: Camera) -> FreeEnd:
    """Descend from a pose with the corrections of a panorama's geometry free, on single points."""
    points = problem.view_at(pose, "points")
    full = problem.photo.image("full")
    return descend_freely(points, full, make_freedom(camera), pose, NO_CORRECTION, FULL_LIMITS)
