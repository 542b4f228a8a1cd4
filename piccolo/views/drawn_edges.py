"""Edges of a scan without colours as seen from a position: outlines of nearer surfaces, and creases.

Along a plane the inverse range is nearly linear in the angle; where it bends, a photo shows an edge. Outlines
depend on the position, so they can't be painted on the scan as `cloud.surfaces` paints creases and borders.
"""

import math
from functools import lru_cache

import numpy as np

from ..cloud.surfaces import rise
from ..geometry.colors import colors_of_edges
from ..geometry.sphere import cells_around, make_grid
from ..photo.panorama.edges import COS_UPRIGHT_EDGE
from ..system.arrays import Array32, Floats, Int32s

# bend, relative to the inverse range, of an edge of strength 1; of less, the strength is the root
FULL_BEND = 0.07
FAR_BELOW = -1e12  # inverse range of empty cells: a value interpolated with it is negative


@lru_cache(maxsize=1)
def find_sides(num_rings: int) -> tuple[Int32s, Array32]:
    """Return the cells and weights (4 N, 4) that interpolate at the four neighbours of each of N cells.

    A neighbour is a cell away. The first N rows are all neighbours to the left; then those to the right,
    above and below.
    """
    grid = make_grid(num_rings)
    x, y, z = grid.directions.astype(np.float64).T
    turn = math.tau / np.repeat(grid.num_columns, grid.num_columns)
    azimuth = np.arctan2(y, x) + np.outer([1, -1, 0, 0], turn)
    elevation = np.arcsin(z) + np.outer([0, 0, 1, -1], np.full(len(z), math.pi / num_rings))
    level = np.cos(elevation)  # negative across a pole
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    cells, weights = cells_around(rays.reshape(-1, 3), num_rings)
    return cells, np.round(weights, 4)  # weights that are rounding errors become 0


def replace_by_edges(sums: Array32, num_rings: int) -> None:
    """Replace the colours in the sums (N, 8) of a view, as `average_nodes` writes them, by edges and grey."""
    cells, weights = find_sides(num_rings)

    def interpolate(values: Floats) -> Floats:
        return np.asarray((values[cells] * weights).sum(axis=1).reshape(4, -1))

    counts = np.maximum(sums[:, 6], 1.0)
    inverse = np.where(
        sums[:, 6] > 0.0, counts / np.maximum(np.linalg.norm(sums[:, :3], axis=1), 1e-9), FAR_BELOW
    )
    sides = interpolate(inverse).reshape(2, 2, -1)
    bend = sides.sum(axis=1) - 2.0 * inverse
    nearest = np.where(bend < 0.0, inverse, sides.max(axis=1))
    is_whole = np.minimum(sides.min(axis=1), inverse) > 0.0
    part = np.where(is_whole, np.abs(bend) / np.where(is_whole, nearest, 1.0), 0.0) / FULL_BEND
    across, down = np.sqrt(np.minimum(part, 1.0))
    strength = np.maximum(across, down)
    vertical = strength * rise(across / np.maximum(np.hypot(across, down), 1e-9), COS_UPRIGHT_EDGE)
    strength, vertical = ((2.0 * e + interpolate(e).sum(axis=0)) / 6.0 for e in (strength, vertical))
    gray = 2.0 * (sums[:, 3:6].mean(axis=1) / counts) - 0.5
    sums[:, 3:6] = sums[:, 6:7] * (colors_of_edges(strength, vertical, gray) / np.float32(255.0))
