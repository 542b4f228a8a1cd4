"""The sphere cut into rings of cells of nearly equal area, and Gaussian averages over them."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

SEARCH_RINGS = 24  # of the views that are searched: cells of 7.5 degrees
AREA_UNITS = 1000  # of the largest cell


@dataclass(frozen=True)
class SphereGrid:
    """`num_rings` rings of equal height; ring i has about 2 num_rings cos(elevation) cells."""

    num_columns: NDArray[np.int32]  # (rings,) cells of each ring
    first: NDArray[np.int32]  # (rings,) index of its first cell
    directions: NDArray[np.float32]  # (cells, 3) unit vectors of the cell centres
    solid_angle: NDArray[np.float32]  # (cells,) fractions of the sphere, sum 1

    def __len__(self) -> int:
        return len(self.solid_angle)


@dataclass(frozen=True)
class Neighbors:
    """Gaussian weights from the cells of one grid to those of another, as compressed rows."""

    row: NDArray[np.int32]  # (cells + 1,)
    cell: NDArray[np.int32]
    weight: NDArray[np.float32]  # not normalised: the valid weights are summed where they are used


@lru_cache(maxsize=8)
def make_grid(num_rings: int) -> SphereGrid:
    """Rings from the zenith down, azimuth growing within a ring from -pi."""
    edges = np.pi * (0.5 - np.arange(num_rings + 1) / num_rings)
    middle = 0.5 * (edges[:-1] + edges[1:])
    num_columns = np.maximum(np.rint(2 * num_rings * np.cos(middle)), 3).astype(np.int32)
    first = np.concatenate([[0], np.cumsum(num_columns)[:-1]]).astype(np.int32)
    directions, solid_angle = [], []
    for ring in range(num_rings):
        n = num_columns[ring]
        azimuth = ((np.arange(n) + 0.5) / n - 0.5) * 2 * np.pi
        c, s = np.cos(middle[ring]), np.sin(middle[ring])
        directions.append(np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.full(n, s)], axis=1))
        solid_angle.append(np.full(n, 0.5 * (np.sin(edges[ring]) - np.sin(edges[ring + 1])) / n))
    return SphereGrid(
        num_columns,
        first,
        np.concatenate(directions).astype(np.float32),
        np.concatenate(solid_angle).astype(np.float32),
    )


@lru_cache(maxsize=8)
def make_neighbors(num_rings: int, stats_rings: int, sigma_deg: float) -> Neighbors:
    """Gaussian weights of the statistics cells within 2.3 sigmas of each cell of a grid."""
    fine, coarse = make_grid(num_rings), make_grid(stats_rings)
    sigma = np.radians(sigma_deg)
    cosine = fine.directions @ coarse.directions.T
    rows, cells = np.nonzero(cosine > np.cos(2.3 * sigma))
    weight = np.exp((cosine[rows, cells] - 1) / sigma**2) * coarse.solid_angle[cells]
    row = np.searchsorted(rows, np.arange(len(fine) + 1)).astype(np.int32)
    return Neighbors(row, cells.astype(np.int32), weight.astype(np.float32))


@lru_cache(maxsize=4)
def averaging(num_rings: int) -> NDArray[np.float32]:
    """Weights (search cells, cells of num_rings) that sum search cells into wider ones.

    They go with the solid angle, in whole numbers up to AREA_UNITS: sums of whole numbers come out exact.
    """
    grid, wide = make_grid(SEARCH_RINGS), make_grid(num_rings)
    matrix = np.zeros((len(grid), len(wide)), np.float32)
    area = np.rint(grid.solid_angle / grid.solid_angle.max() * np.float32(AREA_UNITS))
    matrix[np.arange(len(grid)), cell_of(grid.directions, num_rings)] = area
    return matrix


def cell_of(directions: NDArray[np.float32], num_rings: int) -> NDArray[np.int32]:
    """The cell (N,) of a grid in which each direction (N, 3) lies."""
    d, grid = directions.astype(np.float64), make_grid(num_rings)
    ring = np.clip(
        ((0.5 - np.arcsin(np.clip(d[:, 2], -1, 1)) / np.pi) * num_rings).astype(int), 0, num_rings - 1
    )
    n = grid.num_columns[ring]
    column = np.minimum(((np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) + 0.5) * n).astype(int), n - 1)
    return np.asarray(grid.first[ring] + column, dtype=np.int32)
