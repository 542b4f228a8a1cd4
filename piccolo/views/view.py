"""The cloud seen from a position: z-buffered cells of the sphere, by voxels as fine as the cells."""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..cloud.octree import MAX_NODES, Octree, collect
from ..geometry.cone import EVERYWHERE, Cone
from ..geometry.sphere import BLOCK_RINGS, PI, atan2, find_cell, interpolation, make_grid, make_neighbors
from ..photo.panorama.local_normalization import mean_and_inverse_std, opponent, zscore
from ..system.arrays import Array, Array32, Floats, Int32s, Mask
from ..system.kernels.jit import F0, F1, HALF, kernel, whole
from .drawn_edges import replace_by_edges
from .zbuffer import VISIBLE_FACTOR

VIEWS_A_TASK = 64  # views that a thread makes at a time
FAR_RANGE = np.float32(1e30)  # [m] of a cell in which nothing is seen

Center = Sequence[float] | Array


class Cells(NamedTuple):
    """Surfaces of the scan seen from a centre: one for each of N cells of the sphere, or N points."""

    offsets: Array32  # (3, N) [m] from the centre
    channels: Array32  # (3, N) opponent colours, locally normalised [standard deviations]
    weights: Array32  # (N,) a cell's fraction of the sphere, 0 if nothing is seen in it; a point's is 1
    center_map: Array  # (3,) [m]

    def around(self, center_map: Array) -> "Cells":
        """Return the cells with offsets from another centre (3,)."""
        shift = np.asarray(center_map - self.center_map, np.float32)
        return self._replace(offsets=self.offsets - shift[:, None], center_map=center_map)


class ViewArrays(NamedTuple):
    """A view's configuration as kernels read it."""

    num_columns: Int32s  # (rings,) number of cells in each ring
    first: Int32s  # (rings,) index of each ring's first cell
    stats_cell: Int32s  # (cells,) index of the wider cell in which each lies
    num_stats: int  # number of wider cells, which hold the local statistics
    solid_angle: Array32  # (cells,) fraction of the sphere
    neighbor_row: Int32s  # (wider cells + 1,) index of each wider cell's first neighbour in the next two
    neighbor_cell: Int32s  # indices of wider cells
    neighbor_weight: Array32  # their Gaussian weights
    near_stats: Int32s  # (cells, 4) the wider cells around each cell's middle
    near_weight: Array32  # (cells, 4) their bilinear weights
    front: np.float32  # as in ViewConfig
    visible: np.float32  # as in ViewConfig
    blocks: Int32s  # (cells,) index of the block of the sphere in which each lies, for scores


class Scratch(NamedTuple):
    """Arrays that one thread needs to render, with room for N nodes of the octree."""

    nodes: Int32s  # (N,)
    directions: Array32  # (3, N) [m] from the centre
    cells: Int32s  # (N,)
    ranges: Array32  # (N,) [m]
    turns: Array32  # (N,)


@dataclass(frozen=True)
class ViewConfig:
    """Settings of a view: its cells, the neighbourhood that normalises colours, the voxels' angular size."""

    num_rings: int  # of cells from pole to pole
    stats_rings: int  # rings of the wider cells that hold the local statistics: cells no wider than sigma
    sigma_deg: float  # of the Gaussian over which colours are normalised
    voxel_per_range: float  # largest voxel, divided by its distance
    front: float = 1.15  # a cell's colour is the mean of points up to this times its nearest range
    visible: float = float(VISIBLE_FACTOR)  # a point is seen up to this times it, plus VISIBLE_OFFSET
    draws_edges: bool = False  # edges, found in the view's ranges, replace the colours

    @cached_property
    def arrays(self) -> ViewArrays:
        """The settings as kernels read them."""
        grid = make_grid(self.num_rings)
        neighbors = make_neighbors(self.stats_rings, self.sigma_deg)
        return ViewArrays(
            grid.num_columns,
            grid.first,
            find_cell(grid.directions, self.stats_rings),
            len(make_grid(self.stats_rings)),
            grid.solid_angle,
            neighbors.row,
            neighbors.cell,
            neighbors.weight,
            *interpolation(self.num_rings, self.stats_rings),
            np.float32(self.front),
            np.float32(self.visible),
            find_cell(grid.directions, BLOCK_RINGS),
        )


