"""Steps 1 to 3 of the paper's Algorithm 1: score poses on a grid, keep the diverse best."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose, are_same
from ..optimize.refine import Loss
from ..panorama import Panorama
from ..panorama.resize import shrink
from ..render.zbuffer import render_view, visible_points
from ..runtime.threads import Workers
from .histogram import color_histogram, histogram_intersection
from .settings import PaperSettings


@dataclass(frozen=True)
class Scored:
    """A pose and its score, smaller is better."""

    pose: Pose
    score: float


def keep_diverse(
    candidates: Sequence[Scored], count: int, min_distance: float, min_angle: float
) -> list[Scored]:
    """The `count` candidates of the smallest finite scores of which no two are the same pose."""
    kept: list[Scored] = []
    for candidate in sorted(candidates, key=lambda c: c.score):
        if len(kept) == count or not np.isfinite(candidate.score):
            break
        if not any(are_same(candidate.pose, other.pose, min_distance, min_angle) for other in kept):
            kept.append(candidate)
    return kept


def losses_at(
    points: PackedPoints, loss: Loss, center_world: Array, rotations: NDArray[np.float64]
) -> list[Scored]:
    """Loss of every rotation (N, 3, 3) at one position (3,)."""
    poses = [Pose(R_cam_from_world, center_world) for R_cam_from_world in rotations]
    return [Scored(pose, loss.value(points, pose)) for pose in poses]


def histogram_distance(points: PackedPoints, panorama: Panorama, pose: Pose, bins: int) -> float:
    """One minus the histogram intersection of panorama and cloud at `pose`, where both show something."""
    view = render_view(points, pose, panorama.rgb.shape[1])
    counts = view.is_seen & panorama.is_valid
    of_cloud = color_histogram(view.rgb, counts, bins)
    of_panorama = color_histogram(panorama.rgb.astype(np.float32) / 255.0, counts, bins)
    return 1.0 - histogram_intersection(of_cloud, of_panorama)


def search(
    points: PackedPoints,
    panorama: Panorama,
    loss: Loss,
    grid: tuple[NDArray[np.float64], NDArray[np.float64]],
    settings: PaperSettings,
    workers: Workers,
) -> list[Scored]:
    """The K2 poses to descend from, of all positions (N_t, 3) and rotations (N_r, 3, 3) of `grid`."""
    positions, rotations = grid
    distance, angle = settings.min_distance, np.radians(settings.min_angle_deg)

    def losses(center_world: Array) -> list[Scored]:
        seen = visible_points(points, center_world) if settings.use_visibility else points
        return losses_at(seen, loss, center_world, rotations)

    scored = [s for batch in workers.each(losses, list(positions), "search") for s in batch]
    if settings.initialization == "loss-only":
        return keep_diverse(scored, settings.num_by_histogram, distance, angle)
    by_loss = keep_diverse(scored, settings.num_by_loss, distance, angle)
    small = shrink(panorama, settings.histogram_width)

    def rescored(candidate: Scored) -> Scored:
        return Scored(
            candidate.pose, histogram_distance(points, small, candidate.pose, settings.histogram_bins)
        )

    by_histogram = list(workers.each(rescored, by_loss, "compare colours"))
    return keep_diverse(by_histogram, settings.num_by_histogram, distance, angle)
