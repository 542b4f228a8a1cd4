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
from ..panorama.texels import Texels
from ..render.free_space import is_free_space
from ..render.zbuffer import visible_points
from ..runtime.threads import Workers
from .sampling_loss import sampling_loss

POOL_PER_POINT = 8  # points that may be visible, for one that is used
FREE_SPACE_WIDTH = 32  # [px] of the view that tests for free space
MIN_CLEARANCE = 0.2  # [m] to the nearest point


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

        From outside a cloud few points are seen, and a plain wall has little loss in a plain panorama.
        """
        is_free = self.is_free & np.isfinite(self.loss)
        loss = np.where(is_free, self.loss, np.inf) if is_free.any() else self.loss
        row, column = np.unravel_index(int(np.argmin(loss)), loss.shape)
        return int(row), int(column)

    def num_minima(self) -> int:
        """Places in free space that are lower than their eight neighbours."""
        others = np.arange(9).reshape(3, 3) != 4
        lowest_around = minimum_filter(self.loss, footprint=others, mode="constant", cval=np.inf)
        return int(((self.loss < lowest_around) & self.is_free).sum())


def loss_surface(
    points: PackedPoints,
    texels: Texels,
    grid: PoseGrid,
    max_points: int,
    use_visibility: bool,
    workers: Workers,
) -> LossSurface:
    """The least loss over heights and rotations at each place, from at most `max_points` a position."""
    pool = points.subsample(POOL_PER_POINT * max_points if use_visibility else max_points)

    def best(cell: int) -> tuple[float, float, int, bool]:
        row, column = divmod(cell, len(grid.x))
        tried = []
        for z in grid.heights:
            center = np.array([grid.x[column], grid.y[row], z])
            seen = visible_points(pool, center) if use_visibility else pool
            is_free = is_free_space(seen, center, FREE_SPACE_WIDTH, MIN_CLEARANCE)
            some = seen.subsample(max_points)
            losses = [sampling_loss(some, texels, Pose(R, center)) for R in grid.R_cam_from_local]
            k = int(np.argmin(losses))
            tried.append((losses[k], float(z), k, is_free))
        return min(tried)

    shape = (len(grid.y), len(grid.x))
    cells = workers.map(best, range(math.prod(shape)), "loss surface")
    return LossSurface(*(np.array(column).reshape(shape) for column in zip(*cells, strict=True)))
