"""Points averaged voxel by voxel as they stream by: the memory grows with the scene, not with the points.

All sums are integers: neither the order of the points nor how they are cut into chunks changes a bit, unless
more than MAX_COUNT lie in one voxel.
"""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..jobs.memory import check_memory
from ..kernels.jit import inline_kernel, kernel
from .voxels import (
    AT_ONCE,
    COARSEST,
    LEAF_SIZE,
    PHASE,
    QUANTA_PER_METRE,
    QUANTUM_BITS,
    QUANTUM_MASK,
    THIN,
    WINDOW,
    Voxels,
    morton_codes,
)

MAX_COUNT = 1 << 23  # points of a voxel that are summed, at most: int32 holds no more of their colours
MAX_CELL = 1 << 31  # cells from the first point to any other, below this: 43,000 km

# columns of a voxel's row: cell, number of points, sums of quanta, sums of colours
CELL, COUNT, POSITION, COLOR, NUM_COLUMNS = 0, 3, 4, 7, 10
FIRST_ROWS, MORE_ROWS = 1 << 15, 8  # an eighth more at a time
MAX_VOXELS = 80_000_000  # 20,000 m^2 or more
MAX_LOAD = 0.6  # share of the index in use
ROW_BYTES, SLOT_BYTES = 4 * NUM_COLUMNS, 4
SORTED_BYTES = 3 * 8 + 6 * 4  # a voxel: codes, order, codes in order, nodes


@inline_kernel
def first_slot(x, y, z, num_slots):
    """The slot of an index (2^k,) from which a cell is looked for."""
    # Teschner et al., VMV 2003. Products of less than 63 bits: none overflows, with or without Numba.
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return (mixed ^ (mixed >> 17)) & (num_slots - 1)


@inline_kernel
def find_slot(index, rows, x, y, z):
    """The slot that names a cell's row, or the free one where it belongs."""
    slot = first_slot(x, y, z, len(index))
    while index[slot] != 0:
        row = rows[index[slot] - 1]
        if row[CELL] == x and row[CELL + 1] == y and row[CELL + 2] == z:
            break
        slot = (slot + 1) & (len(index) - 1)
    return slot


@kernel
def add_points(points, colors, base, index, rows, num_voxels):
    """Add points (N, 3) [m] with colours (N, 3) to the rows (n, 10) of `num_voxels` voxels.

    `index` (2^k,) has, by a hash of their cells, their rows' numbers and 1, and 0 in free slots. Stops at a
    point farther than the cells reach, or when no row is left. Returns how many points were added and how
    many voxels there are.
    """
    for i in range(len(points)):
        if num_voxels == len(rows):
            return i, num_voxels
        qx = np.int64(np.floor(points[i, 0] * QUANTA_PER_METRE)) + PHASE
        qy = np.int64(np.floor(points[i, 1] * QUANTA_PER_METRE)) + PHASE
        qz = np.int64(np.floor(points[i, 2] * QUANTA_PER_METRE)) + PHASE
        x = (qx >> QUANTUM_BITS) - base[0]
        y = (qy >> QUANTUM_BITS) - base[1]
        z = (qz >> QUANTUM_BITS) - base[2]
        if max(abs(x), abs(y), abs(z)) >= MAX_CELL:
            return i, num_voxels
        slot = find_slot(index, rows, x, y, z)
        if index[slot] == 0:
            row = rows[num_voxels]
            row[:] = 0
            row[CELL], row[CELL + 1], row[CELL + 2] = x, y, z
            num_voxels += 1
            index[slot] = num_voxels
        row = rows[index[slot] - 1]
        if row[COUNT] < MAX_COUNT:
            row[COUNT] += 1
            row[POSITION] += qx & QUANTUM_MASK
            row[POSITION + 1] += qy & QUANTUM_MASK
            row[POSITION + 2] += qz & QUANTUM_MASK
            row[COLOR] += colors[i, 0]
            row[COLOR + 1] += colors[i, 1]
            row[COLOR + 2] += colors[i, 2]
    return len(points), num_voxels


@kernel
def fill_index(rows, num_voxels, index):
    """Name the rows (n, 10) of `num_voxels` voxels in an index (2^k,) of zeros."""
    for k in range(num_voxels):
        x, y, z = np.int64(rows[k, CELL]), np.int64(rows[k, CELL + 1]), np.int64(rows[k, CELL + 2])
        index[find_slot(index, rows, x, y, z)] = k + 1


