"""Voxels in Morton order, on a grid that is fixed in the map's axes, averaged while the points are read.

Memory grows with the size of the scene, not with the number of points. All sums are of integers: the order of
the points and of the chunks does not change a bit, unless more than MAX_COUNT points are in one voxel.
"""

from typing import NamedTuple

import numpy as np

from ..system.arrays import Array, Array32, Bytes, Int32s, Int64s
from ..system.errors import InputError
from ..system.jobs.memory import check_memory
from ..system.kernels.jit import inline_kernel, kernel

NUM_CELLS = 1 << 21  # along an axis; three axes fill 63 bits
LEAF_SIZE = 0.02  # [m] width of a voxel
QUANTUM_BITS = 8  # a voxel is 256 quanta wide: positions are summed in steps of 78 um
QUANTUM_MASK = (1 << QUANTUM_BITS) - 1
QUANTA_PER_METRE = (1 << QUANTUM_BITS) / LEAF_SIZE
WINDOW = (NUM_CELLS // 2) - 128  # cells from the median along an axis, 21 km: voxels farther away are dropped
COARSEST = 128  # leaves along a voxel of the coarsest level
# [quanta] from a corner that the grids of all levels share to zero: a third of the coarsest voxel, so that
# zero and whole metres lie on no voxel's border. Noise would put a floor on a border into two layers.
PHASE = (COARSEST << QUANTUM_BITS) // 3 + 1

JOINING_BYTES = 160  # for each voxel of two clouds that are joined: nodes, cells, codes, order, sums
VOXELS_AT_ONCE = 1 << 18  # voxels that are processed at once, so that temporary arrays stay small
THIN = "set `units` if its unit is not the metre, or cut out a part"
NUM_LEVELS = COARSEST.bit_length()  # from 128 leaves wide (2.56 m) down to one


MAX_COUNT = 1 << 23  # points of a voxel that are summed, at most: int32 can't hold the colours of more
MAX_CELL = 1 << 31  # limit of the cells from the first point to any other: 43,000 km

# first columns, in a voxel's row, of: cell (3), number of points, sums of quanta (3), sums of colours (3)
CELL_COLUMN = 0
COUNT_COLUMN = 3
POSITION = 4
COLOR = 7
NUM_COLUMNS = 10
FIRST_ROWS = 1 << 15  # rows of a new table
MORE_ROWS = 8  # a full table grows by the fraction 1 / MORE_ROWS
MAX_VOXELS = 80_000_000  # enough for 20,000 m^2
MAX_LOAD = 0.4  # of the index in use, at most
TOGETHER = 256  # points whose rows are looked up together: memory answers many requests at a time
ROW_BYTES = 4 * NUM_COLUMNS
SLOT_BYTES = 4
SORTED_BYTES = 3 * 8 + 6 * 4  # for each voxel: code, order, code in order, node


@inline_kernel
def spread_bits(cell: np.int64) -> np.int64:
    """Return the lowest 21 bits of an int64, moved apart so that two zeros lie between neighbours."""
    bits = cell & 0x1FFFFF
    bits = (bits | (bits << 32)) & 0x1F00000000FFFF
    bits = (bits | (bits << 16)) & 0x1F0000FF0000FF
    bits = (bits | (bits << 8)) & 0x100F00F00F00F00F
    bits = (bits | (bits << 4)) & 0x10C30C30C30C30C3
    return (bits | (bits << 2)) & 0x1249249249249249


@kernel
def interleave(cells: Int64s, codes: Int64s) -> None:
    """Write the 63-bit Morton code (N,) of each cell (N, 3), int64 in [0, 2^21); x has the lowest bit."""
    for i in range(len(cells)):
        x, y, z = spread_bits(cells[i, 0]), spread_bits(cells[i, 1]), spread_bits(cells[i, 2])
        codes[i] = x | (y << 1) | (z << 2)


def morton_codes(cells: Int64s) -> Int64s:
    """Return the Morton code (N,) of each cell (N, 3) in [0, 2^21)."""
    codes = np.empty(len(cells), dtype=np.int64)
    interleave(cells, codes)
    return codes


def morton_order(points: Array32, colors: Bytes) -> Int64s:
    """Return indices (N,) that sort points (N, 3) [m] and colours (N, 3) along Morton's curve.

    The cells are cubes, 2^21 along the longest side of the bounding box. Within a cell points are sorted by
    coordinates and then by colours, so only points that are equal in every bit keep the order of the input.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    # Rounded here, not in a kernel: fastmath may round the last points of an array differently.
    cells_per_metre = np.float32((NUM_CELLS - 1) / max(extent, 1e-6))
    cells = np.minimum(((points - low) * cells_per_metre).astype(np.int64), NUM_CELLS - 1)
    codes = morton_codes(cells)
    order = np.argsort(codes)
    ascending = codes[order]
    is_tied = np.zeros(len(order), dtype=np.bool_)
    is_tied[1:] = ascending[1:] == ascending[:-1]
    is_tied[:-1] |= is_tied[1:]
    places = np.flatnonzero(is_tied)
    if len(places):
        tied = order[places]
        # lexsort's last key counts first
        keys = [*colors[tied].T[::-1], *points[tied].T[::-1], ascending[places]]
        order[places] = tied[np.lexsort(keys)]
    return order


class Voxels(NamedTuple):
    """The voxels that contain points, in Morton order."""

    codes: Int64s  # (M,) Morton codes; their three lowest bits are the index among the parent's children
    nodes: Array32  # (M, 6) mean x, y, z [m] relative to `origin`, mean r, g, b in [0, 1]
    origin: Array  # (3,) [m] middle of their box in the map's axes, whole metres
    warnings: tuple[str, ...] = ()  # one line each, for the user


def join_voxels(first: Array32, second: Array32, origin: Array) -> Voxels:
    """Join the voxels of two clouds, given by nodes (N, 6) relative to the same origin (3,) [m].

    A voxel of only one cloud keeps its bits; a voxel of both gets the mean of the two nodes.
    """
    num = len(first) + len(second)
    check_memory(num * JOINING_BYTES, f"the scan: sorting {num} voxels of 2 cm", THIN)
    nodes = np.concatenate([first, second])
    cells = np.floor((nodes[:, :3] + (origin + PHASE / QUANTA_PER_METRE)) / LEAF_SIZE).astype(np.int64)
    codes = morton_codes(cells - cells.min(axis=0) // COARSEST * COARSEST)
    order = np.argsort(codes, kind="stable")
    begin = np.flatnonzero(np.diff(codes[order], prepend=-1))
    counts = np.diff(begin, append=num)
    columns = [np.add.reduceat(column[order], begin, dtype=np.float64) / counts for column in nodes.T]
    return Voxels(codes[order][begin], np.stack(columns, axis=1, dtype=np.float32), origin)


@inline_kernel
def first_slot(index: Int32s, x: np.int64, y: np.int64, z: np.int64) -> np.int64:
    """Return the slot of the hash index at which the search for a cell begins."""
    # Teschner et al., VMV 2003. Products have less than 63 bits, so none overflows, with or without Numba.
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return (mixed ^ (mixed >> 17)) & (len(index) - 1)


@inline_kernel
def find_slot(index: Int32s, rows: Int32s, slot: np.int64, x: np.int64, y: np.int64, z: np.int64) -> np.int64:
    """Return the slot that holds a cell's row, or the free slot in which it belongs."""
    while index[slot] != 0:
        row = rows[index[slot] - 1]
        if row[CELL_COLUMN] == x and row[CELL_COLUMN + 1] == y and row[CELL_COLUMN + 2] == z:
            break
        slot = (slot + 1) & (len(index) - 1)
    return slot


@inline_kernel
def locate_cell(quanta: Int64s) -> tuple[np.int64, np.int64, np.int64]:
    """Return the cell of a point, given its quanta (3,) from the base."""
    return quanta[0] >> QUANTUM_BITS, quanta[1] >> QUANTUM_BITS, quanta[2] >> QUANTUM_BITS


@inline_kernel
def look_up(
    points: Array, base: Int64s, index: Int32s, rows: Int32s, quanta: Int64s, slots: Int64s, found: Int32s
) -> None:
    """Write the quanta (3, n) of points (n, 3) [m] from the base, and the first slot (n,) of each one's cell.

    The rows that these slots name are read into `found` (n,), only so that they are in the processor's cache.
    """
    for k in range(3):
        for i in range(len(points)):
            quantum = np.int64(np.floor(points[i, k] * QUANTA_PER_METRE)) + PHASE
            quanta[k, i] = quantum - (base[k] << QUANTUM_BITS)
    for i in range(len(points)):
        x, y, z = locate_cell(quanta[:, i])
        slots[i] = first_slot(index, x, y, z)
    for i in range(len(points)):
        found[i] = index[slots[i]]
    for i in range(len(points)):
        found[i] = rows[max(found[i], 1) - 1, COUNT_COLUMN]


@inline_kernel
def enter_cells(
    quanta: Int64s, slots: Int64s, index: Int32s, rows: Int32s, num_voxels: int, found: Int32s
) -> tuple[int, int]:
    """Write the row (n,) of each point's cell, made if it is missing; return as `add_points` does."""
    for i in range(len(found)):
        x, y, z = locate_cell(quanta[:, i])
        if num_voxels == len(rows) or max(abs(x), abs(y), abs(z)) >= MAX_CELL:
            return i, num_voxels
        slot = find_slot(index, rows, slots[i], x, y, z)
        if index[slot] == 0:
            row = rows[num_voxels]
            row[:] = 0
            row[CELL_COLUMN] = x
            row[CELL_COLUMN + 1] = y
            row[CELL_COLUMN + 2] = z
            num_voxels += 1
            index[slot] = num_voxels
        found[i] = index[slot] - 1
    return len(found), num_voxels


@kernel
def add_points(
    points: Array, colors: Bytes, base: Int64s, index: Int32s, rows: Int32s, num_voxels: int
) -> tuple[int, int]:
    """Add points (N, 3) [m] with colours (N, 3) to the rows (n, 10) of `num_voxels` voxels.

    `index` (2^k,) is a hash index of the cells: it holds the index of a cell's row plus 1, and 0 in free
    slots. Stop at a point that is farther from the base than MAX_CELL, or when no row is left. Return the
    number of points that were added and the number of voxels.
    """
    quanta = np.empty((3, TOGETHER), np.int64)
    slots = np.empty(TOGETHER, np.int64)
    found = np.empty(TOGETHER, np.int32)
    for begin in range(0, len(points), TOGETHER):
        num = min(TOGETHER, len(points) - begin)
        look_up(points[begin : begin + num], base, index, rows, quanta, slots, found)
        count, num_voxels = enter_cells(quanta, slots, index, rows, num_voxels, found[:num])
        for i in range(count):
            row = rows[found[i]]
            if row[COUNT_COLUMN] < MAX_COUNT:
                row[COUNT_COLUMN] += 1
                for k in range(3):
                    row[POSITION + k] += quanta[k, i] & QUANTUM_MASK
                    row[COLOR + k] += colors[begin + i, k]
        if count < num:
            return begin + count, num_voxels
    return len(points), num_voxels


@kernel
def fill_index(rows: Int32s, num_voxels: int, index: Int32s) -> None:
    """Enter the rows (n, 10) of `num_voxels` voxels in an index (2^k,) of zeros."""
    for k in range(num_voxels):
        x, y, z = (
            np.int64(rows[k, CELL_COLUMN]),
            np.int64(rows[k, CELL_COLUMN + 1]),
            np.int64(rows[k, CELL_COLUMN + 2]),
        )
        index[find_slot(index, rows, first_slot(index, x, y, z), x, y, z)] = k + 1


class VoxelTable:
    """Sums over the points in each voxel: rows in the order of the first points, and a hash index."""

    def __init__(self, label: str) -> None:
        self.label = label  # of the cloud, for messages
        self.num_voxels = 0
        self.base = np.zeros(3, np.int64)  # cell of the first point
        self.rows = np.empty((FIRST_ROWS, NUM_COLUMNS), np.int32)
        self.index = np.zeros(4 * FIRST_ROWS, np.int32)

    def add(self, points: Array, colors: Bytes) -> None:
        """Add finite points (N, 3) [m], in the map's axes, with colours (N, 3)."""
        points = np.ascontiguousarray(points)  # so that the kernel is compiled once
        colors = np.ascontiguousarray(colors)
        if self.num_voxels == 0 and len(points):
            self.base = np.floor(points[0] / LEAF_SIZE).astype(np.int64)
        while len(points):
            full = min(len(self.rows), int(MAX_LOAD * len(self.index)), MAX_VOXELS)
            added = add_points(points, colors, self.base, self.index, self.rows[:full], self.num_voxels)
            num_added, self.num_voxels = added
            points = points[num_added:]
            colors = colors[num_added:]
            if len(points) and self.num_voxels < full:
                far = f"points more than {MAX_CELL * LEAF_SIZE / 1000:.0f} km apart, wanted one scene"
                raise InputError(f"{self.label}: {far}; remove broken points or set `units`")
            if len(points):
                self._grow()

    def _grow(self) -> None:
        if self.num_voxels >= MAX_VOXELS:
            found = f"more than {self.num_voxels} voxels of {LEAF_SIZE} m are filled"
            raise InputError(f"{self.label}: {found}; if its unit is not the metre, set `units`")
        if self.num_voxels == len(self.rows):
            num_more = max(FIRST_ROWS, len(self.rows) // MORE_ROWS)
            self._check_memory(num_more * ROW_BYTES)
            # Linux can move the pages to another address; other systems copy all rows.
            self.rows.resize((len(self.rows) + num_more, NUM_COLUMNS), refcheck=False)
        if self.num_voxels >= int(MAX_LOAD * len(self.index)):
            num_slots = 2 * len(self.index)
            self._check_memory(num_slots * SLOT_BYTES)
            self.index = np.zeros(0, np.int32)  # first frees its memory
            self.index = np.zeros(num_slots, np.int32)
            fill_index(self.rows, self.num_voxels, self.index)

    def _check_memory(self, num_bytes: int) -> None:
        check_memory(num_bytes, f"{self.label}: a table of more than {self.num_voxels} voxels of 2 cm", THIN)

    def finish(self) -> Voxels:
        """Return the voxels, without those too far away for a Morton code; the table can't be used again."""
        num = self.num_voxels
        self.index = np.zeros(0, np.int32)
        check_memory(num * SORTED_BYTES, f"{self.label}: sorting {num} voxels of 2 cm", THIN)
        rows = self.rows[:num]
        self.rows = np.empty((0, NUM_COLUMNS), np.int32)
        rows, warnings = self._without_far(rows)
        cells = [rows[:, k] for k in range(COUNT_COLUMN)]
        low = np.array([column.min() for column in cells]) + self.base
        high = np.array([column.max() for column in cells]) + self.base + 1
        parts = [slice(begin, begin + VOXELS_AT_ONCE) for begin in range(0, len(rows), VOXELS_AT_ONCE)]
        codes = np.empty(len(rows), np.int64)
        for part in parts:
            codes[part] = morton_codes(rows[part, :COUNT_COLUMN] + (self.base - low // COARSEST * COARSEST))
        order = np.argsort(codes)
        # + 0.0 turns -0.0 into 0.0
        origin = np.round(0.5 * LEAF_SIZE * (low + high) - PHASE / QUANTA_PER_METRE) + 0.0
        nodes = np.empty((len(rows), 6), np.float32)
        for part in parts:
            taken = rows[order[part]]
            counts = taken[:, COUNT_COLUMN].astype(np.float64)
            for k in range(3):
                corners = (taken[:, CELL_COLUMN + k] + self.base[k]) * LEAF_SIZE - origin[k]
                sums = taken[:, POSITION + k]
                nodes[part, k] = corners + (sums / counts + 0.5 - PHASE) / QUANTA_PER_METRE
                nodes[part, 3 + k] = taken[:, COLOR + k] / counts / 255.0
        return Voxels(codes[order], nodes, origin, warnings)

    def _without_far(self, rows: Int32s) -> tuple[Int32s, tuple[str, ...]]:
        """Return the rows of voxels within WINDOW of the median, and a warning if others are left out."""
        is_near = np.ones(len(rows), dtype=np.bool_)
        for column in rows[:, :COUNT_COLUMN].T:
            middle = int(np.partition(column, len(column) // 2)[len(column) // 2])
            if int(column.min()) < middle - WINDOW or int(column.max()) > middle + WINDOW:
                is_near &= np.abs(column.astype(np.int64) - middle) <= WINDOW
        if is_near.all():
            return rows, ()
        num_far = int(rows[~is_near, COUNT_COLUMN].sum(dtype=np.int64))
        text = f"{num_far} points farther than {WINDOW * LEAF_SIZE / 1000:.0f} km from the middle"
        if not is_near.any():
            raise InputError(f"{self.label}: {text}, and none nearer, wanted one scene")
        return rows[is_near], (f"{self.label}: {text} left out",)
