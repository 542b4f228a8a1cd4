"""The ladder of stages on which a pose is refined: from coarse images and views to single points."""

import math
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Array32, Int32s
from ..confidence.alternatives import Hypothesis
from ..geometry.pose import Pose, orthonormal
from ..kernels.jit import kernel
from ..optimize.channel_loss import ChannelProblem, descend_channels, score
from ..optimize.levenberg_marquardt import retract
from ..panorama.local_normalization import LEVELS_PER_UNIT, ZERO_LEVEL
from ..panorama.texels import Texels
from ..views.points_around import PLACE_SPACING
from ..views.view import Cells
from .comparison import Comparison, compare, mask_occluders, score_pose
from .query import Query
from .settings import VIEWS, ImageName, ViewName

PERTURBED_DISTANCE = 0.25  # [m]
PERTURBED_ANGLE = math.radians(8.0)
PERTURBED_BATCH = 3  # perturbed poses that a thread takes
MAX_PERTURBATIONS = 5  # rounds
MIN_GAIN = 0.02  # of the score in a round, relative; a round with less is the last
MAX_UNOCCLUDED = 2  # rounds that mask occluders
NEARLY = 0.02  # [m] after a smaller move the camera sees the same points
MIN_SCORE_LEFT = 0.9  # fraction of the score that a descent on points must keep


class Limits(NamedTuple):
    """The loss of a descent, and its end."""

    loss_scale: float  # [standard deviations]
    num_iterations: int  # at most
    tolerance: float  # [rad + m] a shorter step ends the descent


class Around(NamedTuple):
    """Poses around the one that is given: each descends on a coarser image first, and the best end counts."""

    image: ImageName
    num_iterations: int  # on that
    size: float  # of the perturbations, relative to PERTURBED_DISTANCE and PERTURBED_ANGLE


class Rounds(NamedTuple):
    """Repetitions of a descent, each on the points that are visible from the end of the one before."""

    most: int
    arrived: float  # [m] a smaller move ends them


class Stage(NamedTuple):
    """A descent from a pose: on which view of the scan from there, and in which image of the photo."""

    view: ViewName
    image: ImageName
    limits: Limits
    around: Around | None = None
    rounds: Rounds = Rounds(1, 0.0)


FIRST = Stage("prepared", "search", Limits(1.2, 5, 2e-3))
SECOND = Stage("prepared", "search", Limits(1.2, 12, 2e-3))
MIDDLE = Stage("middle", "middle", Limits(1.2, 12, 1e-3))
AROUND_MIDDLE = Stage("middle", "middle", Limits(1.2, 8, 1e-3), Around("search", 6, 1.0))
AROUND_FINE = Stage("fine", "fine", Limits(1.2, 8, 1e-3), Around("middle", 6, 0.4))
FINE = Stage("fine", "fine", Limits(1.0, 12, 1e-4))
SOFT = Stage("points", "fine", Limits(1.0, 12, 1e-4))  # of edges, before the next ones
FULL = Stage("points", "full", Limits(0.7, 10, 1e-4), rounds=Rounds(2, NEARLY))
LAST = Stage("points", "full", Limits(0.7, 30, 1e-7), rounds=Rounds(6, 1e-4))


def refine(query: Query, start: Pose, first: Stage, then: Stage | None = None) -> Hypothesis:
    """Descend from a pose through one or two stages, each on what is seen from where it begins.

    The score of the end is that on the cells of the last view; nan on points.
    """
    cells = query.view_at(start, first.view)
    end = (descend_around if first.around else descend_on)(query, cells, start, first)
    return end if then is None else refine(query, end.pose, then)


def descend_on(query: Query, cells: Cells, pose: Pose, stage: Stage) -> Hypothesis:
    """Descend from a pose on the cells or points that are seen from there, and score the end on the cells."""
    image = query.photo.image(stage.image)
    end = descend(cells, image, pose, stage.limits)
    if stage.view == "points":
        return Hypothesis(end, math.nan)
    return score_on_cells(cells, VIEWS[stage.view].arrays.blocks, image, end)


def climb(query: Query, start: Hypothesis) -> Hypothesis:
    """Refine a pose on fine cells, and poses around it, for as long as its score rises.

    A pose that has converged before is returned unchanged.
    """
    if start.pose.key in query.cache.ends:
        return start
    cells = query.view_at(start.pose, FINE.view)
    blocks = VIEWS[FINE.view].arrays.blocks
    best = score_on_cells(cells, blocks, query.photo.image(FINE.image), start.pose)
    for _ in range(MAX_PERTURBATIONS):
        around = descend_around(query, cells, best.pose, AROUND_FINE)
        refined = refine(query, around.pose, FINE)
        gain = refined.score - best.score
        best = refined if gain > 0.0 else best
        if gain < MIN_GAIN * refined.score:
            break
        cells = query.view_at(best.pose, FINE.view)
    query.cache.ends.add(best.pose.key)
    return best


