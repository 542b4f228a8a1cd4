"""The least sampling loss over height and rotation, for each place of a plan.

Kim et al. (ICCV 2021) show such a surface to argue that their loss has a deep, wide minimum at the camera:

    S(x, y) = min over z in heights, R in rotations of L(R, (x, y, z)),    L the sampling loss, Eq. 2,

with L over the points that a camera at (x, y, z) sees. Rotations are the same at each place.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose
from ..geometry.sphere import solid_angles
from ..panorama.texels import Texels
from ..render.zbuffer import nearest_depth, visible_points
from ..runtime.threads import Workers
from .sampling_loss import sampling_loss

POOL_PER_POINT = 8  # points among which the visible ones are looked for, for one that is asked
CELLS_AROUND = 32  # of the view that tells free space
MIN_CLEARANCE = 0.2  # [m] to the nearest point
MIN_SEEN = 0.4  # share of the sphere on which there is anything


@dataclass(frozen=True)
class PoseGrid:
    """All poses that are tried, in the frame of the points, z up."""

    x: Array  # (nx,) [m]
    y: Array  # (ny,) [m]
    heights: Array  # (nz,) [m]
    R_cam_from_local: NDArray[np.float64]  # (rotations, 3, 3)

    @property
    def num_poses(self) -> int:
        """How many there are."""
        return len(self.x) * len(self.y) * len(self.heights) * len(self.R_cam_from_local)


@dataclass(frozen=True)
class LossSurface:
    """The best pose at each place of the plan."""

    loss: Array  # (ny, nx) [0, sqrt(3)], inf where masked pixels hide too much at every pose
    height: Array  # (ny, nx) [m] of the best pose
    rotation: NDArray[np.int64]  # (ny, nx) index of its rotation
    is_free: NDArray[np.bool_]  # (ny, nx) false too near to a point, or outside of the cloud

    def lowest(self) -> tuple[int, int]:
        """Row and column of the least loss in free space; anywhere if none is free.

        From outside a cloud few points are seen, and a plain wall before a plain picture has little loss.
        """
        is_free = self.is_free & np.isfinite(self.loss)
        loss = np.where(is_free, self.loss, np.inf) if is_free.any() else self.loss
        row, column = np.unravel_index(int(np.argmin(loss)), loss.shape)
        return int(row), int(column)

    def num_minima(self) -> int:
        """Places in free space that are lower than their eight neighbours."""
        loss = np.where(np.isfinite(self.loss), self.loss, np.inf)
        others = np.ones((3, 3), np.bool_)
        others[1, 1] = False
        lowest_around = minimum_filter(loss, footprint=others, mode="constant", cval=np.inf)
        return int(((loss < lowest_around) & self.is_free).sum())


def loss_surface(
    points: PackedPoints,
    texels: Texels,
    grid: PoseGrid,
    max_points: int,
    use_visibility: bool,
    workers: Workers,
) -> LossSurface:
    """The least loss over heights and rotations at each place, from at most `max_points` a position."""
    pool = _thinned(points, POOL_PER_POINT * max_points if use_visibility else max_points)

    def best(cell: int) -> tuple[float, float, int, bool]:
        row, column = divmod(cell, len(grid.x))
        tried = []
        for z in grid.heights:
            center = np.array([grid.x[column], grid.y[row], z])
            seen = visible_points(pool, center) if use_visibility else pool
            is_free = _is_free(seen, center)
            some = _thinned(seen, max_points)
            losses = [sampling_loss(some, texels, Pose(R, center)) for R in grid.R_cam_from_local]
            k = int(np.argmin(losses))
            tried.append((losses[k], float(z), k, is_free))
        return min(tried)

    num_cells = len(grid.x) * len(grid.y)
    cells = list(workers.each(best, range(num_cells), "loss surface"))
    loss, height, rotation, is_free = (np.array(column) for column in zip(*cells, strict=True))
    shape = (len(grid.y), len(grid.x))
    return LossSurface(
        loss.reshape(shape), height.reshape(shape), rotation.reshape(shape), is_free.reshape(shape)
    )


def _thinned(points: PackedPoints, count: int) -> PackedPoints:
    """At most `count` points, evenly in space as they are in Morton order."""
    if len(points) <= count:
        return points
    return points.take(np.linspace(0, len(points) - 1, count).astype(np.int64))


def _is_free(points: PackedPoints, center: Array) -> bool:
    """True if a camera could be there: nothing too near, and something seen in many directions."""
    depth = nearest_depth(points, Pose(np.eye(3), center), CELLS_AROUND).reshape(-1, CELLS_AROUND)
    seen = float(solid_angles(CELLS_AROUND) @ np.isfinite(depth).sum(axis=1)) / (4.0 * math.pi)
    return bool(depth.min() > MIN_CLEARANCE and seen > MIN_SEEN)