@kernel
def locate(
    X: Array32,
    Y: Array32,
    Z: Array32,
    num_columns: Int32s,
    first: Int32s,
    cells: Int32s,
    ranges: Array32,
    turns: Array32,
) -> None:
    """Write the cell and the range [m] of each position X, Y, Z [m] relative to the centre.

    `turns` is overwritten with the azimuths, in turns.
    """
    num_rings = np.float32(len(num_columns))
    per_pi = np.float32(len(num_columns) / math.pi)
    per_turn = np.float32(0.5 / math.pi)
    # Two loops: the arithmetic is vectorised, the look-ups in the second loop can't be.
    for i in range(len(cells)):
        x = X[i]
        y = Y[i]
        z = Z[i]
        rho2 = x * x + y * y
        ring = (HALF * PI - atan2(z, math.sqrt(rho2))) * per_pi
        cells[i] = whole(min(ring, num_rings - F1))
        turns[i] = atan2(y, x) * per_turn + HALF
        ranges[i] = math.sqrt(rho2 + z * z)
    for i in range(len(cells)):
        ring = cells[i]
        n = num_columns[ring]
        cells[i] = first[ring] + min(whole(turns[i] * np.float32(n)), n - np.int32(1))


@kernel
def locate_nodes(
    tree: Octree, center: Array, voxel_per_range: float, view: ViewArrays, cone: Cone, scratch: Scratch
) -> int:
    """Fill the scratch with the nodes to draw, their offsets, cells and ranges; return their number."""
    s = scratch
    n = collect(tree, center, voxel_per_range, cone, s.nodes, s.directions)
    x = s.directions[0, :n]  # row by row: in a slice of all three rows the compiler does not know the stride
    y = s.directions[1, :n]
    z = s.directions[2, :n]
    locate(x, y, z, view.num_columns, view.first, s.cells[:n], s.ranges[:n], s.turns)
    return n


@kernel
def average_nodes(
    tree: Octree,
    center: Array,
    voxel_per_range: float,
    view: ViewArrays,
    cone: Cone,
    scratch: Scratch,
    sums: Array32,
) -> int:
    """Write the sums (cells, 8) over each cell's nearest nodes: x, y, z, r, g, b, count; and the least range.

    Positions are relative to the centre [m], colours in [0, 1]. A cell's nearest nodes are those up to
    `view.front` times its least range [m]. Cells that lie partly outside of the cone may miss some nodes. All
    nodes in the cone stay in the scratch; their number is returned.
    """
    n = locate_nodes(tree, center, voxel_per_range, view, cone, scratch)
    s = scratch
    cells = s.cells[:n]
    sums[:] = F0
    sums[:, 7] = FAR_RANGE
    for i in range(n):
        cell = cells[i]
        sums[cell, 7] = min(sums[cell, 7], s.ranges[i])
    for i in range(n):
        cell = cells[i]
        if s.ranges[i] <= sums[cell, 7] * view.front:
            node = s.nodes[i]
            for k in range(3):
                sums[cell, k] += s.directions[k, i]
                sums[cell, k + 3] += tree.nodes[node, k + 3]
            sums[cell, 6] += F1
    return n


@kernel
def average_colors(
    sums: Array32,
    view: ViewArrays,
    shown: Mask,
    offsets: Array32,
    channels: Array32,
    weights: Array32,
    moments: Array32,
) -> None:
    """Write mean positions, opponent channels and weights of the cells in a mask, and add up their moments.

    Positions [m] are relative to the centre. All are 0 in other cells. The moments are those that
    `cell_statistics` reads: weight, weighted channels and weighted squares by wider cell (wider cells, 8).
    """
    moments[:] = F0
    for c in range(len(sums)):
        if shown[c] and sums[c, 6] > F0:
            per = F1 / sums[c, 6]
            for k in range(3):
                offsets[k, c] = sums[c, k] * per
            colors = opponent(sums[c, 3] * per, sums[c, 4] * per, sums[c, 5] * per)
            w = view.solid_angle[c]
            weights[c] = w
            m = moments[view.stats_cell[c]]
            m[0] += w
            for k in range(3):
                channels[k, c] = colors[k]
                m[1 + k] += w * colors[k]
                m[4 + k] += w * colors[k] * colors[k]
        else:
            weights[c] = F0
            for k in range(3):
                offsets[k, c] = F0
                channels[k, c] = F0


@kernel
def cell_statistics(moments: Array32, view: ViewArrays, weights: Array32, stats: Array32) -> None:
    """Write the local means (3) and inverse deviations (3) of the channels (6, cells) at cells with a weight.

    They are computed at the wider cells, from the moments of these and their neighbours, and interpolated.
    """
    coarse = np.zeros((view.num_stats, 8), np.float32)
    around = np.empty(8, np.float32)
    for c in range(view.num_stats):
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = F0
        for j in range(view.neighbor_row[c], view.neighbor_row[c + 1]):
            w = view.neighbor_weight[j]
            m = moments[view.neighbor_cell[j]]
            s0 += w * m[0]
            s1 += w * m[1]
            s2 += w * m[2]
            s3 += w * m[3]
            s4 += w * m[4]
            s5 += w * m[5]
            s6 += w * m[6]
            s7 += w * m[7]  # always 0: eight sums fill a vector register
        per = F1 / s0 if s0 > F0 else F0
        coarse[c, 0], coarse[c, 3] = mean_and_inverse_std(s1, s4, per)
        coarse[c, 1], coarse[c, 4] = mean_and_inverse_std(s2, s5, per)
        coarse[c, 2], coarse[c, 5] = mean_and_inverse_std(s3, s6, per)
    for c in range(len(weights)):
        if weights[c] > F0:
            near = view.near_stats[c]
            w = view.near_weight[c]
            a = coarse[near[0]]
            b = coarse[near[1]]
            d = coarse[near[2]]
            e = coarse[near[3]]
            for k in range(8):  # eight as above; into `around`, or the compiler reads one by one
                around[k] = w[0] * a[k] + w[1] * b[k] + w[2] * d[k] + w[3] * e[k]
            for k in range(6):
                stats[k, c] = around[k]


