"""Step 1 of the paper's Algorithm 1: camera positions on a grid, in free space."""

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array
from ..render.free_space import is_free_space

MIN_CLEARANCE = 0.25  # a camera is not nearer to a surface than this [m]
PROBE_POINTS = 200_000  # about this many points are asked, evenly in space
PROBE_WIDTH = 48  # cells of 7.5 degrees for the two tests


def box_grid(low: Array, high: Array, num_cells: int) -> NDArray[np.float64]:
    """Centres (M, 3) of near-cubic cells that fill a box, M near `num_cells`, at least one an axis."""
    size = np.maximum(high - low, 1e-3)
    edge = (size.prod() / num_cells) ** (1.0 / 3.0)
    for _ in range(3):  # an axis shorter than the edge gets one cell: the others share the number
        is_long = size > edge
        if is_long.any():
            edge = (size[is_long].prod() / num_cells) ** (1.0 / is_long.sum())
    counts = np.maximum(np.round(size / edge), 1).astype(int)
    axes = [low[k] + size[k] * (np.arange(counts[k]) + 0.5) / counts[k] for k in range(3)]
    return np.column_stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


def farthest_point_sampling(positions: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """At most `count` of the positions (N, 3), each the farthest from those before it, in their old order."""
    if len(positions) <= count:
        return positions
    chosen = [0]
    distance = np.linalg.norm(positions - positions[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return np.asarray(positions[np.sort(chosen)])


def free_grid(points: PackedPoints, num_translations: int, margin: float) -> NDArray[np.float64]:
    """Camera positions (M, 3), M <= num_translations, of a uniform grid over the box that lie in free space.

    The box is that of the points, made smaller by `margin` of its size on every side. The grid is refined
    until enough of its positions are free; what is over is thinned out evenly. Empty if nothing is free.
    """
    low = np.array([points.x.min(), points.y.min(), points.z.min()], dtype=np.float64)
    high = np.array([points.x.max(), points.y.max(), points.z.max()], dtype=np.float64)
    low, high = low + margin * (high - low), high - margin * (high - low)
    probed = points.take(slice(None, None, max(1, len(points) // PROBE_POINTS)))
    free = np.empty((0, 3))
    for growth in (1.0, 1.5, 2.25, 3.4, 5.0, 7.6, 11.4, 17.0, 26.0):
        grid = box_grid(low, high, round(num_translations * growth))
        free = grid[[is_free_space(probed, center, PROBE_WIDTH, MIN_CLEARANCE) for center in grid]]
        if len(free) >= num_translations:
            break
    return farthest_point_sampling(free, num_translations)
