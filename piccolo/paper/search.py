"""Steps 1 to 3 of the paper's Algorithm 1: score poses on a grid, keep the diverse best."""

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..confidence.alternatives import Hypothesis, best_distinct
from ..geometry.pose import Array, Pose
from ..optimize.refine import Loss
from ..panorama import Panorama
from ..panorama.resize import shrink
from ..render.zbuffer import render_view, visible_points
from ..runtime.threads import Workers
from .histogram import color_histogram, histogram_intersection
from .settings import PaperSettings


def losses_at(
    points: PackedPoints, loss: Loss, center_world: Array, rotations: NDArray[np.float64]
) -> list[Hypothesis]:
    """Every rotation (N, 3, 3) at one position (3,) that has a loss; the score is its negative."""
    poses = [Pose(R_cam_from_world, center_world) for R_cam_from_world in rotations]
    scored = [Hypothesis(pose, -loss.value(points, pose)) for pose in poses]
    return [h for h in scored if np.isfinite(h.score)]


def histogram_similarity(points: PackedPoints, panorama: Panorama, pose: Pose, bins: int) -> float:
    """Histogram intersection [0, 1] of panorama and cloud at `pose`, where both show something."""
    view = render_view(points, pose, panorama.rgb.shape[1])
    counts = view.is_seen & panorama.is_valid
    of_cloud = color_histogram(view.rgb, counts, bins)
    of_panorama = color_histogram(panorama.rgb.astype(np.float32) / 255.0, counts, bins)
    return histogram_intersection(of_cloud, of_panorama)


def search(
    points: PackedPoints,
    panorama: Panorama,
    loss: Loss,
    grid: tuple[NDArray[np.float64], NDArray[np.float64]],
    settings: PaperSettings,
    workers: Workers,
) -> list[Hypothesis]:
    """The K2 poses to descend from, of all positions (N_t, 3) and rotations (N_r, 3, 3) of `grid`."""
    positions, rotations = grid
    distance, angle = settings.min_distance, np.radians(settings.min_angle_deg)

    def losses(center_world: Array) -> list[Hypothesis]:
        seen = visible_points(points, center_world) if settings.use_visibility else points
        return losses_at(seen, loss, center_world, rotations)

    scored = [h for batch in workers.map(losses, list(positions), "search") for h in batch]
    if settings.initialization == "loss-only":
        return best_distinct(scored, settings.num_by_histogram, distance, angle)
    by_loss = best_distinct(scored, settings.num_by_loss, distance, angle)
    small = shrink(panorama, settings.histogram_width)

    def rescored(h: Hypothesis) -> Hypothesis:
        return Hypothesis(h.pose, histogram_similarity(points, small, h.pose, settings.histogram_bins))

    by_histogram = list(workers.map(rescored, by_loss, "compare colours"))
    return best_distinct(by_histogram, settings.num_by_histogram, distance, angle)
