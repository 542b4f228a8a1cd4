"""The cloud seen at a pose, by a z-buffer: views, visible points, and whether a camera can be there."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.points import PackedPoints
from ..geometry.pose import Pose
from ..geometry.sphere import direction_to_pixel, solid_angles
from ..photo.panorama.texels import Pose32, channel, in_camera, pose_float32
from ..system.arrays import Array, Array32, Int32s, Int64s, Mask
from ..system.kernels.jit import kernel, whole

Coordinates = tuple[Array32, Array32, Array32]  # x, y, z (N,) [m]
DEPTH_CHUNK = 4096  # points that a kernel projects at a time

# A point is visible up to this factor times the least range in its cell, plus this offset [m]. The factor
# is for floors and walls seen at grazing angles, whose ranges vary within a cell; the offset is for noise
# nearby. Surfels, which close the surface themselves, and pictures for keypoints, whose pixels are small,
# have limits of their own.
VISIBLE_FACTOR = np.float32(1.08)
VISIBLE_OFFSET = np.float32(0.1)
CELL_BAND = np.float32(1.0 + 0.15)  # a cell's colour is the mean of points up to this times its nearest range
MIN_VIEW_WIDTH = 32  # [px] of a rendered view
MAX_VIEW_WIDTH = 4096
VISIBLE_WIDTH = 180  # [cells] of 2 degrees, by which visible points are found
MIN_SEEN_FRACTION = 0.4  # of the sphere, inside a scan; outside of it less is seen


class View(NamedTuple):
    """A view of the cloud, on an equirectangular grid."""

    depth: Array32  # (H, W) range of the nearest point [m], inf without one
    rgb: NDArray[Any]  # (H, W, 3) mean colour of the points near that range, 0 without one

    @property
    def is_seen(self) -> Mask:
        """Mask (H, W) of the cells in which a point is seen."""
        return np.isfinite(self.depth)


@kernel
def cells_and_ranges(
    points: Coordinates, begin: int, pose: Pose32, width: int, cells: Int32s, ranges: Array32
) -> int:
    """Write cell (row * width + column) and range [m] of a chunk of points; return its length.

    The chunk begins at `begin`. This loop is vectorised; what callers do with the cells can't be.
    """
    W = np.float32(width)
    last_column = np.int32(width - 1)
    last_row = np.int32(width // 2 - 1)
    x, y, z = points
    end = min(len(x), begin + DEPTH_CHUNK)
    x = x[begin:end]
    y = y[begin:end]
    z = z[begin:end]
    for i in range(len(x)):
        px, py, pz = in_camera(x[i], y[i], z[i], pose)
        rho2 = px * px + py * py
        u, v = direction_to_pixel(px, py, pz, math.sqrt(rho2), W)
        cells[i] = min(whole(v), last_row) * np.int32(width) + min(whole(u), last_column)
        ranges[i] = math.sqrt(rho2 + pz * pz)
    return len(x)


@kernel
def nearest_ranges(
    points: Coordinates, R_cam_from_world: Array, center_world: Array, width: int, depth: Array32
) -> None:
    """Write the range [m] of the nearest point of each cell into `depth` (H * W,), which holds inf before."""
    pose = pose_float32(R_cam_from_world, center_world)
    cells = np.empty(DEPTH_CHUNK, np.int32)
    ranges = np.empty(DEPTH_CHUNK, np.float32)
    for lo in range(0, len(points[0]), DEPTH_CHUNK):
        for i in range(cells_and_ranges(points, lo, pose, width, cells, ranges)):
            depth[cells[i]] = min(depth[cells[i]], ranges[i])


@kernel
def mean_colors(
    points: Coordinates,
    rgbx: Int32s,
    R_cam_from_world: Array,
    center_world: Array,
    width: int,
    depth: Array32,
    sums: Array,
) -> None:
    """Add R, G, B [8-bit levels] and count of the points within CELL_BAND of `depth` to `sums` (H * W, 4)."""
    pose = pose_float32(R_cam_from_world, center_world)
    cells = np.empty(DEPTH_CHUNK, np.int32)
    ranges = np.empty(DEPTH_CHUNK, np.float32)
    for lo in range(0, len(points[0]), DEPTH_CHUNK):
        for i in range(cells_and_ranges(points, lo, pose, width, cells, ranges)):
            cell = cells[i]
            if ranges[i] <= depth[cell] * CELL_BAND:
                c = rgbx[lo + i]
                sums[cell, 0] += channel(c, 0)
                sums[cell, 1] += channel(c, 8)
                sums[cell, 2] += channel(c, 16)
                sums[cell, 3] += 1


@kernel
def select_visible(
    points: Coordinates,
    R_cam_from_world: Array,
    center_world: Array,
    width: int,
    depth: Array32,
    indices: Int64s,
) -> int:
    """Write the indices of the visible points, by least ranges (H * W,) [m]; return their number."""
    pose = pose_float32(R_cam_from_world, center_world)
    cells = np.empty(DEPTH_CHUNK, np.int32)
    ranges = np.empty(DEPTH_CHUNK, np.float32)
    count = 0
    for lo in range(0, len(points[0]), DEPTH_CHUNK):
        for i in range(cells_and_ranges(points, lo, pose, width, cells, ranges)):
            if ranges[i] <= depth[cells[i]] * VISIBLE_FACTOR + VISIBLE_OFFSET:
                indices[count] = lo + i
                count += 1
    return count


def _xyz(points: PackedPoints) -> Coordinates:
    return points.x, points.y, points.z


def nearest_depth(points: PackedPoints, pose: Pose, width: int) -> Array32:
    """Return the range (width / 2, width) [m] of the nearest point in each cell, inf where there is none."""
    depth = np.full((width // 2, width), np.inf, np.float32)
    nearest_ranges(_xyz(points), pose.R_cam_from_world, pose.center_world, width, depth.reshape(-1))
    return depth


def render_view(points: PackedPoints, pose: Pose, width: int) -> View:
    """Render the cloud at a pose, (width / 2, width) cells; colours in float32, 0 to 1.

    A cell's colour is the mean of the points within CELL_BAND of its nearest range.
    """
    depth = nearest_depth(points, pose, width)
    sums = np.zeros((depth.size, 4))
    nearest = depth.reshape(-1)
    mean_colors(_xyz(points), points.rgbx, pose.R_cam_from_world, pose.center_world, width, nearest, sums)
    rgb = (sums[:, :3] / np.maximum(sums[:, 3:], 1.0) / 255.0).astype(np.float32)
    return View(depth, rgb.reshape(width // 2, width, 3))


def indices_in_front(points: PackedPoints, center_world: Array, depth: Array32) -> Int64s:
    """Return the indices of the points not behind ranges `depth` (H, W) [m], seen from a centre (3,) [m].

    `depth` has the world's axes. A point may be farther by VISIBLE_FACTOR and VISIBLE_OFFSET.
    """
    indices = np.empty(len(points), np.int64)
    count = select_visible(_xyz(points), np.eye(3), center_world, depth.shape[1], depth.reshape(-1), indices)
    return indices[:count]


def visible_points(points: PackedPoints, center_world: Array) -> PackedPoints:
    """Return the points that are visible from `center_world` (3,) [m], in all directions."""
    depth = nearest_depth(points, Pose(np.eye(3), center_world), VISIBLE_WIDTH)
    return points.take(indices_in_front(points, center_world, depth))


def is_free_space(points: PackedPoints, center: Array, width: int, min_clearance: float) -> bool:
    """Return True if no point is within `min_clearance` [m] of `center` (3,), and points are seen all around.

    Both follow from the nearest range in each cell of an equirectangular view `width` cells wide.
    """
    depth = nearest_depth(points, Pose(np.eye(3), center), width)
    seen = np.isfinite(depth).sum(axis=1) @ solid_angles(width) / (4.0 * math.pi)
    return bool(depth.min() > min_clearance and seen > MIN_SEEN_FRACTION)