class VoxelTable:
    """Sums over the points in each voxel: rows in the order of the first points, and an open hash index."""

    def __init__(self, label: str) -> None:
        self.label = label  # of the cloud, for messages
        self.num_voxels = 0
        self.base = np.zeros(3, np.int64)  # cell of the first point
        self.rows = np.empty((FIRST_ROWS, NUM_COLUMNS), np.int32)
        self.index = np.zeros(2 * FIRST_ROWS, np.int32)

    def add(self, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> None:
        """Add finite points (N, 3) [m], in the map's axes, with colours (N, 3)."""
        points, colors = np.ascontiguousarray(points), np.ascontiguousarray(colors)  # one kernel for all
        if self.num_voxels == 0 and len(points):
            self.base = np.floor(points[0] / LEAF_SIZE).astype(np.int64)
        while len(points):
            full = min(len(self.rows), int(MAX_LOAD * len(self.index)), MAX_VOXELS)
            added = add_points(points, colors, self.base, self.index, self.rows[:full], self.num_voxels)
            num_added, self.num_voxels = added
            points, colors = points[num_added:], colors[num_added:]
            if len(points) and self.num_voxels < full:
                far = f"points more than {MAX_CELL * LEAF_SIZE / 1000:.0f} km apart, wanted one scene"
                raise InputError(f"{self.label}: {far}; remove broken points or set --units")
            if len(points):
                self._grow()

    def _grow(self) -> None:
        if self.num_voxels >= MAX_VOXELS:
            found = f"more than {self.num_voxels} voxels of {LEAF_SIZE} m are filled"
            raise InputError(f"{self.label}: {found}; if its unit is not the metre, set --units")
        if self.num_voxels == len(self.rows):
            num_more = max(FIRST_ROWS, len(self.rows) // MORE_ROWS)
            self._check_memory(num_more * ROW_BYTES)
            # Where pages can be mapped elsewhere (Linux), nothing is copied; elsewhere all is, for a moment.
            self.rows.resize((len(self.rows) + num_more, NUM_COLUMNS), refcheck=False)
        if self.num_voxels >= int(MAX_LOAD * len(self.index)):
            num_slots = 2 * len(self.index)
            self._check_memory(num_slots * SLOT_BYTES)
            self.index = np.zeros(0, np.int32)  # its room is needed
            self.index = np.zeros(num_slots, np.int32)
            fill_index(self.rows, self.num_voxels, self.index)

    def _check_memory(self, num_bytes: int) -> None:
        check_memory(num_bytes, f"{self.label}: a table of more than {self.num_voxels} voxels of 2 cm", THIN)

    def finish(self) -> Voxels:
        """The means; those too far from the rest for a Morton code are left out. The table is spent."""
        num, self.index = self.num_voxels, np.zeros(0, np.int32)
        check_memory(num * SORTED_BYTES, f"{self.label}: sorting {num} voxels of 2 cm", THIN)
        rows, self.rows = self.rows[:num], np.empty((0, NUM_COLUMNS), np.int32)
        rows, warnings = self._without_far(rows)
        cells = [rows[:, k] for k in range(COUNT)]
        low = np.array([column.min() for column in cells]) + self.base
        high = np.array([column.max() for column in cells]) + self.base + 1
        parts = [slice(begin, begin + AT_ONCE) for begin in range(0, len(rows), AT_ONCE)]
        codes = np.empty(len(rows), np.int64)
        for part in parts:
            codes[part] = morton_codes(rows[part, :COUNT] + (self.base - low // COARSEST * COARSEST))
        order = np.argsort(codes)
        # + 0.0 turns -0.0 into 0.0
        origin = np.round(0.5 * LEAF_SIZE * (low + high) - PHASE / QUANTA_PER_METRE) + 0.0
        nodes = np.empty((len(rows), 6), np.float32)
        for part in parts:
            taken = rows[order[part]]
            counts = taken[:, COUNT].astype(np.float64)
            for k in range(3):
                corners = (taken[:, CELL + k] + self.base[k]) * LEAF_SIZE - origin[k]
                sums = taken[:, POSITION + k]
                nodes[part, k] = corners + (sums / counts + 0.5 - PHASE) / QUANTA_PER_METRE
                nodes[part, 3 + k] = taken[:, COLOR + k] / counts / 255.0
        return Voxels(codes[order], nodes, origin, warnings)

    def _without_far(self, rows: NDArray[np.int32]) -> tuple[NDArray[np.int32], tuple[str, ...]]:
        """The rows of voxels near to the rest, and a line if others were left out."""
        is_near = np.ones(len(rows), dtype=np.bool_)
        for column in rows[:, :COUNT].T:
            middle = int(np.partition(column, len(column) // 2)[len(column) // 2])
            if int(column.min()) < middle - WINDOW or int(column.max()) > middle + WINDOW:
                is_near &= np.abs(column.astype(np.int64) - middle) <= WINDOW
        if is_near.all():
            return rows, ()
        num_far = int(rows[~is_near, COUNT].sum(dtype=np.int64))
        text = f"{num_far} points farther than {WINDOW * LEAF_SIZE / 1000:.0f} km from the middle"
        if not is_near.any():
            raise InputError(f"{self.label}: {text}, and none nearer, wanted one scene")
        return rows[is_near], (f"{self.label}: {text} left out",)
