"""From where the scan's features are taken: few positions that see all that a camera can see."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from ..geometry.sphere import cell_of, direction_to_pixel, pixel_rays
from ..geometry.vectors import minus, row
from ..kernels.jit import kernel

SPACING = 2.5  # [m] across: what is nearer and seen from a position needs none
LAYER = 2.4  # [m] in height
MAX_VIEWS = 2500  # some minutes and 0.4 GB
WIDER = 1.5  # growth of the spacing where there would be more
ABOVE_LOWEST = 1.0  # [m] first are positions so high above the lowest around
HEIGHT_STEP = 0.3  # [m]
Look = Callable[[int], NDArray[np.float32]]  # ranges (cells,) [m] seen from a candidate, 0 for nothing
CELL = np.array([2.5, 2.5, 3.0])  # [m] around: a part of a storey
TABLE_HEIGHT = 48  # directions, by 3.75 degrees
SLACK = 1.0  # [m] a wall is so much nearer than what is behind it


@kernel
def next_unseen(order, begin, centers, kept, ranges, cells, spacing):
    """The first place from `begin` in an order of positions that none of those kept (k,) sees nearby.

    Ranges (k, cells) [m] are those of the view from each, 0 where nothing is seen; `cells` is a table
    (h, 2 h) of the cell in each direction.
    """
    height, width = cells.shape
    for place in range(begin, len(order)):
        is_covered = False
        for k in range(len(kept)):
            dx, dy, dz = minus(row(centers, order[place]), row(centers, kept[k]))
            across = dx * dx + dy * dy
            if across >= spacing * spacing or abs(dz) >= LAYER:
                continue
            u, v = direction_to_pixel(dx, dy, dz, np.sqrt(across), width)
            limit = ranges[k, cells[min(int(v), height - 1), min(int(u), width - 1)]]
            if limit == 0.0 or np.sqrt(across + dz * dz) < limit + SLACK:
                is_covered = True
                break
        if not is_covered:
            return place
    return len(order)


def cell_table(num_rings: int) -> NDArray[np.int32]:
    """The cell (h, 2 h) of a grid in each direction, by the pixels of a sphere."""
    rays = pixel_rays(2 * TABLE_HEIGHT).astype(np.float32)
    return cell_of(rays.reshape(-1, 3), num_rings).reshape(rays.shape[:2])


def view_positions(centers: Array, look: Look, num_rings: int, num_known: int = 0) -> NDArray[np.int64]:
    """Indices of the candidates (N, 3) [m] from which features are taken, beside the first, already known.

    At most MAX_VIEWS. A look from a candidate tells ranges on the cells of `num_rings`.
    """
    if len(centers) == 0:
        return np.empty(0, np.int64)
    _, group = np.unique(np.floor(centers / CELL), axis=0, return_inverse=True)
    lowest = np.full(group.max() + 1, np.inf)
    np.minimum.at(lowest, group.ravel(), centers[:, 2])
    off = np.abs(centers[:, 2] - lowest[group.ravel()] - ABOVE_LOWEST)
    order = np.argsort(np.rint(off / HEIGHT_STEP), kind="stable")
    order = order[order >= num_known]
    look = lru_cache(maxsize=None)(look)
    cells, spacing = cell_table(num_rings), SPACING
    while (kept := choose(order, centers, num_known, look, cells, spacing)) is None:
        spacing *= WIDER
    return kept


def choose(
    order: NDArray[np.int64],
    centers: Array,
    num_known: int,
    look: Look,
    cells: NDArray[np.int32],
    spacing: float,
) -> NDArray[np.int64] | None:
    """Choose of some positions, in order, each that none known or before it sees; None if too many."""
    room = num_known + MAX_VIEWS
    kept = np.arange(room)
    ranges = np.empty((room, cells.max() + 1), np.float32)
    count = num_known
    for k in range(num_known):
        ranges[k] = look(k)
    place = 0
    while (place := next_unseen(order, place, centers, kept[:count], ranges, cells, spacing)) < len(order):
        if count == room:
            return None
        kept[count] = order[place]
        ranges[count] = look(int(order[place]))
        count += 1
    return kept[num_known:count]
