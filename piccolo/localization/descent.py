"""Descents on the cells of a view: from many starts, from one pose, and from around a pose."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from .search import Starts

COARSE_LOSS = 1.2  # scale of the loss [standard deviations]
FINE_LOSS = 1.0
FULL_LOSS = 0.7
START_TOLERANCE = 2e-3  # [rad + m] a shorter step ends a descent from a start
PERTURBED_TOLERANCE = 1e-3  # and one from around a pose
WIDE_ITERATIONS = 6  # of a descent from around a pose, on the wide image
NARROW_ITERATIONS = 8  # on the other
PERTURBED_DISTANCE = 0.25  # [m]
PERTURBED_ANGLE = math.radians(8.0)
BATCH = 16  # starts that a thread takes at a time
PERTURBED_BATCH = 3  # of those around a pose


class Fit(NamedTuple):
    """A pose on its way down, with the `channel_loss.score` on the cells of the view it descended on."""

    pose: Pose
    score: float


@kernel
def descend_starts(views, cells, image, scale, num_iterations, row, R_cam_from_map, center_map, scores):
    """Descend from each start, (n, 3, 3) and (n, 3) in place, on the cells of a row (n,) of views."""
    centers, offsets, unit, features, is_seen = views
    solid_angle, blocks = cells
    texels, width = image
    R = R_cam_from_map
    t = center_map
    n = len(solid_angle)
    points = np.empty((3, n), np.float32)
    levels = np.empty((3, n), np.float32)
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
    R = R_cam_from_map
    t = center
    for k in range(len(steps)):
        retract(R[k].copy(), t[k].copy(), steps[k], R[k], t[k])
        first = 1
        for i in range(6):
            first = 0 if steps[k, i] != 0.0 else first
        for image in range(first, 2):
            texels, width = wide if image == 0 else narrow
            num_iterations = WIDE_ITERATIONS if image == 0 else NARROW_ITERATIONS
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
) -> tuple[Starts, NDArray[np.float64]]:
    """Where descents from starts end, on their candidates' prepared views, best first; with their scores."""
    R = starts.R_cam_from_map.copy()
    t = starts.center_map.copy()
    scores = np.empty(len(t))
    row, views = scan_map.views.at(starts.candidate, workers)
    cells = SEARCH_VIEW.arrays.solid_angle, SEARCH_VIEW.arrays.blocks
    scale = COARSE_LOSS * LEVELS_PER_UNIT

    def run(lo: int) -> None:
        part = slice(lo, lo + BATCH)
        some = row[part], R[part], t[part], scores[part]
        descend_starts(views, cells, (image.rgbx, image.width), scale, num_iterations, *some)

    workers.map(run, range(0, len(t), BATCH), "descend")
    order = np.argsort(-scores, kind="stable")
    return Starts(R, t, starts.candidate).take(order), scores[order]


def descend(cells: Cells, image: Texels, pose: Pose, limits: tuple[float, int, float]) -> Pose:
    """The pose where a descent from `pose` ends.

    Limits are the loss' scale [standard deviations], the iterations, the least step [rad + m]. Coordinates
    relative to the cells' centre keep float32 exact.
    """
    loss_scale, num_iterations, tolerance = limits
    R = pose.R_cam_from_world.copy()
    t = pose.center_world - cells.center_map
    scale = loss_scale * LEVELS_PER_UNIT
    problem = cells.offsets, as_levels(cells.channels), cells.weights, image.rgbx, image.width, scale
    descend_channels(problem, num_iterations, tolerance, R, t)
    return Pose(orthonormal(R), t + cells.center_map)


def fit_on(cells: Cells, blocks: NDArray[np.int32], image: Texels, pose: Pose) -> Fit:
    """A pose with its score on cells, each in its block of the sphere."""
    t = pose.center_world - cells.center_map
    shown = cells.offsets, as_levels(cells.channels), cells.weights
    return Fit(pose, float(score(*shown, blocks, image.rgbx, image.width, pose.R_cam_from_world, t)))


def descend_around(
    cells: Cells,
    blocks: NDArray[np.int32],
    images: tuple[Texels, Texels],
    pose: Pose,
    size: float,
    workers: Workers,
) -> Fit:
    """The best end of descents from around a pose, the wider image first, and from the pose itself."""
    steps = perturbations(size)
    R = np.repeat(pose.R_cam_from_world[None], len(steps), axis=0)
    t = np.repeat((pose.center_world - cells.center_map)[None], len(steps), axis=0)
    scores = np.empty(len(steps))
    both = [(image.rgbx, image.width) for image in images]
    scale = COARSE_LOSS * LEVELS_PER_UNIT
    problem = cells.offsets, as_levels(cells.channels), cells.weights, blocks, *both, scale

    def run(lo: int) -> None:
        part = slice(lo, lo + PERTURBED_BATCH)
        descend_perturbed(*problem, steps[part], R[part], t[part], scores[part])

    workers.map(run, range(0, len(steps), PERTURBED_BATCH), "descend")
    best = int(np.argmax(scores))
    return Fit(Pose(orthonormal(R[best]), t[best] + cells.center_map), float(scores[best]))
