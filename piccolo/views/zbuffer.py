"""The cloud seen from a pose: z-buffered views, which points the camera sees, whether it can stand there."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose
from ..geometry.sphere import direction_to_pixel, solid_angles
from ..kernels.jit import kernel
from ..panorama.texels import channel, in_camera, pose_float32

CHUNK = 4096
EMPTY = np.float32(np.inf)

# A point is visible if it is not farther than the nearest in its cell by this much. The factor lets grazing
# floors and walls through, whose ranges vary within a cell; the offset [m] covers range noise nearby.
VISIBLE_FACTOR = np.float32(1.08)
VISIBLE_OFFSET = np.float32(0.1)
MIN_VIEW_WIDTH, MAX_VIEW_WIDTH = 32, 4096  # [px] of a rendered view
VISIBLE_WIDTH = 180  # cells of 2 degrees
MIN_SEEN_FRACTION = 0.4  # of the sphere; less is seen from outside a scan


class View(NamedTuple):
    """What the camera sees of the cloud, on an equirectangular grid."""

    depth: NDArray[np.float32]  # (H, W) range of what is nearest [m], inf where there is nothing
    rgb: NDArray[Any]  # (H, W, 3) mean colour of what is near that range, 0 where there is nothing

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """(H, W), true where something was seen."""
        return np.isfinite(self.depth)


@kernel
def cells_and_ranges(x, y, z, R_cam_from_world, center_world, width, cells, ranges):
    """Write for each point the cell (row * width + column) and the range [m] at which the camera sees it."""
    W, pose = np.float32(width), pose_float32(R_cam_from_world, center_world)
    last_column, last_row = np.int32(width - 1), np.int32(width // 2 - 1)
    for i in range(len(x)):
        px, py, pz = in_camera(x[i], y[i], z[i], pose)
        rho2 = px * px + py * py
        u, v = direction_to_pixel(px, py, pz, math.sqrt(rho2), W)
        cells[i] = min(np.int32(v), last_row) * np.int32(width) + min(np.int32(u), last_column)
        ranges[i] = math.sqrt(rho2 + pz * pz)


@kernel
def nearest_ranges(x, y, z, R_cam_from_world, center_world, width, depth):
    """Write the range [m] of the nearest point of each cell into `depth` (H * W,), which holds inf before."""
    R, t = R_cam_from_world, center_world
    cells = np.empty(CHUNK, np.int32)
    ranges = np.empty(CHUNK, np.float32)
    for lo in range(0, len(x), CHUNK):
        hi = min(len(x), lo + CHUNK)
        # The arithmetic is vectorised chunk by chunk; the scatter that follows can't be.
        cells_and_ranges(x[lo:hi], y[lo:hi], z[lo:hi], R, t, width, cells, ranges)
        for i in range(hi - lo):
            depth[cells[i]] = min(depth[cells[i]], ranges[i])


@kernel
def mean_colors(x, y, z, rgbx, R_cam_from_world, center_world, width, band, depth, sums):
    """Add up (H * W, 4): R, G, B [8-bit levels] and count of the points within (1 + band) of the nearest."""
    R, t = R_cam_from_world, center_world
    cells = np.empty(CHUNK, np.int32)
    ranges = np.empty(CHUNK, np.float32)
    for lo in range(0, len(x), CHUNK):
        hi = min(len(x), lo + CHUNK)
        cells_and_ranges(x[lo:hi], y[lo:hi], z[lo:hi], R, t, width, cells, ranges)
        for i in range(hi - lo):
            cell = cells[i]
            if ranges[i] <= depth[cell] * band:
                c = rgbx[lo + i]
                sums[cell, 0] += channel(c, 0)
                sums[cell, 1] += channel(c, 8)
                sums[cell, 2] += channel(c, 16)
                sums[cell, 3] += 1


@kernel
def select_visible(x, y, z, R_cam_from_world, center_world, width, depth, indices):
    """Write the indices of the points near the front of their cells; returns how many."""
    R, t = R_cam_from_world, center_world
    cells = np.empty(CHUNK, np.int32)
    ranges = np.empty(CHUNK, np.float32)
    count = 0
    for lo in range(0, len(x), CHUNK):
        hi = min(len(x), lo + CHUNK)
        cells_and_ranges(x[lo:hi], y[lo:hi], z[lo:hi], R, t, width, cells, ranges)
        for i in range(hi - lo):
            if ranges[i] <= depth[cells[i]] * VISIBLE_FACTOR + VISIBLE_OFFSET:
                indices[count] = lo + i
                count += 1
    return count


def nearest_depth(points: PackedPoints, pose: Pose, width: int) -> NDArray[np.float32]:
    """Range (width / 2 * width,) [m] of the nearest point in each cell, inf where there is none."""
    depth = np.full(width // 2 * width, EMPTY, dtype=np.float32)
    nearest_ranges(points.x, points.y, points.z, pose.R_cam_from_world, pose.center_world, width, depth)
    return depth


def render_view(points: PackedPoints, pose: Pose, width: int, band: float = 0.15) -> View:
    """The cloud at `pose`, `width` cells around; colours (float32, 0 to 1) within 1 + band of the nearest."""
    depth = nearest_depth(points, pose, width)
    sums = np.zeros((len(depth), 4))
    R, t = pose.R_cam_from_world, pose.center_world
    mean_colors(points.x, points.y, points.z, points.rgbx, R, t, width, np.float32(1.0 + band), depth, sums)
    rgb = (sums[:, :3] / np.maximum(sums[:, 3:], 1.0) / 255.0).astype(np.float32)
    return View(depth.reshape(width // 2, width), rgb.reshape(width // 2, width, 3))


def visible_points(points: PackedPoints, center_world: Array) -> PackedPoints:
    """The points that a camera at `center_world` (3,) sees, whichever way it is turned."""
    pose = Pose(np.eye(3), center_world)
    depth = nearest_depth(points, pose, VISIBLE_WIDTH)
    indices = np.empty(len(points), dtype=np.int64)
    R, t = pose.R_cam_from_world, pose.center_world
    count = select_visible(points.x, points.y, points.z, R, t, VISIBLE_WIDTH, depth, indices)
    return points.take(indices[:count])


def is_free_space(points: PackedPoints, center: Array, width: int, min_clearance: float) -> bool:
    """True if no point is within `min_clearance` [m] of `center` (3,), and points are seen all around.

    Both follow from the nearest range in each cell of an equirectangular view `width` cells wide.
    """
    depth = nearest_depth(points, Pose(np.eye(3), center), width).reshape(-1, width)
    seen = np.isfinite(depth).sum(axis=1) @ solid_angles(width) / (4.0 * math.pi)
    return bool(depth.min() > min_clearance and seen > MIN_SEEN_FRACTION)
