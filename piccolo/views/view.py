"""The cloud seen from a position: z-buffered cells of the sphere, from voxels as fine as the cells ask."""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import MAX_NODES, Octree, collect
from ..geometry.pose import Array
from ..geometry.sphere import BLOCK_RINGS, cell_of, interpolation, make_grid, make_neighbors
from ..kernels.jit import F0, F1, HALF, inline_kernel, kernel
from ..panorama.local_normalization import LEVELS_PER_UNIT, zscore
from .cells import average_cells, average_colors, local_statistics, locate

BLOCK = 64  # views that a thread makes at a time

Array32 = NDArray[np.float32]
Center = Sequence[float] | Array


class Cells(NamedTuple):
    """What is seen around a centre, on cells of the sphere or as points."""

    offsets: NDArray[np.float32]  # (3, N) [m] from the centre
    channels: NDArray[np.float32]  # (3, N) opponent colours, locally normalised [standard deviations]
    weights: NDArray[np.float32]  # (N,) fraction of the sphere; 0 where nothing is seen; 1 of a point
    center_map: Array  # (3,) [m]

    def around(self, center_map: Array) -> "Cells":
        """The same with offsets from another centre (3,)."""
        shift = np.asarray(center_map - self.center_map, np.float32)
        return self._replace(offsets=self.offsets - shift[:, None], center_map=center_map)


class ViewArrays(NamedTuple):
    """A view's configuration as kernels read it."""

    num_columns: NDArray[np.int32]  # (rings,) of the cells
    first: NDArray[np.int32]  # (rings,) index of each ring's first cell
    stats_cell: NDArray[np.int32]  # (cells,) the wider cell that each lies in
    num_stats: int  # wider cells
    solid_angle: NDArray[np.float32]  # (cells,) fraction of the sphere
    neighbor_row: NDArray[np.int32]  # (wider cells + 1,) where each wider cell's neighbours begin
    neighbor_cell: NDArray[np.int32]  # wider cells
    neighbor_weight: NDArray[np.float32]
    near_stats: NDArray[np.int32]  # (cells, 4) wider cells around each cell
    near_weight: NDArray[np.float32]  # (cells, 4) of statistics there
    front: np.float32
    visible: np.float32
    blocks: NDArray[np.int32]  # (cells,) the block of the sphere that each lies in, for scores


class Scratch(NamedTuple):
    """Arrays that one thread needs to render."""

    nodes: NDArray[np.int32]
    directions: NDArray[np.float32]  # (3, N)
    cells: NDArray[np.int32]
    ranges: NDArray[np.float32]
    turns: NDArray[np.float32]


@dataclass(frozen=True)
class ViewConfig:
    """How a view is made: its cells, the neighbourhood that normalises colours, the voxels' angular size."""

    num_rings: int
    stats_rings: int  # cells of these rings carry the local statistics: no wider than sigma
    sigma_deg: float
    voxel_per_range: float  # largest voxel size by its distance
    front: float = 1.15  # a cell's colour is the mean of points up to this times its nearest range
    visible: float = 1.08  # a point is seen up to this times (and VISIBLE_OFFSET): grazing floors pass

    @cached_property
    def arrays(self) -> ViewArrays:
        """What the kernels read."""
        grid = make_grid(self.num_rings)
        neighbors = make_neighbors(self.stats_rings, self.sigma_deg)
        return ViewArrays(
            grid.num_columns,
            grid.first,
            cell_of(grid.directions, self.stats_rings),
            len(make_grid(self.stats_rings)),
            grid.solid_angle,
            neighbors.row,
            neighbors.cell,
            neighbors.weight,
            *interpolation(self.num_rings, self.stats_rings),
            np.float32(self.front),
            np.float32(self.visible),
            cell_of(grid.directions, BLOCK_RINGS),
        )


@kernel
def locate_nodes(tree, center, voxel_per_range, view, scratch):
    """Fill the scratch with the nodes to draw, their offsets, cells and ranges; returns how many."""
    s = scratch
    n = collect(tree, center, voxel_per_range, s.nodes, s.directions)
    x, y, z = s.directions[0, :n], s.directions[1, :n], s.directions[2, :n]
    locate(x, y, z, view.num_columns, view.first, s.cells[:n], s.ranges[:n], s.turns)
    return n


@kernel
def average_nodes(tree, center, voxel_per_range, view, scratch, sums):
    """Write what `average_cells` makes of the nodes around a centre, which are in the scratch; how many."""
    n = locate_nodes(tree, center, voxel_per_range, view, scratch)
    s = scratch
    average_cells(tree.nodes, s.nodes, s.directions, s.cells[:n], s.ranges, view.front, sums)
    return n


@kernel
def describe_cells(sums, view, shown, offsets, channels, weights, stats):
    """Write position, opponent channels, weight and local statistics of each cell shown, by its sums."""
    moments = np.empty((view.num_stats, 8), np.float32)
    average_colors(sums, view, shown, offsets, channels, weights, moments)
    local_statistics(moments, view, weights, stats)


@kernel
def normalize_cells(sums, view, shown, offsets, channels, weights):
    """The same with normalised channels."""
    stats = np.empty((6, len(weights)), np.float32)
    describe_cells(sums, view, shown, offsets, channels, weights, stats)
    for k in range(3):
        for c in range(len(weights)):
            if weights[c] > F0:
                channels[k, c] = zscore(channels[k, c], stats[k, c], stats[3 + k, c])


