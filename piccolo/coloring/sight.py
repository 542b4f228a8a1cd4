"""The surfaces of a scan that a photo sees: how far away they are, and how well it sees them."""

from typing import NamedTuple

import cv2
import numpy as np

from ..arrays import Array, Array32
from ..cloud.octree import Octree
from ..geometry.pose import Pose
from ..geometry.sphere import direction_to_pixel, pixel_rays
from ..kernels.jit import F0, kernel, whole
from ..local_features.view_image import render_gray
from ..panorama.texels import in_camera, pose_float32

WIDTH = 1024  # [px] of the sphere on which ranges are found
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
    ranges = render_gray(octree, pose, np.ones((WIDTH // 2, WIDTH), np.bool_)).ranges
    rays = pixel_rays(WIDTH)
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
    points: Array32,
    ranges: Array32,
    weights: Array32,
    R_cam_from_map: Array,
    center_map: Array,
    found: Array32,
) -> None:
    """Write how well a photo sees each of some points (N, 3) of the map, 0 for what is hidden."""
    pose = pose_float32(R_cam_from_map, center_map)
    height, width = ranges.shape
    for n in range(len(points)):
        x, y, z = in_camera(points[n, 0], points[n, 1], points[n, 2], pose)
        rho2 = x * x + y * y
        u, v = direction_to_pixel(x, y, z, np.sqrt(rho2), np.float32(width))
        i = min(whole(v), height - 1)
        j = min(whole(u), width - 1)
        is_seen = np.sqrt(rho2 + z * z) <= ranges[i, j] * BEHIND + BEHIND_OFFSET
        found[n] = weights[i, j] if is_seen else F0
