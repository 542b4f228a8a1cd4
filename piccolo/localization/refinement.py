"""From starts to poses: descents on ever finer views, with successive halving, and perturbations."""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import (
    MIN_ANGLE,
    MIN_DISTANCE,
    Hypothesis,
    best_distinct,
    sort_by_score,
    suppress_near,
)
from ..geometry.pose import Array, Pose, orthonormal
from ..geometry.suppression import non_maximum_suppression
from ..jobs.threads import Workers
from ..kernels.jit import F0, kernel
from ..optimize.channel_loss import ChannelProblem, descend_channels, score
from ..optimize.levenberg_marquardt import retract
from ..panorama.local_normalization import LEVELS_PER_UNIT, ZERO_LEVEL
from ..panorama.texels import Texels
from ..scan_map.scan_map import ScanMap
from ..views.candidate_views import SEARCH_VIEW, Views
from ..views.points_around import PLACE_SPACING
from ..views.view import Cells, ViewArrays, ViewConfig
from .comparison import compare, score_pose
from .cone import Cone, find_cone, select_cells
from .query import Query
from .search import Starts
from .settings import Beam

COARSE_LOSS = 1.2  # scale of the loss [standard deviations]
FINE_LOSS = 1.0
FULL_LOSS = 0.7
START_TOLERANCE = 2e-3  # [rad + m] a shorter step ends a descent from a start
PERTURBED_TOLERANCE = 1e-3  # and one from a perturbed pose
WIDE_ITERATIONS = 6  # of a descent from a perturbed pose, on the wide image
NARROW_ITERATIONS = 8  # then on the narrow one
PERTURBED_DISTANCE = 0.25  # [m]
PERTURBED_ANGLE = math.radians(8.0)
BATCH = 16  # starts that a thread takes at a time
PERTURBED_BATCH = 3  # perturbed poses that a thread takes
FIRST_ITERATIONS = 5  # of the first descents on prepared views
SECOND_ITERATIONS = 12
PERTURBATION = 0.4  # size of the perturbations on fine cells, relative to middle ones
MAX_PERTURBATIONS = 5  # rounds
MIN_GAIN = 0.02  # of the score in a round, relative; a round with less is the last
NUM_FOUND = 12  # poses of a search, at most
PLAIN_SCORE = 0.2  # if the best has this score, poses with less than FAINT_PART of it are dropped
FAINT_PART = 0.25
SAME_DISTANCE = 0.15  # [m] poses on their way down nearer than this
SAME_ANGLE = math.radians(5.0)  # and this are one
CLOSE_DISTANCE = 0.1  # [m] SAME_DISTANCE after the descent on middle cells

Array32 = NDArray[np.float32]
Fit = Hypothesis  # during descent: its score is `channel_loss.score` on the cells of its last view


class Limits(NamedTuple):
    """The loss of a descent, and its end."""

    loss_scale: float  # [standard deviations]
    num_iterations: int  # at most
    tolerance: float  # [rad + m] a shorter step ends the descent


MIDDLE_LIMITS = Limits(COARSE_LOSS, 12, 1e-3)
FINE_LIMITS = Limits(FINE_LOSS, 12, 1e-4)


def refine(query: Query, starts: Starts, beam: Beam) -> list[Hypothesis]:
    """Refine the starts by successive halving to a few distinct poses on fine cells, best first."""
    workers = query.workers
    coarse = descend_prepared(query, starts, count_first_iterations(query), beam.num_coarse)
    coarse = descend_prepared(query, coarse, SECOND_ITERATIONS, beam.num_middle)
    middle = workers.map(partial(descend_middle, query), coarse.poses(), "descend")
    narrowed = narrow(middle, beam.num_fine)
    perturbed = workers.map(partial(perturb_middle, query), narrowed, "descend")
    fine = workers.map(partial(descend_fine, query), narrow(perturbed, beam.num_fine), "descend")
    best = best_distinct(fine, beam.num_perturbed, CLOSE_DISTANCE, SAME_ANGLE)
    others = keep_comparable(keep_distinct(fine, middle))[len(best) :]  # these most likely stay
    with workers.beside(*(partial(compare, query, f.pose) for f in others)):
        ends = workers.map(partial(refine_by_perturbation, query), best, "descend")
    poses = [f.pose for f in keep_comparable(keep_distinct([*ends, *fine], middle))]
    return sort_by_score(workers.map(partial(score_pose, query), poses, "descend"))


