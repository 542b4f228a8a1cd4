"""The cloud seen from a pose: z-buffered views, which points the camera sees, whether it can stand there."""

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
DEPTH_CHUNK = 4096

# A point is visible if it is not farther than the nearest in its cell by this much. The factor lets grazing
# floors and walls through, whose ranges vary within a cell; the offset [m] covers range noise nearby. Of
# cells and pixels of all sizes but those of surfels, which close the surface themselves, and of the picture
# for keypoints, whose pixels are small: these have their own, with which their bits are known.
VISIBLE_FACTOR = np.float32(1.08)
VISIBLE_OFFSET = np.float32(0.1)
CELL_BAND = np.float32(1.0 + 0.15)  # a cell's colour is the mean of points up to this times its nearest range
MIN_VIEW_WIDTH = 32  # [px] of a rendered view
MAX_VIEW_WIDTH = 4096
VISIBLE_WIDTH = 180  # cells of 2 degrees
MIN_SEEN_FRACTION = 0.4  # of the sphere; less is seen from outside a scan


class View(NamedTuple):
    """A view of the cloud, on an equirectangular grid."""

    depth: Array32  # (H, W) range of what is nearest [m], inf where there is nothing
    rgb: NDArray[Any]  # (H, W, 3) mean colour of what is near that range, 0 where there is nothing

    @property
    def is_seen(self) -> Mask:
        """True where something was seen, (H, W)."""
        return np.isfinite(self.depth)


@kernel
def cells_and_ranges(
    points: Coordinates, begin: int, pose: Pose32, width: int, cells: Int32s, ranges: Array32
) -> int:
    """Write cell (row * width + column) and range [m] of a chunk of points; return its length.

    The chunk begins at `begin`. The arithmetic is vectorised, the scatter that follows can't be.
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
    """Add up (H * W, 4): R, G, B [8-bit levels] and count of the points within CELL_BAND of the nearest."""
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
    """Write the indices of the points that are visible, given `depth` (H * W,) [m]; return their number."""
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
    R, t = pose.R_cam_from_world, pose.center_world
    mean_colors(_xyz(points), points.rgbx, R, t, width, depth.reshape(-1), sums)
    rgb = (sums[:, :3] / np.maximum(sums[:, 3:], 1.0) / 255.0).astype(np.float32)
    return View(depth, rgb.reshape(width // 2, width, 3))


def indices_in_front(points: PackedPoints, center_world: Array, depth: Array32) -> Int64s:
    """Return the indices of the points that are not behind `depth` (H, W) [m], seen from a place (3,) [m].

    The camera's axes are the world's. A point may be farther by VISIBLE_FACTOR and VISIBLE_OFFSET.
    """
    indices = np.empty(len(points), np.int64)
    count = select_visible(_xyz(points), np.eye(3), center_world, depth.shape[1], depth.reshape(-1), indices)
    return indices[:count]


def visible_points(points: PackedPoints, center_world: Array) -> PackedPoints:
    """Return the points that are visible from `center_world` (3,) [m], whichever way the camera is turned."""
    depth = nearest_depth(points, Pose(np.eye(3), center_world), VISIBLE_WIDTH)
    return points.take(indices_in_front(points, center_world, depth))


def is_free_space(points: PackedPoints, center: Array, width: int, min_clearance: float) -> bool:
    """Return True if no point is within `min_clearance` [m] of `center` (3,), and points are seen all around.

    Both follow from the nearest range in each cell of an equirectangular view `width` cells wide.
    """
    depth = nearest_depth(points, Pose(np.eye(3), center), width)
    seen = np.isfinite(depth).sum(axis=1) @ solid_angles(width) / (4.0 * math.pi)
    return bool(depth.min() > min_clearance and seen > MIN_SEEN_FRACTION)