@inline_kernel
def as_level(channel):
    """A normalised channel in 8 bits."""
    level = math.floor(channel * np.float32(LEVELS_PER_UNIT) + HALF)
    return np.int8(min(max(level, np.float32(-127)), np.float32(127)))


@kernel
def render_block(tree, centers, voxel_per_range, view, scratch, offsets, unit, levels, is_seen):
    """Views from several centres in few bits: offsets in units of their own, channels in levels."""
    n = len(view.solid_angle)
    points, channels = np.empty((3, n), np.float32), np.empty((3, n), np.float32)
    weights, shown, sums = np.empty(n, np.float32), np.ones(n, np.bool_), np.empty((n, 8), np.float32)
    for k in range(len(centers)):
        average_nodes(tree, centers[k], voxel_per_range, view, scratch, sums)
        normalize_cells(sums, view, shown, points, channels, weights)
        largest = np.float32(1e-3)
        for i in range(3):
            for c in range(n):
                largest = max(largest, abs(points[i, c]))
        unit[k] = largest / np.float32(32767)
        for i in range(3):
            for c in range(n):
                offsets[k, i, c] = np.int16(points[i, c] / unit[k])
                levels[k, i, c] = as_level(channels[i, c])
        for c in range(n):
            is_seen[k, c] = weights[c] > F0


@kernel
def render_wide_block(tree, centers, voxel_per_range, view, scratch, features, seen):
    """Views from several centres averaged over the wider cells that hold their statistics, in few bits.

    Channels (n, 3, wider cells) in levels, by the whole cell's area, and how much of it is seen (n, wider
    cells), 255 for all.
    """
    n, m = len(view.solid_angle), view.num_stats
    points, channels = np.empty((3, n), np.float32), np.empty((3, n), np.float32)
    weights, shown, sums = np.empty(n, np.float32), np.ones(n, np.bool_), np.empty((n, 8), np.float32)
    wide, area = np.empty((m, 4), np.float32), np.zeros(m, np.float32)
    for c in range(n):
        area[view.stats_cell[c]] += view.solid_angle[c]
    for k in range(len(centers)):
        average_nodes(tree, centers[k], voxel_per_range, view, scratch, sums)
        normalize_cells(sums, view, shown, points, channels, weights)
        wide[:] = F0
        for c in range(n):
            if weights[c] > F0:
                total = wide[view.stats_cell[c]]
                for i in range(3):
                    total[i] += weights[c] * channels[i, c]
                total[3] += weights[c]
        for c in range(m):
            for i in range(3):
                features[k, i, c] = as_level(wide[c, i] / area[c])
            seen[k, c] = np.uint8(min(wide[c, 3] / area[c], F1) * np.float32(255) + HALF)


@kernel
def nearest_ranges(tree, centers, voxel_per_range, view, scratch, ranges):
    """Write ranges [m] of the nearest nodes in the cells (n, cells) around each centre (n, 3), 0 for none."""
    for k in range(len(centers)):
        n = locate_nodes(tree, centers[k], voxel_per_range, view, scratch)
        ranges[k] = F0
        for i in range(n):
            cell = scratch.cells[i]
            if ranges[k, cell] == F0 or scratch.ranges[i] < ranges[k, cell]:
                ranges[k, cell] = scratch.ranges[i]


def make_scratch() -> Scratch:
    """Arrays for the largest view."""
    n = MAX_NODES
    directions = np.empty((3, n), np.float32)
    return Scratch(
        np.empty(n, np.int32),
        directions,
        np.empty(n, np.int32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
    )


_local = threading.local()


def thread_scratch() -> Scratch:
    """The calling thread's own scratch: fresh memory costs as much as a view."""
    if not hasattr(_local, "scratch"):
        _local.scratch = make_scratch()
    scratch: Scratch = _local.scratch
    return scratch


def average_view(octree: Octree, center_map: Center, config: ViewConfig) -> Array32:
    """Sums (cells, 8), as `average_cells` writes them, of what is seen around a centre (3,) [m]."""
    sums = np.empty((len(make_grid(config.num_rings)), 8), np.float32)
    center = np.asarray(center_map, np.float64)
    average_nodes(octree, center, config.voxel_per_range, config.arrays, thread_scratch(), sums)
    return sums


def empty_cells(n: int, center_map: Center) -> Cells:
    """Room for some cells or points around a centre (3,) [m]."""
    offsets, channels = np.empty((3, n), np.float32), np.empty((3, n), np.float32)
    return Cells(offsets, channels, np.empty(n, np.float32), np.asarray(center_map, np.float64))


def normalized_view(sums: Array32, center_map: Center, config: ViewConfig, shown: NDArray[np.bool_]) -> Cells:
    """A view around a centre (3,) [m] by its sums (N, 8): those cells (N,) of `config` that are shown."""
    cells = empty_cells(len(sums), center_map)
    normalize_cells(sums, config.arrays, shown, *cells[:3])
    return cells


def ranges_around(
    octree: Octree, centers_map: NDArray[np.floating[Any]], config: ViewConfig
) -> NDArray[np.float32]:
    """How far away (n, cells) [m] the nearest of what is seen from each centre (n, 3) is, 0 for nothing."""
    ranges = np.empty((len(centers_map), len(make_grid(config.num_rings))), np.float32)
    centers_map = np.ascontiguousarray(centers_map)  # one kernel for all
    nearest_ranges(octree, centers_map, config.voxel_per_range, config.arrays, thread_scratch(), ranges)
    return ranges
