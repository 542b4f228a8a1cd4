"""Voxels in Morton order, on a grid that is fixed in the map's axes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..jobs.memory import check_memory
from ..kernels.jit import inline_kernel, kernel

NUM_CELLS = 1 << 21  # along an axis; three axes fill 63 bits
LEAF_SIZE = 0.02  # [m]
QUANTUM_BITS = 8  # a voxel is 256 quanta wide: positions are summed in steps of 78 um
QUANTUM_MASK = (1 << QUANTUM_BITS) - 1
QUANTA_PER_METRE = (1 << QUANTUM_BITS) / LEAF_SIZE
WINDOW = (NUM_CELLS // 2) - 128  # cells from the median to those kept: 21 km
COARSEST = 128  # leaves along a voxel of the coarsest level
# From a corner of all levels' grids to zero, in quanta: a third of the coarsest voxel, so that zero and whole
# metres lie on no voxel's border. A floor at z = 0 would fall to both sides by its noise, and count twice.
PHASE = (COARSEST << QUANTUM_BITS) // 3 + 1

JOINING_BYTES = 160  # a voxel, of which two clouds' are joined: nodes, cells, codes, order, sums
AT_ONCE = 1 << 18  # voxels, whose temporary arrays stay small
THIN = "set --units if its unit is not the metre, or cut out a part"
NUM_LEVELS = COARSEST.bit_length()  # from 128 leaves wide (2.56 m) down to one


@inline_kernel
def spread_bits(cell):
    """The lowest 21 bits of an int64, each followed by two zeros."""
    bits = cell & 0x1FFFFF
    bits = (bits | (bits << 32)) & 0x1F00000000FFFF
    bits = (bits | (bits << 16)) & 0x1F0000FF0000FF
    bits = (bits | (bits << 8)) & 0x100F00F00F00F00F
    bits = (bits | (bits << 4)) & 0x10C30C30C30C30C3
    return (bits | (bits << 2)) & 0x1249249249249249


@kernel
def interleave(cells, codes):
    """Write the 63-bit Morton code (N,) of each cell (N, 3), int64 in [0, 2^21); x has the lowest bit."""
    for i in range(len(cells)):
        x, y, z = spread_bits(cells[i, 0]), spread_bits(cells[i, 1]), spread_bits(cells[i, 2])
        codes[i] = x | (y << 1) | (z << 2)


def morton_codes(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Morton code (N,) of each cell (N, 3) in [0, 2^21)."""
    codes = np.empty(len(cells), dtype=np.int64)
    interleave(cells, codes)
    return codes


def morton_order(points: NDArray[np.float32], colors: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Indices (N,) that sort points (N, 3) [m] and colours (N, 3) along Morton's curve.

    The cells are cubes, 2^21 along the longest side of the bounding box. Within a cell coordinates and then
    colours decide, so only points that are alike in every bit are left in the order of the input.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    # Rounded here, not in the kernel: fastmath may round the last, odd points of an array differently.
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
    """The voxels in which there are points, in Morton order."""

    codes: NDArray[np.int64]  # (M,) Morton codes; the three lowest bits choose among a parent's children
    nodes: NDArray[np.float32]  # (M, 6) mean x, y, z [m] less `origin`, mean r, g, b in [0, 1]
    origin: NDArray[np.float64]  # (3,) middle of their box in the map's axes, in whole metres
    warnings: tuple[str, ...] = ()  # one line each, for the user


def join_voxels(
    first: NDArray[np.float32], second: NDArray[np.float32], origin: NDArray[np.float64]
) -> Voxels:
    """The voxels of two clouds' nodes (N, 6) about one origin (3,), as of Voxels; both may have some voxels.

    Those that one of them has stay as they are, bit by bit; the others have the means of both means.
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
