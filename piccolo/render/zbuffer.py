"""The cloud seen from a pose: z-buffered equirectangular views, and which points the camera sees."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose
from ..geometry.sphere import direction_to_pixel
from ..runtime.jit import kernel

# A point is visible if it is not farther than the nearest in its cell by this much. The factor lets grazing
# floors and walls through, whose ranges vary within a cell; the offset [m] covers range noise nearby.
VISIBLE_FACTOR = np.float32(1.08)
VISIBLE_OFFSET = np.float32(0.1)
MIN_VIEW_WIDTH, MAX_VIEW_WIDTH = 32, 4096  # [px] of a rendered view
VISIBLE_WIDTH = 180  # cells of 2 degrees


@dataclass(frozen=True)
class View:
    """What the camera sees of the cloud, on an equirectangular grid."""

    depth: NDArray[np.float32]  # (H, W) range of the nearest point [m], inf where there is none
    rgb: NDArray[np.float32]  # (H, W, 3) mean colour in [0, 1] of the points near that range, 0 where empty

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """(H, W), true where a point was seen."""
        return np.isfinite(self.depth)


@kernel
def cells_and_ranges(x, y, z, R_cam_from_world, center_world, width, cells, ranges):
    """Write for each point the cell (row * width + column) and the range [m] at which the camera sees it."""
    R, t = R_cam_from_world, center_world
    W = np.float32(width)
    last_column, last_row = np.int32(width - 1), np.int32(width // 2 - 1)
    r00, r01, r02 = np.float32(R[0, 0]), np.float32(R[0, 1]), np.float32(R[0, 2])
    r10, r11, r12 = np.float32(R[1, 0]), np.float32(R[1, 1]), np.float32(R[1, 2])
    r20, r21, r22 = np.float32(R[2, 0]), np.float32(R[2, 1]), np.float32(R[2, 2])
    tx, ty, tz = np.float32(t[0]), np.float32(t[1]), np.float32(t[2])
    for i in range(len(x)):
        dx, dy, dz = x[i] - tx, y[i] - ty, z[i] - tz
        px = r00 * dx + r01 * dy + r02 * dz
        py = r10 * dx + r11 * dy + r12 * dz
        pz = r20 * dx + r21 * dy + r22 * dz
        rho2 = px * px + py * py
        u, v = direction_to_pixel(px, py, pz, math.sqrt(rho2), W)
        cells[i] = min(np.int32(v), last_row) * np.int32(width) + min(np.int32(u), last_column)
        ranges[i] = math.sqrt(rho2 + pz * pz)


@kernel
def scatter_nearest(cells, ranges, depth):
    """Write the nearest range [m] of each cell into `depth` (H * W,), which holds inf before."""
    for i in range(len(cells)):
        depth[cells[i]] = min(depth[cells[i]], ranges[i])


def cells_of(
    points: PackedPoints, pose: Pose, width: int
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Cell (N,) and range (N,) [m] of each point, and the nearest range (width / 2 * width,) of each cell."""
    cells, ranges = np.empty(len(points), np.int32), np.empty(len(points), np.float32)
    R, t = pose.R_cam_from_world, pose.center_world
    cells_and_ranges(points.x, points.y, points.z, R, t, width, cells, ranges)
    depth = np.full(width // 2 * width, np.inf, dtype=np.float32)
    scatter_nearest(cells, ranges, depth)
    return cells, ranges, depth


def nearest_depth(points: PackedPoints, pose: Pose, width: int) -> NDArray[np.float32]:
    """Range (width / 2 * width,) [m] of the nearest point in each cell, inf where there is none."""
    return cells_of(points, pose, width)[2]


def render_view(points: PackedPoints, pose: Pose, width: int, band: float = 0.15) -> View:
    """The cloud at `pose`, `width` cells around; colours are of the points within 1 + band of the nearest."""
    cells, ranges, depth = cells_of(points, pose, width)
    is_near = ranges <= depth[cells] * np.float32(1.0 + band)
    cells, rgbx = cells[is_near], points.rgbx[is_near]
    sums = [np.bincount(cells, (rgbx >> shift) & 255, len(depth)) for shift in (0, 8, 16)]
    counts = np.bincount(cells, minlength=len(depth))
    rgb = (np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None] / 255.0).astype(np.float32)
    return View(depth.reshape(width // 2, width), rgb.reshape(width // 2, width, 3))


def visible_points(points: PackedPoints, center_world: Array) -> PackedPoints:
    """The points that a camera at `center_world` (3,) sees, whichever way it is turned."""
    cells, ranges, depth = cells_of(points, Pose(np.eye(3), center_world), VISIBLE_WIDTH)
    return points.take(near_front(cells, ranges, depth))


def near_front(
    cells: NDArray[np.int32], ranges: NDArray[np.float32], depth: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Indices of the points that are hardly farther than the `depth` of their cells."""
    return np.flatnonzero(ranges <= depth[cells] * VISIBLE_FACTOR + VISIBLE_OFFSET)
