"""The order of points along Morton's curve."""

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import inline_kernel, kernel

NUM_CELLS = 1 << 21  # along an axis; three axes fill 63 bits


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
    _settle_ties(codes[order], order, points, colors)
    return order


def _settle_ties(
    codes: NDArray[np.int64], order: NDArray[np.int64], points: NDArray[np.float32], colors: NDArray[np.uint8]
) -> None:
    """Sort `order` (N,) in place within each run of equal, ascending `codes` (N,)."""
    is_equal = codes[1:] == codes[:-1]
    is_tied = np.zeros(len(codes), dtype=np.bool_)
    is_tied[1:] |= is_equal
    is_tied[:-1] |= is_equal
    places = np.flatnonzero(is_tied)
    if len(places) == 0:
        return
    tied = order[places]
    keys = [*colors[tied].T[::-1], *points[tied].T[::-1], codes[places]]  # lexsort's last key counts first
    order[places] = tied[np.lexsort(keys)]
