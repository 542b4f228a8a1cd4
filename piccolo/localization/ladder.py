"""Poses refined on the ladder of stages: from coarse images and views to single points."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..evidence.blocks import take
from ..evidence.comparison import mask_occluders
from ..evidence.examine import examine
from ..geometry.levenberg_marquardt import retract
from ..geometry.pose import Pose, orthonormal
from ..judge.alternatives import Hypothesis
from ..judge.candidate import Candidate
from ..optimize.channel_loss import ChannelProblem, descend_channels, score
from ..photo.panorama.local_normalization import LEVELS_PER_UNIT, to_levels
from ..photo.panorama.texels import Texels
from ..problem.method import Method
from ..problem.problem import Problem
from ..problem.profile import VIEWS
from ..problem.stages import AROUND_FINE, AROUND_MIDDLE, FINE, FULL, LAST, MIDDLE, Limits, Stage, ViewName
from ..system.arrays import Array, Array32, Int32s
from ..system.jobs.threads import Workers
from ..system.kernels.jit import kernel
from ..views.points_around import PLACE_SPACING
from ..views.view import Cells

PERTURBED_BATCH = 3  # perturbed poses that a thread takes at a time
MAX_UNOCCLUDED = 2  # rounds that mask occluders
MIN_POINTS_SCORE_LEFT = 0.9  # fraction of the score that a descent on points must keep


def refine(problem: Problem, start: Pose, workers: Workers, stage: Stage) -> Hypothesis:
    """Descend from a pose as a stage says, on the cells or points of the scan that are seen from there.

    The end is scored on the cells of the view; on points its score is nan.
    """
    cells, blocks = see_cells(problem, start, stage.view)
    if stage.around is None:
        return descend_on(problem, cells, blocks, start, stage)
    return descend_around(problem, cells, blocks, start, stage, workers)


def see_cells(problem: Problem, pose: Pose, view: ViewName) -> tuple[Cells, Int32s]:
    """Return the cells or points of a view that are seen from a pose, and the block of each cell.

    Most cells weigh nothing if the photo shows a part of the sphere; then these are left out.
    """
    cells = problem.view_at(pose, view)
    blocks = VIEWS[view].arrays.blocks
    if view == "points" or not problem.photo.is_partial:
        return cells, blocks
    counts = np.flatnonzero(cells.weights)
    return take(cells, counts), blocks[counts]


def descend_on(problem: Problem, cells: Cells, blocks: Int32s, pose: Pose, stage: Stage) -> Hypothesis:
    """Descend from a pose on the cells or points that are seen from there, and score the end on the cells."""
    image = problem.photo.image(stage.image)
    end = descend(cells, image, pose, stage.limits)
    return Hypothesis(end, math.nan) if stage.view == "points" else score_on_cells(cells, blocks, image, end)


def climb(problem: Problem, start: Pose, workers: Workers) -> Hypothesis:
    """Refine a pose on fine cells, and poses around it, for as long as its score rises."""
    first = see_cells(problem, start, FINE.view)

    def perturb(best: Hypothesis) -> Hypothesis:
        seen = first if best.pose is start else see_cells(problem, best.pose, FINE.view)
        around = descend_around(problem, *seen, best.pose, AROUND_FINE, workers)
        return refine(problem, around.pose, workers, FINE)

    begin = score_on_cells(*first, problem.photo.image(FINE.image), start)
    return replace(climb_by(perturb, begin, problem.method), is_climbed=True)


def climb_by(perturb: Callable[[Hypothesis], Hypothesis], best: Hypothesis, method: Method) -> Hypothesis:
    """Perturb the best pose, and descend from there, for as long as its score rises."""
    for _ in range(method.most_perturbations):
        refined = perturb(best)
        gain = refined.score - best.score
        best = refined if gain > 0.0 else best
        if gain < method.least_gain * refined.score:
            break
    return best


def climb_from_afar(problem: Problem, start: Pose, workers: Workers) -> tuple[Pose, Pose]:
    """Descend from a pose, and from poses around the end for as long as the score on fine cells rises.

    It stops when all of these lead back to the same end. Return also the pose from which the cells of the
    best end were seen.
    """
    end = seen_from = refine(problem, start, workers, MIDDLE).pose
    best = refine(problem, end, workers, FINE)
    for _ in range(problem.method.most_perturbations):
        other = refine(problem, end, workers, AROUND_MIDDLE).pose
        if other.distance(end) < PLACE_SPACING:
            break
        around = refine(problem, other, workers, FINE)
        gain = around.score - best.score
        if gain > 0.0:
            best = around
            seen_from = other
        if gain < problem.method.least_gain * around.score:
            break
        end = best.pose
    return best.pose, seen_from


def climb_unoccluded(problem: Problem, start: Candidate, workers: Workers) -> Candidate:
    """Mask occluders and refine the pose, in rounds.

    The candidate returned has the evidence of the whole photo; its `unoccluded` is the photo as masked last.
    """
    best = start
    for _ in range(MAX_UNOCCLUDED):
        before = best
        best = replace(best, unoccluded=mask_occluders(problem, best.comparison, best.unoccluded))
        is_occluded = bool(best.comparison.contradicts.any())
        climbed = climb_masked(problem, best, workers) if is_occluded else climb_whole(problem, best, workers)
        gain = climbed.score - before.score
        best = climbed if gain > 0.0 or climbed.pose is before.pose else best
        if not is_occluded or gain < problem.method.least_gain * climbed.score:
            break
    return best


def climb_whole(problem: Problem, start: Candidate, workers: Workers) -> Candidate:
    """Climb from a candidate; one that has climbed before is returned unchanged."""
    if start.is_climbed:
        return start
    pose = climb(problem, start.pose, workers).pose
    end = start if pose is start.pose else examine(problem, pose, start)
    return replace(end, is_climbed=True)


def climb_masked(problem: Problem, start: Candidate, workers: Workers) -> Candidate:
    """Climb from a candidate, and from poses around it, with its masked photo."""
    assert start.unoccluded is not None
    masked = problem.show(start.unoccluded.photo)
    around = refine(masked, start.pose, workers, AROUND_MIDDLE)
    first = refine(masked, around.pose, workers, FINE)
    return examine(problem, climb(masked, first.pose, workers).pose, start)


def climb_to_full(problem: Problem, start: Candidate, workers: Workers) -> Candidate:
    """Mask occluders and refine the pose, then descend on the visible points in the finest image."""
    return converge(problem, climb_unoccluded(problem, start, workers), FULL, workers)


def settle(problem: Problem, found: Candidate, workers: Workers) -> Candidate:
    """Descend until the pose converges, so that it does not depend on where the search began."""
    masked = mask_occluders(problem, found.comparison, found.unoccluded)
    return converge(problem, replace(found, unoccluded=masked), LAST, workers)


def converge(problem: Problem, found: Candidate, stage: Stage, workers: Workers) -> Candidate:
    """Descend on the points visible from the pose, in the rounds of a stage.

    The descent uses the candidate's `unoccluded` photo. If the end keeps less than MIN_POINTS_SCORE_LEFT of
    the candidate's score, the candidate is returned.
    """
    assert found.unoccluded is not None
    masked = problem.show(found.unoccluded.photo)
    pose = found.pose
    for k in range(stage.rounds.most):
        center = pose.center_world
        for each in (*problem.profile.soft, stage) if k == 0 else (stage,):
            pose = descend_on(masked, *see_cells(masked, pose, each.view), pose, each).pose
        if math.dist(pose.center_world, center) < stage.rounds.arrived:
            break
    end = examine(problem, pose, found)
    return end if end.score > MIN_POINTS_SCORE_LEFT * found.score else found


@kernel
def descend_perturbed(
    points: Array32,
    levels: Array32,
    weights: Array32,
    blocks: Int32s,
    coarse: Texels,
    fine: Texels,
    scale: float,
    tolerance: float,
    num_iterations: tuple[int, int],
    steps: Array,
    R_cam_from_map: Array,
    center: Array,
    scores: Array,
    begin: int,
) -> None:
    """Perturb poses (n, 3, 3), (n, 3) by steps (n, 6) and descend in place, on the coarse then fine image.

    One call takes PERTURBED_BATCH poses, from `begin` on. `num_iterations` are for the coarse and the fine
    image. A pose whose step is zero skips the coarse image.
    """
    R = R_cam_from_map
    t = center
    for k in range(begin, min(begin + PERTURBED_BATCH, len(steps))):
        retract(R[k].copy(), t[k].copy(), steps[k], R[k], t[k])
        first = 1
        for i in range(6):
            first = 0 if steps[k, i] != 0.0 else first
        for image in range(first, 2):
            texels = coarse.rgbx if image == 0 else fine.rgbx
            width = coarse.width if image == 0 else fine.width
            problem = ChannelProblem(points, levels, weights, texels, width, scale)
            descend_channels(problem, num_iterations[image], tolerance, R[k], t[k])
        scores[k] = score(points, levels, weights, blocks, fine.rgbx, fine.width, R[k], t[k])


def perturbations(method: Method, size: float) -> Array:
    """Return steps (9, 6), rotation [rad] and translation [m]: zero, then to the corners of a cube."""
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3.0)
    turns = signs[:, ::-1] * method.perturbed_angle
    steps = np.concatenate([turns, signs * method.perturbed_distance], axis=1) * size
    return np.concatenate([np.zeros((1, 6)), steps])


def descend(cells: Cells, image: Texels, pose: Pose, limits: Limits) -> Pose:
    """Descend on cells; coordinates relative to the cells' centre keep float32 exact."""
    R = pose.R_cam_from_world.copy()
    t = pose.center_world - cells.center_map
    scale = limits.loss_scale * LEVELS_PER_UNIT
    levels = to_levels(cells.channels)
    problem = ChannelProblem(cells.offsets, levels, cells.weights, image.rgbx, image.width, scale)
    descend_channels(problem, limits.num_iterations, limits.tolerance, R, t)
    return Pose(orthonormal(R), t + cells.center_map)


