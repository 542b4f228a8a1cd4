"""Colours of points from the photos that see them: weighted medians, so that no single photo decides.

A photo sees the surfaces that are nearest, and well where it is near and looks at them squarely.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..arrays import Array, Array32, Bytes, Int32s
from ..cloud.octree import Octree
from ..geometry.pose import Pose
from ..geometry.sphere import direction_to_pixel, pixel_rays
from ..jobs.threads import Workers
from ..kernels.jit import F0, HALF, kernel, whole
from ..local_features.view_image import render_gray
from ..panorama import Panorama
from ..panorama.model import shrink
from ..panorama.texels import (
    Texels,
    bilinear_weights,
    blend,
    in_camera,
    is_valid,
    locate_texel,
    pack_texels,
    pose_float32,
)

WIDTH = 4096  # [px] of a photo, at most
SAMPLES = 1 << 21  # of photos at points, that a task holds
LEAST_PAINTED = 0.25  # of what a photo sees: of 17 right ones with less, colours refused 14
MOST_PHOTOS = 255  # that are counted for a point
FULL = np.float32(255.0)
SIGHT_WIDTH = 1024  # [px] of the sphere on which ranges are found
BEHIND = np.float32(1.02)  # what is farther than the surface by this factor
BEHIND_OFFSET = np.float32(0.03)  # [m] and this is hidden
NEIGHBOR = 2  # [px] between the pixels by which a surface's slope is found
LEAST_COSINE = 0.02
LEAST_RANGE = 0.3  # [m] nearer surfaces count as much as this


class Sight(NamedTuple):
    """The surfaces around a photo."""

    ranges: Array32  # (H, W) [m], 0 where nothing is seen
    weights: Array32  # (H, W) cosine of the angle to the surface's normal / range^2 [1 / m^2]


def look(octree: Octree, pose: Pose) -> Sight:
    """Return what a photo at a pose in the map sees."""
    ranges = render_gray(octree, pose, np.ones((SIGHT_WIDTH // 2, SIGHT_WIDTH), np.bool_)).ranges
    rays = pixel_rays(SIGHT_WIDTH)
    smooth = np.asarray(cv2.medianBlur(ranges, 3), np.float64)
    points = np.pad(rays * smooth[..., None], ((NEIGHBOR, NEIGHBOR), (0, 0), (0, 0)), mode="edge")
    across = np.roll(points, -NEIGHBOR, axis=1) - np.roll(points, NEIGHBOR, axis=1)
    normals = np.cross(across[NEIGHBOR:-NEIGHBOR], points[2 * NEIGHBOR :] - points[: -2 * NEIGHBOR])
    along = np.abs((normals * rays).sum(axis=-1))
    cosine = along / np.maximum(np.linalg.norm(normals, axis=-1), 1e-12)
    weights = np.maximum(cosine, LEAST_COSINE) / np.maximum(ranges, LEAST_RANGE) ** 2
    return Sight(ranges, np.where(ranges > 0.0, weights, 0.0).astype(np.float32))


@kernel
def weigh_points(
    points: Array32, sight: Sight, R_cam_from_map: Array, center_map: Array, found: Array32
) -> None:
    """Write how well a photo sees each of some points (N, 3) of the map, 0 for what is hidden."""
    pose = pose_float32(R_cam_from_map, center_map)
    height, width = sight.ranges.shape
    for n in range(len(points)):
        x, y, z = in_camera(points[n, 0], points[n, 1], points[n, 2], pose)
        rho2 = x * x + y * y
        u, v = direction_to_pixel(x, y, z, np.sqrt(rho2), np.float32(width))
        i = min(whole(v), height - 1)
        j = min(whole(u), width - 1)
        is_seen = np.sqrt(rho2 + z * z) <= sight.ranges[i, j] * BEHIND + BEHIND_OFFSET
        found[n] = sight.weights[i, j] if is_seen else F0


class Brush(NamedTuple):
    """A photo that gives colours."""

    texels: Texels
    pose: Pose  # in the map
    gains: Array32  # (3,) by which its colours are multiplied
    sight: Sight


class Paint(NamedTuple):
    """Colours of points."""

    colors: Bytes  # (N, 3) RGB, 0 where no photo looks
    num_photos: Bytes  # (N,) that see the point


def make_brushes(
    octree: Octree, panoramas: Sequence[Panorama], poses: Sequence[Pose], gains: Array32, workers: Workers
) -> list[Brush]:
    """Return the photos at their poses in a map, with gains (photos, 3)."""

    def make(k: int) -> Brush:
        shown = shrink(panoramas[k], WIDTH)
        return Brush(pack_texels(shown.rgb, shown.is_valid), poses[k], gains[k], look(octree, poses[k]))

    return workers.map(make, range(len(poses)), "see")


def paint_points(points: Array32, brushes: Sequence[Brush], workers: Workers) -> Paint:
    """Return the colours of points (N, 3) of the map."""
    paint = Paint(np.empty((len(points), 3), np.uint8), np.empty(len(points), np.uint8))
    at_once = max(1, SAMPLES // len(brushes))

    def run(lo: int) -> None:
        part = slice(lo, lo + at_once)
        some = points[part]
        weights = np.empty((len(brushes), len(some)), np.float32)
        colors = np.empty((len(brushes), len(some), 3), np.float32)
        for k, (texels, pose, gains, sight) in enumerate(brushes):
            R, t = pose.R_cam_from_world, pose.center_world
            weigh_points(some, sight, R, t, weights[k])
            read_colors(some, texels.rgbx, texels.width, gains, R, t, weights[k], colors[k])
        find_medians(colors, weights, paint.colors[part], paint.num_photos[part])

    workers.map(run, range(0, len(points), at_once), "paint")
    return paint


def sees_paint(brush: Brush, points: Array32, paint: Paint) -> bool:
    """Return True if enough of what a photo sees of points (N, 3), by its solid angle, has paint."""
    weights = np.empty(len(points), np.float32)
    weigh_points(points, brush.sight, brush.pose.R_cam_from_world, brush.pose.center_world, weights)
    return bool(weights[paint.num_photos > 0].sum() > LEAST_PAINTED * weights.sum())


@kernel
def read_colors(
    points: Array32,
    texels: Int32s,
    width: int,
    gains: Array32,
    R_cam_from_map: Array,
    center_map: Array,
    weights: Array32,
    colors: Array32,
) -> None:
    """Write what a photo shows at points (N, 3) whose weights (N,) are above 0; masked, they become 0."""
    pose = pose_float32(R_cam_from_map, center_map)
    for n in range(len(points)):
        if weights[n] <= F0:
            continue
        x, y, z = in_camera(points[n, 0], points[n, 1], points[n, 2], pose)
        k, fu, fv = locate_texel(x, y, z, np.sqrt(x * x + y * y), width)
        below = k + width + 2
        t00, t10, t01, t11 = texels[k], texels[k + 1], texels[below], texels[below + 1]
        weights[n] *= is_valid(t00, t10, t01, t11)
        blended = bilinear_weights(fu, fv)
        for c in range(3):
            colors[n, c] = min(blend(t00, t10, t01, t11, blended, 8 * c) * gains[c], FULL)


@kernel
def find_medians(colors: Array32, weights: Array32, medians: Bytes, counts: Bytes) -> None:
    """Write weighted medians (N, 3) of colours (K, N, 3), and how many weights (K, N) are above 0 (N,)."""
    num = len(weights)
    values = np.empty(num, np.float32)
    loads = np.empty(num, np.float32)
    for n in range(weights.shape[1]):
        count = 0
        for k in range(num):
            count += weights[k, n] > F0
        counts[n] = min(count, MOST_PHOTOS)
        for c in range(3):
            total = F0
            filled = 0
            for k in range(num):
                if weights[k, n] <= F0:
                    continue
                at = filled
                while at > 0 and values[at - 1] > colors[k, n, c]:
                    values[at] = values[at - 1]
                    loads[at] = loads[at - 1]
                    at -= 1
                values[at] = colors[k, n, c]
                loads[at] = weights[k, n]
                total += weights[k, n]
                filled += 1
            at = 0
            below = loads[0] if filled else F0
            while below < HALF * total:
                at += 1
                below += loads[at]
            medians[n, c] = np.uint8(values[at] + HALF) if filled else np.uint8(0)
