"""Steps 1 to 3 of the paper's Algorithm 1: score poses on a grid in free space, keep the diverse best."""

import math

import numpy as np

from ..arrays import Array, Array32, Mask
from ..cloud.soa import PackedPoints
from ..confidence.alternatives import Hypothesis, best_distinct
from ..geometry.nearness import Nearness
from ..geometry.pose import Pose
from ..geometry.sphere import solid_angles
from ..jobs.threads import Workers
from ..optimize.refine import Loss
from ..panorama import Panorama
from ..panorama.model import shrink
from ..views.zbuffer import is_free_space, render_view, visible_points
from .settings import PaperSettings

MIN_CLEARANCE = 0.25  # a camera is not nearer to a surface than this [m]
PROBE_WIDTH = 48  # cells of 7.5 degrees for the two tests


def box_grid(low: Array, high: Array, num_cells: int) -> Array:
    """Return centres (M, 3) of near-cubic cells that fill a box, M near `num_cells`, one an axis at least."""
    size = np.maximum(high - low, 1e-3)
    edge = (size.prod() / num_cells) ** (1.0 / 3.0)
    for _ in range(3):  # an axis shorter than the edge gets one cell: the others share the number
        is_long = size > edge
        if is_long.any():
            edge = (size[is_long].prod() / num_cells) ** (1.0 / is_long.sum())
    counts = np.maximum(np.round(size / edge), 1).astype(int)
    axes = [low[k] + size[k] * (np.arange(counts[k]) + 0.5) / counts[k] for k in range(3)]
    return np.column_stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


def farthest_point_sampling(positions: Array, count: int) -> Array:
    """Return at most `count` of the positions (N, 3), in their order.

    Each is chosen farthest from those chosen before it.
    """
    if len(positions) <= count:
        return positions
    chosen = [0]
    distance = np.linalg.norm(positions - positions[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return np.asarray(positions[np.sort(chosen)])


def free_grid(points: PackedPoints, num_translations: int, margin: float) -> Array:
    """Return camera positions (M, 3) in free space on a uniform grid over the box, M <= num_translations.

    The box is that of the points, made smaller by `margin` of its size on every side. The grid is refined
    until enough of its positions are free, and thinned out evenly if they are too many. Empty if none is
    free.
    """
    low = np.array([points.x.min(), points.y.min(), points.z.min()], dtype=np.float64)
    high = np.array([points.x.max(), points.y.max(), points.z.max()], dtype=np.float64)
    inset = margin * (high - low)
    low += inset
    high -= inset
    probed = points.take(slice(None, None, max(1, len(points) // 200_000)))  # evenly in space
    free = np.empty((0, 3))
    for growth in (1.0, 1.5, 2.25, 3.4, 5.0, 7.6, 11.4, 17.0, 26.0):
        grid = box_grid(low, high, round(num_translations * growth))
        free = grid[[is_free_space(probed, center, PROBE_WIDTH, MIN_CLEARANCE) for center in grid]]
        if len(free) >= num_translations:
            break
    return farthest_point_sampling(free, num_translations)


def color_histogram(rgb: Array32, counts: Mask, bins: int) -> Array:
    """Return the fraction (bins ** 3,) of the solid angle in each colour, of an image (H, W, 3) in [0, 1].

    Only pixels of `counts` (H, W) are counted; all zero if there is none.
    """
    level = np.minimum((rgb * bins).astype(np.int64), bins - 1)
    index = (level[..., 0] * bins + level[..., 1]) * bins + level[..., 2]
    weights = counts * solid_angles(rgb.shape[1])[:, None]
    histogram = np.bincount(index.ravel(), weights.ravel(), minlength=bins**3)
    return np.asarray(histogram / max(histogram.sum(), 1e-12))


def histogram_similarity(points: PackedPoints, panorama: Panorama, pose: Pose, bins: int) -> float:
    """Return the histogram intersection [0, 1] of panorama and cloud at `pose`, where both show something.

    It is the overlap of two histograms that each sum to 1 (Swain and Ballard, 1991).
    """
    view = render_view(points, pose, panorama.rgb.shape[1])
    counts = view.is_seen & panorama.is_valid
    of_cloud = color_histogram(view.rgb, counts, bins)
    of_panorama = color_histogram(panorama.rgb.astype(np.float32) / 255.0, counts, bins)
    return float(np.minimum(of_cloud, of_panorama).sum())


def search(
    points: PackedPoints,
    panorama: Panorama,
    loss: Loss,
    positions: Array,
    rotations: Array,
    settings: PaperSettings,
    workers: Workers,
) -> list[Hypothesis]:
    """Select the K2 poses to descend from, of all positions (N_t, 3) with all rotations (N_r, 3, 3)."""

    def losses(center_world: Array) -> list[Hypothesis]:
        seen = visible_points(points, center_world) if settings.use_visibility else points
        poses = [Pose(R_cam_from_world, center_world) for R_cam_from_world in rotations]
        found = [Hypothesis(pose, -loss.value(seen, pose)) for pose in poses]
        return [h for h in found if np.isfinite(h.score)]

    scored = [h for batch in workers.map(losses, list(positions), "search") for h in batch]
    near = Nearness(settings.min_distance, math.radians(settings.min_angle_deg))
    if settings.initialization == "loss-only":
        return best_distinct(scored, settings.num_by_histogram, near)
    by_loss = best_distinct(scored, settings.num_by_loss, near)
    small = shrink(panorama, settings.histogram_width)

    def rescore(h: Hypothesis) -> Hypothesis:
        return Hypothesis(h.pose, histogram_similarity(points, small, h.pose, settings.histogram_bins))

    by_histogram = list(workers.map(rescore, by_loss, "compare colours"))
    return best_distinct(by_histogram, settings.num_by_histogram, near)
