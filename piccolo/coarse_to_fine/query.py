"""One look for a panorama in a prepared map: search every place, descend from the best, polish, finish."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import RIVAL_ANGLE, RIVAL_DISTANCE, Hypothesis, distinct_best
from ..geometry.pose import Array, Pose, orthonormal
from ..geometry.rotations import Gravity, uniform_rotations, uniform_yaws
from ..geometry.sphere_grid import make_tiling
from ..optimize.descent import correlate, descend, descend_shaken, descend_starts
from ..panorama import Panorama, rotation_to_level
from ..panorama.channels import LEVELS_PER_UNIT, ZERO_LEVEL
from ..panorama.local_normalization import Scale, comparable
from ..panorama.texels import Texels
from ..runtime.threads import Workers
from .prior import allowed_rotations
from .scan_map import SEARCH_VIEW, ScanMap
from .search import best_poses, correlate_pairs, pick_distinct, score_poses, score_poses_wide, turn_panorama
from .settings import EngineSettings
from .starts import (
    SAME_ANGLE_DEG,
    SAME_DISTANCE,
    START_ANGLE_DEG,
    START_DISTANCE,
    Starts,
    best_and_rivals,
    shakes,
)
from .view import Cells, ViewKind, render_view, seen_points

MIDDLE_VIEW = ViewKind(num_rings=48, stats_rings=24, sigma_deg=14.0, voxel_per_range=1 / 30)
FINE_VIEW = ViewKind(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 80)
FINISH_VIEW = ViewKind(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150)
SCALES: tuple[
    Scale, ...
] = (  # of the panorama for the last millimetres and for the fine, middle and searched views
    Scale(1024, 0.0, FINISH_VIEW.sigma_deg),
    Scale(256, 0.0, FINE_VIEW.sigma_deg),
    Scale(128, 0.0, MIDDLE_VIEW.sigma_deg),
    Scale(128, 7.5, SEARCH_VIEW.sigma_deg),
)
COARSE_LOSS, FINE_LOSS, FINISH_LOSS = 1.2, 1.0, 0.7  # scales of the Geman-McClure loss [deviations]
FINISH_ROUNDS = 2

POLISH_SHARE = 0.4  # of these, for the last shakes
MAX_POLISHES, MIN_POLISH_GAIN = 5, 0.01
MAX_FINISH_LOSS = 0.01  # of the score, in exchange for millimetres


def as_levels(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Channels in deviations as 8-bit levels, not rounded."""
    return np.asarray(features * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL))


def descend_cells(
    cells: Cells, center: Array, texels: Texels, pose: Pose, limits: tuple[float, int, float]
) -> Hypothesis:
    """Descend from `pose` on cells around `center` (3,); limits are loss scale, iterations and least step.

    Coordinates relative to the centre keep float32 exact.
    """
    offsets, features, weights = cells
    loss_scale, num_iterations, tolerance = limits
    R, t = pose.R_cam_from_world.copy(), pose.center_world - center
    levels, width = as_levels(features), texels.width
    scale = loss_scale * LEVELS_PER_UNIT
    descend(offsets, levels, weights, texels.rgbx, width, scale, num_iterations, tolerance, R, t)
    score, shared = correlate(offsets, levels, weights, texels.rgbx, width, R, t)
    return Hypothesis(Pose(orthonormal(R), t + center), float(score * math.sqrt(shared)))


