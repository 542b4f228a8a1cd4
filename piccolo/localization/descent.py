"""Descents on the cells of a view: from many starts, from one pose, and from around a pose."""

import math

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import Hypothesis
from ..geometry.pose import Pose, orthonormal
from ..jobs.threads import Workers
from ..kernels.jit import F0, kernel
from ..optimize.channel_loss import descend_channels, score
from ..optimize.levenberg_marquardt import retract
from ..panorama.local_normalization import LEVELS_PER_UNIT, ZERO_LEVEL
from ..panorama.texels import Texels
from ..scan_map.scan_map import ScanMap
from ..views.candidate_views import SEARCH_VIEW
from ..views.view import Cells
from .starts import Starts

COARSE_LOSS, FINE_LOSS, FULL_LOSS = 1.2, 1.0, 0.7  # scales of the loss [standard deviations]
START_TOLERANCE, PERTURBED_TOLERANCE = 2e-3, 1e-3  # [rad + m] a shorter step ends a descent
WIDE_ITERATIONS, NARROW_ITERATIONS = 6, 8  # of a descent from around a pose
PERTURBED_DISTANCE, PERTURBED_ANGLE = 0.25, math.radians(8.0)  # [m], [rad]
BATCH, PERTURBED_BATCH = 16, 3  # starts that a thread takes at a time, and of those around a pose


@kernel
def descend_starts(views, cells, image, scale, num_iterations, row, R_cam_from_map, center_map, scores):
    """Descend from each start, (n, 3, 3) and (n, 3) in place, on the cells of a row (n,) of views."""
    centers, offsets, unit, features, is_seen = views
    solid_angle, blocks = cells
    texels, width = image
    R, t = R_cam_from_map, center_map
    n = len(solid_angle)
    points, levels = np.empty((3, n), np.float32), np.empty((3, n), np.float32)
    weights = np.empty(n, np.float32)
    for k in range(len(row)):
        c = row[k]
        for i in range(3):
            for j in range(n):
                points[i, j] = np.float32(offsets[c, i, j]) * unit[c]
                levels[i, j] = np.float32(features[c, i, j]) + np.float32(ZERO_LEVEL)
        for j in range(n):
            weights[j] = solid_angle[j] if is_seen[c, j] else F0
        for i in range(3):
            t[k, i] -= centers[c, i]
        problem = points, levels, weights, texels, width, scale
        descend_channels(problem, num_iterations, START_TOLERANCE, R[k], t[k])
        scores[k] = score(points, levels, weights, blocks, texels, width, R[k], t[k])
        for i in range(3):
            t[k, i] += centers[c, i]


@kernel
def descend_perturbed(
    points, levels, weights, blocks, wide, narrow, scale, steps, R_cam_from_map, center, scores
):
    """Descend from each step (n, 6) away from (n, 3, 3), (n, 3): on the wide image, then on the other.

    A step that is none is taken on the other alone.
    """
    R, t = R_cam_from_map, center
    for k in range(len(steps)):
        retract(R[k].copy(), t[k].copy(), steps[k], R[k], t[k])
        first = 1
        for i in range(6):
            first = 0 if steps[k, i] != 0.0 else first
        for image in range(first, 2):
            texels, width, num_iterations = narrow[0], narrow[1], NARROW_ITERATIONS
            if image == 0:
                texels, width, num_iterations = wide[0], wide[1], WIDE_ITERATIONS
            problem = points, levels, weights, texels, width, scale
            descend_channels(problem, num_iterations, PERTURBED_TOLERANCE, R[k], t[k])
        scores[k] = score(points, levels, weights, blocks, narrow[0], narrow[1], R[k], t[k])


def as_levels(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Channels in standard deviations as 8-bit levels, not rounded."""
    return np.asarray(channels * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL))


def perturbations(size: float) -> NDArray[np.float64]:
    """Steps (9, 6), rotation [rad] and translation [m]: none, then to the corners of a cube."""
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3.0)
    steps = np.concatenate([signs[:, ::-1] * PERTURBED_ANGLE, signs * PERTURBED_DISTANCE], axis=1) * size
    return np.concatenate([np.zeros((1, 6)), steps])


def descend_all(
    scan_map: ScanMap, image: Texels, starts: Starts, num_iterations: int, workers: Workers
) -> Starts:
    """Where a descent from each start ends, on its candidate's prepared view; best first."""
    R, t = starts.R_cam_from_map.copy(), starts.center_map.copy()
    scores = np.empty(len(t))
    row, views = scan_map.views.at(starts.candidate, workers)
    cells = SEARCH_VIEW.arrays.solid_angle, SEARCH_VIEW.arrays.blocks
    scale = COARSE_LOSS * LEVELS_PER_UNIT

    def run(lo: int) -> None:
        part = slice(lo, lo + BATCH)
        some = row[part], R[part], t[part], scores[part]
        descend_starts(views, cells, (image.rgbx, image.width), scale, num_iterations, *some)

    list(workers.map(run, range(0, len(t), BATCH), "descend"))
    return Starts(R, t, starts.candidate, scores).take(np.argsort(-scores, kind="stable"))


def descend(cells: Cells, image: Texels, pose: Pose, limits: tuple[float, int, float]) -> Pose:
    """The pose where a descent from `pose` ends.

    Limits are the loss' scale [standard deviations], the iterations, the least step [rad + m]. Coordinates
    relative to the cells' centre keep float32 exact.
    """
    loss_scale, num_iterations, tolerance = limits
    R, t = pose.R_cam_from_world.copy(), pose.center_world - cells.center_map
    levels, scale = as_levels(cells.channels), loss_scale * LEVELS_PER_UNIT
    problem = cells.offsets, levels, cells.weights, image.rgbx, image.width, scale
    descend_channels(problem, num_iterations, tolerance, R, t)
    return Pose(orthonormal(R), t + cells.center_map)


def score_on(cells: Cells, blocks: NDArray[np.int32], image: Texels, pose: Pose) -> float:
    """The score of a pose on cells, each in its block of the sphere."""
    levels, R, t = as_levels(cells.channels), pose.R_cam_from_world, pose.center_world - cells.center_map
    return float(score(cells.offsets, levels, cells.weights, blocks, image.rgbx, image.width, R, t))


def descend_around(
    cells: Cells,
    blocks: NDArray[np.int32],
    images: tuple[Texels, Texels],
    pose: Pose,
    size: float,
    workers: Workers,
) -> Hypothesis:
    """The best end of descents from around a pose, the wider image first, and from the pose itself."""
    steps, (wide, narrow) = perturbations(size), images
    R = np.repeat(pose.R_cam_from_world[None], len(steps), axis=0)
    t = np.repeat((pose.center_world - cells.center_map)[None], len(steps), axis=0)
    scores = np.empty(len(steps))
    both = (wide.rgbx, wide.width), (narrow.rgbx, narrow.width)
    levels, scale = as_levels(cells.channels), COARSE_LOSS * LEVELS_PER_UNIT
    problem = cells.offsets, levels, cells.weights, blocks, *both, scale

    def run(lo: int) -> None:
        part = slice(lo, lo + PERTURBED_BATCH)
        descend_perturbed(*problem, steps[part], R[part], t[part], scores[part])

    list(workers.map(run, range(0, len(steps), PERTURBED_BATCH), "descend"))
    best = int(np.argmax(scores))
    return Hypothesis(Pose(orthonormal(R[best]), t[best] + cells.center_map), float(scores[best]))