def score_on_cells(cells: Cells, blocks: Int32s, image: Texels, pose: Pose) -> Hypothesis:
    """Score a pose by `channel_loss.score`, on the cells of a view and its blocks."""
    t = pose.center_world - cells.center_map
    R = pose.R_cam_from_world
    levels = to_levels(cells.channels)
    value = score(cells.offsets, levels, cells.weights, blocks, image.rgbx, image.width, R, t)
    return Hypothesis(pose, float(value))


def descend_around(
    problem: Problem, cells: Cells, blocks: Int32s, pose: Pose, stage: Stage, workers: Workers
) -> Hypothesis:
    """Return the best end of descents from a pose and around it, on the coarse image first."""
    assert stage.around is not None
    coarse = problem.photo.image(stage.around.image)
    fine = problem.photo.image(stage.image)
    limits = stage.limits
    steps = perturbations(problem.method, stage.around.size)
    R = np.repeat(pose.R_cam_from_world[None], len(steps), axis=0)
    t = np.repeat((pose.center_world - cells.center_map)[None], len(steps), axis=0)
    scores = np.empty(len(steps))
    levels = to_levels(cells.channels)
    scale = limits.loss_scale * LEVELS_PER_UNIT
    num_iterations = (stage.around.num_iterations, limits.num_iterations)

    descend_from = partial(
        descend_perturbed,
        cells.offsets,
        levels,
        cells.weights,
        blocks,
        coarse,
        fine,
        scale,
        limits.tolerance,
        num_iterations,
        steps,
        R,
        t,
        scores,
    )
    workers.map(descend_from, range(0, len(steps), PERTURBED_BATCH), "descend")
    best = int(np.argmax(scores))
    return Hypothesis(Pose(orthonormal(R[best]), t[best] + cells.center_map), float(scores[best]))