def climb_from_afar(query: Query, start: Pose) -> tuple[Pose, Pose]:
    """Descend from a pose, and from poses around the end for as long as the score on fine cells rises.

    Nothing is gained if they all lead back to the end. Return also the pose from which its cells were seen.
    """
    end = seen_from = refine(query, start, MIDDLE).pose
    best = refine(query, end, FINE)
    for _ in range(MAX_PERTURBATIONS):
        other = refine(query, end, AROUND_MIDDLE).pose
        if other.distance(end) < PLACE_SPACING:
            break
        around = refine(query, other, FINE)
        gain = around.score - best.score
        if gain > 0.0:
            best = around
            seen_from = other
        if gain < MIN_GAIN * around.score:
            break
        end = best.pose
    return best.pose, seen_from


def climb_unoccluded(query: Query, start: Pose) -> tuple[Query, Hypothesis]:
    """Mask occluders and refine the pose, in rounds; return the masked query and the pose.

    The score of the pose is that of the whole photo.
    """
    best = score_pose(query, start)
    for _ in range(MAX_UNOCCLUDED):
        seen = compare(query, best.pose)
        shown = mask_occluders(query, seen)
        is_occluded = seen.contradicts.any()
        first = refine(shown, best.pose, AROUND_MIDDLE, FINE) if is_occluded else best
        refined = score_pose(query, climb(shown, first).pose)
        gain = refined.score - best.score
        best = refined if gain > 0.0 else best
        if not is_occluded or gain < MIN_GAIN * refined.score:
            break
    return shown, best


def climb_to_full(query: Query, start: Pose) -> Hypothesis:
    """Mask occluders and refine the pose, then descend on the visible points in the finest image."""
    shown, best = climb_unoccluded(query, start)
    return converge(query, shown, best, FULL)


def settle(query: Query, found: Hypothesis, seen: Comparison | None = None) -> Hypothesis:
    """Descend until the pose converges, so that it does not depend on where the search began.

    `seen` is how the pose was compared, if not as of `compare`.
    """
    shown = mask_occluders(query, seen or compare(query, found.pose))
    return converge(query, shown, found, LAST)


def converge(query: Query, shown: Query, found: Hypothesis, stage: Stage) -> Hypothesis:
    """Descend on the points visible from the pose, in the rounds of a stage.

    It descends on the masked query `shown`; an end below MIN_SCORE_LEFT of the photo's score is discarded.
    """
    pose = found.pose
    for k in range(stage.rounds.most):
        center = pose.center_world
        is_soft = k == 0 and query.evidence == "shape"
        pose = (refine(shown, pose, SOFT, stage) if is_soft else refine(shown, pose, stage)).pose
        if math.dist(pose.center_world, center) < stage.rounds.arrived:
            break
    end = score_pose(query, pose)
    return end if end.score > MIN_SCORE_LEFT * found.score else found


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
) -> None:
    """Perturb poses (n, 3, 3), (n, 3) by steps (n, 6) and descend in place, on the coarse then fine image.

    `num_iterations` are those on each image. A pose with the zero step skips the coarse one.
    """
    R = R_cam_from_map
    t = center
    for k in range(len(steps)):
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


def to_levels(channels: Array32) -> Array32:
    """Convert channels in standard deviations to 8-bit levels, not rounded."""
    return np.asarray(channels * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL))


def perturbations(size: float) -> Array:
    """Return steps (9, 6), rotation [rad] and translation [m]: zero, then to the corners of a cube."""
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3.0)
    steps = np.concatenate([signs[:, ::-1] * PERTURBED_ANGLE, signs * PERTURBED_DISTANCE], axis=1) * size
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


def descend_around(query: Query, cells: Cells, pose: Pose, stage: Stage) -> Hypothesis:
    """Return the best end of descents from a pose and around it, on the coarse image first."""
    assert stage.around is not None
    blocks = VIEWS[stage.view].arrays.blocks
    coarse = query.photo.image(stage.around.image)
    fine = query.photo.image(stage.image)
    limits = stage.limits
    steps = perturbations(stage.around.size)
    R = np.repeat(pose.R_cam_from_world[None], len(steps), axis=0)
    t = np.repeat((pose.center_world - cells.center_map)[None], len(steps), axis=0)
    scores = np.empty(len(steps))
    levels = to_levels(cells.channels)
    scale = limits.loss_scale * LEVELS_PER_UNIT
    num_iterations = (stage.around.num_iterations, limits.num_iterations)

    def run(lo: int) -> None:
        part = slice(lo, lo + PERTURBED_BATCH)
        descend_perturbed(
            cells.offsets,
            levels,
            cells.weights,
            blocks,
            coarse,
            fine,
            scale,
            limits.tolerance,
            num_iterations,
            steps[part],
            R[part],
            t[part],
            scores[part],
        )

    query.workers.map(run, range(0, len(steps), PERTURBED_BATCH), "descend")
    best = int(np.argmax(scores))
    return Hypothesis(Pose(orthonormal(R[best]), t[best] + cells.center_map), float(scores[best]))