@dataclass(frozen=True)
class Look:
    """A prepared map, a panorama at the scales of SCALES, and how to search."""

    scan_map: ScanMap
    images: Sequence[Texels]
    R_cam_from_level: Array  # (3, 3) how the camera was tilted where gravity is known
    settings: EngineSettings
    workers: Workers

    def search(self, gravity: Gravity) -> Starts:
        """Every candidate position with every rotation as matrix products; the distinct best."""
        m, settings = self.scan_map, self.settings
        num_starts = len(m.centers) // settings.candidates_per_start
        num_starts = min(max(num_starts, settings.min_starts), settings.max_starts)
        num_pool = num_starts * settings.poses_per_start
        is_known = gravity == "known"
        if is_known:
            rotations = self.R_cam_from_level @ uniform_yaws(settings.num_yaws)
        else:
            rotations = uniform_rotations(settings.num_rotations)
        rotations = allowed_rotations(rotations @ m.R_map_from_world, settings.prior) @ m.R_map_from_world.T
        samples, validity = turn_panorama(self.images[3], rotations)
        if is_known:
            candidate, rotation, scores = best_poses(score_poses(m, samples, validity), num_pool)
        else:  # on wide cells and fewer positions first, as there are so many rotations
            candidate, rotation, _ = best_poses(score_poses_wide(m, samples, validity), num_pool)
            candidate, scores = m.sparse[candidate], np.empty(len(candidate), np.float32)
            area = make_tiling(SEARCH_VIEW.num_rings).solid_angle
            correlate_pairs(m.features, m.is_seen, area, samples, validity, candidate, rotation, scores)
            order = np.lexsort((rotation, candidate, -scores))
            candidate, rotation, scores = candidate[order], rotation[order], scores[order]
        kept = pick_distinct(
            rotations[rotation], m.centers[candidate], num_starts, START_DISTANCE, START_ANGLE_DEG
        )
        candidate, rotation, scores = candidate[kept], rotation[kept], scores[kept]
        return Starts(rotations[rotation], m.centers[candidate], candidate, scores.astype(np.float64))

    def descend_searched(self, starts: Starts, num_iterations: int, count: int) -> Starts:
        """Descend from each start on its candidate's prepared view; keep the distinct best."""
        m, image = self.scan_map, self.images[3]
        R, t = starts.R_cam_from_map.copy(), starts.center_map.copy()
        scores = np.empty(len(t))
        area, scale = make_tiling(SEARCH_VIEW.num_rings).solid_angle, COARSE_LOSS * LEVELS_PER_UNIT
        views = m.offsets, m.offset_unit, m.features, m.is_seen, area, m.centers
        how = image.rgbx, image.width, scale, num_iterations

        def run(lo: int) -> None:
            part = slice(lo, lo + 16)
            descend_starts(*views, *how, starts.candidate[part], R[part], t[part], scores[part])

        list(self.workers.each(run, range(0, len(t), 16), "descend"))
        order = np.argsort(-scores, kind="stable")
        near = pick_distinct(R[order], t[order], count - count // 4, SAME_DISTANCE, SAME_ANGLE_DEG)
        apart = pick_distinct(R[order], t[order], count, RIVAL_DISTANCE, math.degrees(RIVAL_ANGLE))
        rivals = apart[~np.isin(apart, near)][: count - len(near)]
        kept = order[np.sort(np.concatenate([near, rivals]))]
        return Starts(R[kept], t[kept], starts.candidate[kept], scores[kept])

    def descend_middle(self, h: Hypothesis) -> Hypothesis:
        """Descend on middle cells, seen from where the pose is now."""
        center = h.pose.center_world
        cells = render_view(self.scan_map.octree, center, MIDDLE_VIEW)
        return descend_cells(cells, center, self.images[2], h.pose, (COARSE_LOSS, 12, 1e-3))

    def shake(self, h: Hypothesis, kind: ViewKind, images: tuple[Texels, Texels], share: float) -> Hypothesis:
        """Descend again from around a pose, the wider image first; the best of these and the pose itself."""
        center, steps, (wide, narrow) = h.pose.center_world, shakes(share), images
        offsets, features, weights = render_view(self.scan_map.octree, center, kind)
        R, t = np.repeat(h.pose.R_cam_from_world[None], len(steps), axis=0), np.zeros((len(steps), 3))
        scores = np.empty(len(steps))
        both = wide.rgbx, wide.width, narrow.rgbx, narrow.width
        scale = COARSE_LOSS * LEVELS_PER_UNIT
        descend_shaken(offsets, as_levels(features), weights, *both, scale, steps, R, t, scores)
        best = int(np.argmax(scores))
        return Hypothesis(Pose(orthonormal(R[best]), t[best] + center), float(scores[best]))

    def shake_middle(self, h: Hypothesis) -> Hypothesis:
        """Shake on middle cells."""
        return self.shake(h, MIDDLE_VIEW, (self.images[3], self.images[2]), 1.0)

    def descend_fine(self, h: Hypothesis) -> Hypothesis:
        """Descend on fine cells, seen from where the pose is now."""
        center = h.pose.center_world
        cells = render_view(self.scan_map.octree, center, FINE_VIEW)
        return descend_cells(cells, center, self.images[1], h.pose, (FINE_LOSS, 12, 1e-4))

    def polish(self, h: Hypothesis) -> Hypothesis:
        """Shake and refine for as long as the score rises: a pose that stopped short creeps on."""
        for _ in range(MAX_POLISHES):
            shaken = self.shake(h, FINE_VIEW, (self.images[2], self.images[1]), POLISH_SHARE)
            refined = self.descend_fine(shaken)
            gain = refined.score - h.score
            h = refined if gain > 0.0 else h
            if gain < MIN_POLISH_GAIN:
                break
        return h

    def score_at(self, pose: Pose) -> float:
        """Score of a pose on fine cells, seen from just there."""
        center, image = pose.center_world, self.images[1]
        offsets, features, weights = render_view(self.scan_map.octree, center, FINE_VIEW)
        levels, R = as_levels(features), pose.R_cam_from_world
        score, shared = correlate(offsets, levels, weights, image.rgbx, image.width, R, np.zeros(3))
        return float(score * math.sqrt(shared))

    def finish(self, h: Hypothesis) -> Hypothesis:
        """The last millimetres: the visible points themselves in the finest image, unless the score falls."""
        before, pose = self.score_at(h.pose), h.pose
        for _ in range(FINISH_ROUNDS):
            center = pose.center_world
            points = seen_points(self.scan_map.octree, center, FINISH_VIEW, self.settings.num_points)
            pose = descend_cells(points, center, self.images[0], pose, (FINISH_LOSS, 10, 1e-4)).pose
        score = self.score_at(pose)
        return Hypothesis(pose, score) if score > before - MAX_FINISH_LOSS else Hypothesis(h.pose, before)

    def refine(self, starts: Starts) -> tuple[list[Hypothesis], list[Hypothesis]]:
        """Successive halving from the starts to a few poses on fine cells, the polished best first.

        Then the many on middle cells, for the rivals among them.
        """
        settings = self.settings

        def each(function: Callable[[Hypothesis], Hypothesis], some: list[Hypothesis]) -> list[Hypothesis]:
            return list(self.workers.each(function, some, "descend"))

        coarse = self.descend_searched(starts, 5, settings.num_coarse)
        coarse = self.descend_searched(coarse, 12, settings.num_middle)
        middle = each(self.descend_middle, coarse.hypotheses())
        shaken = each(self.shake_middle, best_and_rivals(middle, settings.num_fine))
        fine = each(self.descend_fine, best_and_rivals(shaken, settings.num_fine))
        angle = math.radians(SAME_ANGLE_DEG)
        polished = each(self.polish, distinct_best(fine, settings.num_polished, 0.1, angle))
        return sorted([*polished, *fine], key=lambda h: -h.score), middle


def look_for(panorama: Panorama, scan_map: ScanMap, settings: EngineSettings, workers: Workers) -> Look:
    """The look for a panorama among a map's candidates; its metadata say how the camera was tilted."""
    R_level_from_cam = rotation_to_level(panorama.gpano) if panorama.gpano else None
    R_cam_from_level = np.eye(3) if R_level_from_cam is None else R_level_from_cam.T
    return Look(scan_map, comparable(panorama, SCALES), R_cam_from_level, settings, workers)