def refine_matches(query: Query, poses: Sequence[Pose]) -> list[Hypothesis]:
    """Descend on fine cells from poses of matches; keep the better of each start and end, best first."""

    def refine_match(pose: Pose) -> Hypothesis:
        end = descend_fine(query, pose).pose
        return max(score_pose(query, pose), score_pose(query, end), key=lambda h: h.score)

    return sort_by_score(query.workers.map(refine_match, poses, "descend"))


def count_first_iterations(query: Query) -> int:
    """Return the iterations of the first descents; a narrow photo needs more."""
    return SECOND_ITERATIONS if query.photo.is_partial else FIRST_ITERATIONS


def descend_prepared(query: Query, starts: Starts, num_iterations: int, count: int) -> Starts:
    """Descend from each start on its candidate's prepared view; keep the distinct best and alternatives."""
    image = query.photo.images.search()
    ends, _ = descend_all(query.scan_map, image, starts, num_iterations, query.workers)
    return ends.take(best_and_alternatives(ends.R_cam_from_map, ends.center_map, count, SAME_DISTANCE))


def descend_middle(query: Query, pose: Pose) -> Fit:
    """Descend on the middle cells seen from the pose."""
    return descend_view(query, query.method.middle_view, query.photo.images.middle(), pose, MIDDLE_LIMITS)


def descend_fine(query: Query, pose: Pose) -> Fit:
    """Descend on the fine cells seen from the pose."""
    return descend_view(query, query.method.fine_view, query.photo.images.fine(), pose, FINE_LIMITS)


def descend_view(query: Query, config: ViewConfig, image: Texels, pose: Pose, limits: Limits) -> Fit:
    """Descend on the cells seen from a pose, and score the end on them."""
    cells = query.view_at(pose, config)
    return score_on_cells(cells, config.arrays.blocks, image, descend(cells, image, pose, limits))


def perturb_middle(query: Query, pose: Pose) -> Fit:
    """Perturb a pose and descend again on middle cells."""
    config = query.method.middle_view
    wide_image = query.photo.images.search()
    narrow_image = query.photo.images.middle()
    cells = query.view_at(pose, config)
    return descend_around(cells, config.arrays.blocks, wide_image, narrow_image, pose, 1.0, query.workers)


def refine_on_middle_cells(query: Query, pose: Pose) -> tuple[Pose, Pose]:
    """Descend from a pose, and from poses around the end for as long as the score on fine cells rises.

    Nothing is gained if they all lead back to the end. Return also the pose from which its cells were seen.
    """
    end = seen_from = descend_middle(query, pose).pose
    fit = descend_fine(query, end)
    for _ in range(MAX_PERTURBATIONS):
        other = perturb_middle(query, end).pose
        if other.distance(end) < PLACE_SPACING:
            break
        around = descend_fine(query, other)
        gain = around.score - fit.score
        if gain > 0.0:
            fit = around
            seen_from = other
        if gain < MIN_GAIN * around.score:
            break
        end = fit.pose
    return fit.pose, seen_from


def refine_by_perturbation(query: Query, fit: Fit) -> Fit:
    """Perturb and refine a pose for as long as its score rises.

    A pose that has converged before is returned unchanged.
    """
    if fit.pose.key in query.cache.ends:
        return fit
    config = query.method.fine_view
    blocks = config.arrays.blocks
    wide_image = query.photo.images.middle()
    narrow_image = query.photo.images.fine()
    cells = query.view_at(fit.pose, config)
    fit = score_on_cells(cells, blocks, narrow_image, fit.pose)
    for _ in range(MAX_PERTURBATIONS):
        around = descend_around(
            cells, blocks, wide_image, narrow_image, fit.pose, PERTURBATION, query.workers
        )
        refined = descend_fine(query, around.pose)
        gain = refined.score - fit.score
        fit = refined if gain > 0.0 else fit
        if gain < MIN_GAIN * refined.score:
            break
        cells = query.view_at(fit.pose, config)
    query.cache.ends.add(fit.pose.key)
    return fit


