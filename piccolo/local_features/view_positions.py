"""From where the scan's features are taken: few positions that see all that a camera can see."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from ..geometry.sphere import cell_of, direction_to_pixel, pixel_rays
from ..kernels.jit import kernel

SPACING, LAYER = 2.5, 2.4  # [m] across and in height: what is nearer and seen from a position needs none
MAX_VIEWS, WIDER = 2500, 1.5  # at most, some minutes and 0.4 GB; the growth of the spacing for more
ABOVE_LOWEST, HEIGHT_STEP = 1.0, 0.3  # [m] first are positions so high above the lowest around, by steps
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
        i, is_covered = order[place], False
        for k in range(len(kept)):
            j = kept[k]
            dx, dy = centers[i, 0] - centers[j, 0], centers[i, 1] - centers[j, 1]
            dz = centers[i, 2] - centers[j, 2]
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
    order, known = order[order >= num_known], np.arange(num_known)
    look, spacing = lru_cache(maxsize=None)(look), SPACING
    while (kept := chosen(order, centers, known, look, cell_table(num_rings), spacing)) is None:
        spacing *= WIDER
    return kept


def chosen(
    order: NDArray[np.int64],
    centers: Array,
    known: NDArray[np.int64],
    look: Look,
    cells: NDArray[np.int32],
    spacing: float,
) -> NDArray[np.int64] | None:
    """Of some positions, in order, each that none of those known or chosen before sees; None if too many."""
    room = len(known) + MAX_VIEWS
    kept, ranges = np.empty(room, np.int64), np.empty((room, cells.max() + 1), np.float32)
    count, place = len(known), 0
    kept[:count] = known
    for k in known:
        ranges[k] = look(int(k))
    while (place := next_unseen(order, place, centers, kept[:count], ranges, cells, spacing)) < len(order):
        if count == room:
            return None
        kept[count], ranges[count] = order[place], look(int(order[place]))
        count += 1
    return kept[len(known) : count]
