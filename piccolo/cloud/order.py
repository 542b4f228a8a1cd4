"""The canonical order of points along Morton's curve, and thinning to one point a voxel."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..jit import kernel, scalar

NUM_CELLS = 1 << 21  # along an axis; three axes fill 63 bits


@scalar
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
        codes[i] = (
            spread_bits(cells[i, 0]) | (spread_bits(cells[i, 1]) << 1) | (spread_bits(cells[i, 2]) << 2)
        )


@kernel
def voxel_sums(points, colors, order, begins, positions, color_sums):
    """Sum positions (M, 3) float64 and colours (M, 3) int64 of each run of `order`; begins (M + 1,)."""
    for m in range(len(begins) - 1):
        # typed, so that they don't shrink to float32 and uint8 when run without Numba
        x, y, z = np.float64(0.0), np.float64(0.0), np.float64(0.0)
        red, green, blue = np.int64(0), np.int64(0), np.int64(0)
        for k in range(begins[m], begins[m + 1]):
            i = order[k]
            x += points[i, 0]
            y += points[i, 1]
            z += points[i, 2]
            red += colors[i, 0]
            green += colors[i, 1]
            blue += colors[i, 2]
        positions[m, 0], positions[m, 1], positions[m, 2] = x, y, z
        color_sums[m, 0], color_sums[m, 1], color_sums[m, 2] = red, green, blue


def morton_codes(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Morton code (N,) of each cell (N, 3) in [0, 2^21)."""
    codes = np.empty(len(cells), dtype=np.int64)
    interleave(cells, codes)
    return codes


def canonical_order(points: NDArray[np.float32], colors: NDArray[np.uint8]) -> NDArray[np.int64]:
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
    codes: NDArray[np.int64],
    order: NDArray[np.int64],
    points: NDArray[np.float32],
    colors: NDArray[np.uint8],
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


def thin(
    points: NDArray[np.float32], colors: NDArray[np.uint8], voxel_size: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """One point a voxel: mean position (M, 3) and mean colour (M, 3), in Morton order.

    Points (N, 3) and colours (N, 3) come in canonical order, as a `Cloud` holds them: the float64 sums run in
    that order, so that the means' bits are the cloud's alone. Voxels are cubes of `voxel_size` [m] with a
    corner at the local origin.
    """
    cells = np.floor(points / np.float64(voxel_size)).astype(np.int64)
    cells -= cells.min(axis=0)
    if int(cells.max()) >= NUM_CELLS:
        raise InputError(
            f"cloud: spans {cells.max() * voxel_size:.3g} m, wanted under {NUM_CELLS * voxel_size:.3g} m for "
            f"voxels of {voxel_size:g} m; remove far outliers or set --scale"
        )
    codes = morton_codes(cells)
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    begins = np.flatnonzero(np.concatenate([[True], codes[1:] != codes[:-1], [True]]))
    num_voxels = len(begins) - 1
    positions = np.empty((num_voxels, 3))
    color_sums = np.empty((num_voxels, 3), dtype=np.int64)
    voxel_sums(points, colors, order, begins, positions, color_sums)
    counts = np.diff(begins)[:, None]
    means = (2 * color_sums + counts) // (2 * counts)  # rounded half up, in integers
    return (positions / counts).astype(np.float32), means.astype(np.uint8)