def best_and_alternatives(
    rotations: NDArray[np.float64], centers: NDArray[np.float64], count: int, min_distance: float
) -> NDArray[np.int64]:
    """Return the indices of `count` of the ranked poses (n, 3, 3), (n, 3), best first, in ascending order.

    Three quarters are the best poses that differ a little, a quarter the best that lie far apart.
    """
    near = non_maximum_suppression(rotations, centers, count - count // 4, min_distance, SAME_ANGLE)
    apart = non_maximum_suppression(rotations, centers, count, MIN_DISTANCE, MIN_ANGLE)
    others = apart[~np.isin(apart, near)][: count - len(near)]
    return np.sort(np.concatenate([near, others]))


def narrow(fits: Sequence[Fit], count: int) -> list[Pose]:
    """Return the `best_and_alternatives` of the fits, ranked by score."""
    ranked = [f.pose for f in sort_by_score(fits)]
    rotations = np.array([pose.R_cam_from_world for pose in ranked])
    centers = np.array([pose.center_world for pose in ranked])
    return [ranked[k] for k in best_and_alternatives(rotations, centers, count, CLOSE_DISTANCE)]


def keep_distinct(fine: Sequence[Fit], middle: Sequence[Fit]) -> list[Fit]:
    """Return the best poses of fine cells, then of middle cells, by non-maximum suppression."""
    return suppress_near([*sort_by_score(fine), *sort_by_score(middle)], NUM_FOUND, MIN_DISTANCE, MIN_ANGLE)


def keep_comparable(ranked: Sequence[Fit]) -> list[Fit]:
    """Drop the fits that score far below a good best: a comparison could not bring them near it."""
    best = max((f.score for f in ranked), default=0.0)
    least = FAINT_PART * best if best >= PLAIN_SCORE else -math.inf
    return [f for f in ranked if f.score >= least]


@kernel
def descend_starts(
    views: Views,
    view: ViewArrays,
    image: Texels,
    scale: float,
    num_iterations: int,
    cone: Cone,
    row: NDArray[np.int64],
    R_cam_from_map: Array,
    center_map: Array,
    scores: Array,
) -> None:
    """Descend from each start, (n, 3, 3) and (n, 3) in place, on the cells of its row (n,) of the views.

    Cells outside of the cone around what the photo shows, as seen from the start, are left out.
    """
    centers, offsets, unit, features, is_seen = views
    solid_angle = view.solid_angle
    blocks = view.blocks
    texels = image.rgbx
    width = image.width
    R = R_cam_from_map
    t = center_map
    n = len(solid_angle)
    room = np.empty(3 * n, np.float32)
    more_room = np.empty(3 * n, np.float32)
    weights = np.empty(n, np.float32)
    own_blocks = np.empty(n, np.int32)
    kept = np.empty(n, np.int64)
    for k in range(len(row)):
        c = row[k]
        for i in range(3):
            t[k, i] -= centers[c, i]
        num = select_cells(offsets[c], unit[c], cone, R[k], t[k], kept)
        points = room[: 3 * num].reshape(3, num)
        levels = more_room[: 3 * num].reshape(3, num)
        for i in range(3):
            for m in range(num):
                points[i, m] = np.float32(offsets[c, i, kept[m]]) * unit[c]
                levels[i, m] = np.float32(features[c, i, kept[m]]) + np.float32(ZERO_LEVEL)
        for m in range(num):
            weights[m] = solid_angle[kept[m]] if is_seen[c, kept[m]] else F0
            own_blocks[m] = blocks[kept[m]]
        problem = ChannelProblem(points, levels, weights[:num], texels, width, scale)
        descend_channels(problem, num_iterations, START_TOLERANCE, R[k], t[k])
        scores[k] = score(points, levels, weights[:num], own_blocks[:num], texels, width, R[k], t[k])
        for i in range(3):
            t[k, i] += centers[c, i]


@kernel
def descend_perturbed(
    points: Array32,
    levels: Array32,
    weights: Array32,
    blocks: NDArray[np.int32],
    wide: Texels,
    narrow: Texels,
    scale: float,
    steps: Array,
    R_cam_from_map: Array,
    center: Array,
    scores: Array,
) -> None:
    """Perturb poses (n, 3, 3), (n, 3) by steps (n, 6) and descend in place, on the wide then narrow image.

    A pose with the zero step skips the wide image.
    """
    R = R_cam_from_map
    t = center
    for k in range(len(steps)):
        retract(R[k].copy(), t[k].copy(), steps[k], R[k], t[k])
        first = 1
        for i in range(6):
            first = 0 if steps[k, i] != 0.0 else first
        for image in range(first, 2):
            texels = wide.rgbx if image == 0 else narrow.rgbx
            width = wide.width if image == 0 else narrow.width
            num_iterations = WIDE_ITERATIONS if image == 0 else NARROW_ITERATIONS
            problem = ChannelProblem(points, levels, weights, texels, width, scale)
            descend_channels(problem, num_iterations, PERTURBED_TOLERANCE, R[k], t[k])
        scores[k] = score(points, levels, weights, blocks, narrow.rgbx, narrow.width, R[k], t[k])


def to_levels(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert channels in standard deviations to 8-bit levels, not rounded."""
    return np.asarray(channels * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL))


def perturbations(size: float) -> NDArray[np.float64]:
    """Return steps (9, 6), rotation [rad] and translation [m]: zero, then to the corners of a cube."""
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3.0)
    steps = np.concatenate([signs[:, ::-1] * PERTURBED_ANGLE, signs * PERTURBED_DISTANCE], axis=1) * size
    return np.concatenate([np.zeros((1, 6)), steps])


def descend_all(
    scan_map: ScanMap, image: Texels, starts: Starts, num_iterations: int, workers: Workers
) -> tuple[Starts, NDArray[np.float64]]:
    """Descend from all starts on their candidates' prepared views; return ends and scores, best first."""
    R = starts.R_cam_from_map.copy()
    t = starts.center_map.copy()
    scores = np.empty(len(t))
    row, views = scan_map.views.at(starts.candidate, workers)
    view = SEARCH_VIEW.arrays
    scale = COARSE_LOSS * LEVELS_PER_UNIT
    cone = find_cone(image)

    def run(lo: int) -> None:
        part = slice(lo, lo + BATCH)
        descend_starts(
            views, view, image, scale, num_iterations, cone, row[part], R[part], t[part], scores[part]
        )

    workers.map(run, range(0, len(t), BATCH), "descend")
    order = np.argsort(-scores, kind="stable")
    return Starts(R, t, starts.candidate).take(order), scores[order]


def descend(cells: Cells, image: Texels, pose: Pose, limits: Limits) -> Pose:
    """Descend on cells; coordinates relative to the cells' centre keep float32 exact."""
    R = pose.R_cam_from_world.copy()
    t = pose.center_world - cells.center_map
    scale = limits.loss_scale * LEVELS_PER_UNIT
    levels = to_levels(cells.channels)
    problem = ChannelProblem(cells.offsets, levels, cells.weights, image.rgbx, image.width, scale)
    descend_channels(problem, limits.num_iterations, limits.tolerance, R, t)
    return Pose(orthonormal(R), t + cells.center_map)


def score_on_cells(cells: Cells, blocks: NDArray[np.int32], image: Texels, pose: Pose) -> Fit:
    """Score a pose on cells, each of which lies in a block of the sphere."""
    t = pose.center_world - cells.center_map
    levels = to_levels(cells.channels)
    R = pose.R_cam_from_world
    return Fit(
        pose, float(score(cells.offsets, levels, cells.weights, blocks, image.rgbx, image.width, R, t))
    )


def descend_around(
    cells: Cells,
    blocks: NDArray[np.int32],
    wide_image: Texels,
    narrow_image: Texels,
    pose: Pose,
    size: float,
    workers: Workers,
) -> Fit:
    """Return the best end of descents from a pose and around it, on the wide image first."""
    steps = perturbations(size)
    R = np.repeat(pose.R_cam_from_world[None], len(steps), axis=0)
    t = np.repeat((pose.center_world - cells.center_map)[None], len(steps), axis=0)
    scores = np.empty(len(steps))
    levels = to_levels(cells.channels)
    scale = COARSE_LOSS * LEVELS_PER_UNIT

    def run(lo: int) -> None:
        part = slice(lo, lo + PERTURBED_BATCH)
        descend_perturbed(
            cells.offsets,
            levels,
            cells.weights,
            blocks,
            wide_image,
            narrow_image,
            scale,
            steps[part],
            R[part],
            t[part],
            scores[part],
        )

    workers.map(run, range(0, len(steps), PERTURBED_BATCH), "descend")
    best = int(np.argmax(scores))
    return Fit(Pose(orthonormal(R[best]), t[best] + cells.center_map), float(scores[best]))