@kernel
def describe_cells(
    sums: Array32,
    view: ViewArrays,
    shown: Mask,
    offsets: Array32,
    channels: Array32,
    weights: Array32,
    stats: Array32,
) -> None:
    """Write mean position, opponent channels, weight and local statistics of each cell in a mask."""
    moments = np.empty((view.num_stats, 8), np.float32)
    average_colors(sums, view, shown, offsets, channels, weights, moments)
    cell_statistics(moments, view, weights, stats)


@kernel
def normalize_cells(
    sums: Array32, view: ViewArrays, shown: Mask, offsets: Array32, channels: Array32, weights: Array32
) -> None:
    """Write mean position, locally normalised channels and weight of each cell in a mask."""
    stats = np.empty((6, len(weights)), np.float32)
    describe_cells(sums, view, shown, offsets, channels, weights, stats)
    for k in range(3):
        for c in range(len(weights)):
            if weights[c] > F0:
                channels[k, c] = zscore(channels[k, c], stats[k, c], stats[3 + k, c])


@kernel
def nearest_node_ranges(
    tree: Octree, centers: Floats, voxel_per_range: float, view: ViewArrays, scratch: Scratch, ranges: Array32
) -> None:
    """Write the range [m] of the nearest node in each cell around each centre: (n, cells), 0 without a node.

    `centers` (n, 3) [m] are in the map's frame.
    """
    for k in range(len(centers)):
        n = locate_nodes(tree, centers[k], voxel_per_range, view, EVERYWHERE, scratch)
        ranges[k] = F0
        for i in range(n):
            cell = scratch.cells[i]
            if ranges[k, cell] == F0 or scratch.ranges[i] < ranges[k, cell]:
                ranges[k, cell] = scratch.ranges[i]


_local = threading.local()


def thread_scratch() -> Scratch:
    """Return the calling thread's scratch, kept for all views: to allocate it takes as long as a view."""
    if not hasattr(_local, "scratch"):
        nodes, cells = np.empty((2, MAX_NODES), np.int32)
        floats = np.empty((5, MAX_NODES), np.float32)
        _local.scratch = Scratch(nodes, floats[:3], cells, floats[3], floats[4])
    scratch: Scratch = _local.scratch
    return scratch


def average_view(octree: Octree, center_map: Center, config: ViewConfig, cone: Cone = EVERYWHERE) -> Array32:
    """Render a view from a centre (3,) [m]; return its sums (cells, 8) as `average_nodes` writes them.

    Only the cells inside the cone, in the map's frame, are complete.
    """
    sums = np.empty((len(make_grid(config.num_rings)), 8), np.float32)
    center = np.asarray(center_map, np.float64)
    average_nodes(octree, center, config.voxel_per_range, config.arrays, cone, thread_scratch(), sums)
    if config.draws_edges:
        replace_by_edges(sums, config.num_rings)
    return sums


def empty_cells(n: int, center_map: Center) -> Cells:
    """Return uninitialised arrays for `n` cells or points around a centre (3,) [m]."""
    offsets, channels = np.empty((2, 3, n), np.float32)
    return Cells(offsets, channels, np.empty(n, np.float32), np.asarray(center_map, np.float64))


def normalize_view(sums: Array32, center_map: Center, config: ViewConfig, shown: Mask) -> Cells:
    """Normalise a view from a centre (3,) [m], given its sums (N, 8); the weight is 0 outside a mask (N,)."""
    cells = empty_cells(len(sums), center_map)
    normalize_cells(sums, config.arrays, shown, *cells[:3])
    return cells


def ranges_around(octree: Octree, centers_map: Floats, config: ViewConfig) -> Array32:
    """Return the range [m] of the nearest node in each cell around each centre (n, 3): (n, cells), or 0."""
    ranges = np.empty((len(centers_map), len(make_grid(config.num_rings))), np.float32)
    centers_map = np.ascontiguousarray(centers_map)  # so that the kernel is compiled once
    nearest_node_ranges(octree, centers_map, config.voxel_per_range, config.arrays, thread_scratch(), ranges)
    return ranges
