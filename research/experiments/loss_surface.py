"""The least sampling loss over height and rotation, for each place of a plan.

Kim et al. (ICCV 2021) show such a surface to argue that their loss has a deep, wide minimum at the camera:

    S(x, y) = min over z in heights, R in rotations of L(R, (x, y, z)),    L the sampling loss, Eq. 2,

with L over the points that a camera at (x, y, z) sees, and the same rotations at each place.
"""

import math
from io import BytesIO
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from piccolo.cloud.soa import LocalCloud, PackedPoints
from piccolo.geometry.pose import Array, Pose
from piccolo.jobs.threads import Workers
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.optional import new_figure
from piccolo.panorama.texels import Texels
from piccolo.views.zbuffer import is_free_space, visible_points

POOL_PER_POINT = 8  # points of which visible ones are taken, for one that is used
FREE_SPACE_WIDTH = 32  # [px] of the view that tests for free space
MIN_CLEARANCE = 0.2  # [m] to the nearest point
WALL_POINTS = 200_000  # of the cloud that are drawn
MARKS = {"true": ("*", "white", 260), "found": ("X", "red", 110), "lowest": ("o", "none", 130)}

KnownPoses = dict[str, Pose]  # those known of "true" and "found", in the frame of the points


class PoseGrid(NamedTuple):
    """All poses that are tried, in the frame of the points, z up."""

    x: Array  # (nx,) [m]
    y: Array  # (ny,) [m]
    heights: Array  # (nz,) [m]
    R_cam_from_local: NDArray[np.float64]  # (rotations, 3, 3)

    @property
    def num_poses(self) -> int:
        """Number of poses."""
        return len(self.x) * len(self.y) * len(self.heights) * len(self.R_cam_from_local)


class LossSurface(NamedTuple):
    """The best pose at each place of the plan."""

    loss: Array  # (ny, nx) [0, sqrt(3)], inf where masked pixels hide too much at every pose
    height: Array  # (ny, nx) [m] of the best pose
    rotation: NDArray[np.int64]  # (ny, nx) index of its rotation
    is_free: NDArray[np.bool_]  # (ny, nx) false too near to a point, or outside of the cloud

    def lowest(self) -> tuple[int, int]:
        """Return row and column of the least loss in free space; of all places if none is free.

        From outside a cloud few points are visible, and a plain wall has a low loss in a plain panorama.
        """
        is_free = self.is_free & np.isfinite(self.loss)
        loss = np.where(is_free, self.loss, np.inf) if is_free.any() else self.loss
        row, column = np.unravel_index(int(np.argmin(loss)), loss.shape)
        return int(row), int(column)

    def num_minima(self) -> int:
        """Count the places in free space whose loss is lower than at their eight neighbours."""
        others = np.arange(9).reshape(3, 3) != 4
        lowest_around = minimum_filter(self.loss, footprint=others, mode="constant", cval=np.inf)
        return int(((self.loss < lowest_around) & self.is_free).sum())


def loss_surface(
    points: PackedPoints, texels: Texels, grid: PoseGrid, max_points: int, workers: Workers
) -> LossSurface:
    """Find the least loss over heights and rotations at each place, over `max_points` visible from it."""
    pool = points.subsample(POOL_PER_POINT * max_points)

    def best(cell: int) -> tuple[float, float, int, bool]:
        row, column = divmod(cell, len(grid.x))
        tried = []
        for z in grid.heights:
            center = np.array([grid.x[column], grid.y[row], z])
            seen = visible_points(pool, center)
            is_free = is_free_space(seen, center, FREE_SPACE_WIDTH, MIN_CLEARANCE)
            some = seen.subsample(max_points)
            losses = [sampling_loss(some, texels, Pose(R, center)) for R in grid.R_cam_from_local]
            k = int(np.argmin(losses))
            tried.append((losses[k], float(z), k, is_free))
        return min(tried)

    shape = (len(grid.y), len(grid.x))
    cells = workers.map(best, range(math.prod(shape)), "loss surface")
    loss, height, rotation, is_free = (np.array(column).reshape(shape) for column in zip(*cells, strict=True))
    return LossSurface(loss=loss, height=height, rotation=rotation, is_free=is_free)


def plan_shift(cloud: LocalCloud) -> Array:
    """Return the offset (3,) [m] from the frame of the points to the plan's, which has the world's origin."""
    return np.asarray(cloud.R_local_from_world @ cloud.origin_world)


def surface_png(
    surface: LossSurface, grid: PoseGrid, cloud: LocalCloud, known: KnownPoses, title: str
) -> bytes:
    """Draw the surface over the plan, with the known poses marked, and return the PNG."""
    shift = plan_shift(cloud)
    x = grid.x + shift[0]
    y = grid.y + shift[1]
    aspect = (y[-1] - y[0] + 1.0) / (x[-1] - x[0] + 1.0)
    figure = new_figure(figsize=(10.0, float(np.clip(8.5 * aspect + 1.0, 4.0, 16.0))), layout="constrained")
    axes = figure.add_subplot()
    loss = np.where(np.isfinite(surface.loss), surface.loss, np.nan)
    mesh = axes.pcolormesh(x, y, loss, cmap="viridis", shading="nearest")
    pale = np.zeros((*surface.is_free.shape, 4))
    pale[~surface.is_free] = (1.0, 1.0, 1.0, 0.55)
    axes.pcolormesh(x, y, pale, shading="nearest")
    p = cloud.points.subsample(WALL_POINTS)
    floor, ceiling = np.percentile(p.z, [1.0, 99.0])
    is_wall = np.abs(p.z - (floor + ceiling) / 2) < 0.35 * (ceiling - floor)  # walls and furniture
    axes.plot(p.x[is_wall] + shift[0], p.y[is_wall] + shift[1], "k,", alpha=0.3, zorder=2)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    row, column = surface.lowest()
    marks = {"lowest": (x[column], y[row])}
    for name in ("found", "true"):
        if name in known:
            x_known, y_known = known[name].center_world[:2] + shift[:2]
            marks[name] = (x_known, y_known)
    for name, (x_mark, y_mark) in marks.items():
        symbol, color, size = MARKS[name]
        edge = "red" if color == "none" else "black"
        axes.scatter(
            x_mark, y_mark, s=size, marker=symbol, facecolor=color, edgecolor=edge, zorder=3, label=name
        )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=title)
    axes.legend(loc="upper right")
    figure.colorbar(mesh, ax=axes, label="least sampling loss over height and rotation", shrink=0.8)
    file = BytesIO()
    figure.savefig(file, format="png", dpi=120)
    return file.getvalue()
