"""The cloud seen from a position: z-buffered cells of the sphere, from voxels as fine as the cells ask."""

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
FAR_RANGE = np.float32(1e30)

Center = Sequence[float] | Array


class Cells(NamedTuple):
    """Surfaces of the scan seen from a centre, on cells of the sphere or as points."""

    offsets: Array32  # (3, N) [m] from the centre
    channels: Array32  # (3, N) opponent colours, locally normalised [standard deviations]
    weights: Array32  # (N,) fraction of the sphere; 0 where nothing is seen; 1 of a point
    center_map: Array  # (3,) [m]

    def around(self, center_map: Array) -> "Cells":
        """Return the cells with offsets from another centre (3,)."""
        shift = np.asarray(center_map - self.center_map, np.float32)
        return self._replace(offsets=self.offsets - shift[:, None], center_map=center_map)


class ViewArrays(NamedTuple):
    """A view's configuration as kernels read it."""

    num_columns: Int32s  # (rings,) of the cells
    first: Int32s  # (rings,) index of each ring's first cell
    stats_cell: Int32s  # (cells,) the wider cell that each lies in
    num_stats: int  # wider cells
    solid_angle: Array32  # (cells,) fraction of the sphere
    neighbor_row: Int32s  # (wider cells + 1,) where each wider cell's neighbours begin
    neighbor_cell: Int32s  # wider cells
    neighbor_weight: Array32
    near_stats: Int32s  # (cells, 4) wider cells around each cell's middle
    near_weight: Array32  # (cells, 4) of each: bilinear
    front: np.float32
    visible: np.float32
    blocks: Int32s  # (cells,) the block of the sphere that each lies in, for scores


class Scratch(NamedTuple):
    """Arrays that one thread needs to render."""

    nodes: Int32s
    directions: Array32  # (3, N)
    cells: Int32s
    ranges: Array32
    turns: Array32


@dataclass(frozen=True)
class ViewConfig:
    """Settings of a view: its cells, the neighbourhood that normalises colours, the voxels' angular size."""

    num_rings: int
    stats_rings: int  # cells of these rings carry the local statistics: no wider than sigma
    sigma_deg: float
    voxel_per_range: float  # largest voxel size by its distance
    front: float = 1.15  # a cell's colour is the mean of points up to this times its nearest range
    visible: float = float(VISIBLE_FACTOR)  # a point is seen up to this times it and VISIBLE_OFFSET
    draws_edges: bool = False  # in place of colours, by the ranges of the view

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
    """Write the cell and the range [m] of each position relative to the centre; `turns` is scratch."""
    num_rings = np.float32(len(num_columns))
    per_pi = np.float32(len(num_columns) / math.pi)
    per_turn = np.float32(0.5 / math.pi)
    # Two loops: the arithmetic is vectorised, the look-ups that follow can't be.
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
    x = s.directions[0, :n]  # a row each: of a cut of all three, the stride is unknown to the compiler
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
    """Write (cells, 8): sums of x, y, z, r, g, b, and the count, of each cell's nearest nodes; and its range.

    Positions are relative to the centre [m], colours in [0, 1]. Nearest nodes are those up to `view.front`
    times the range [m] of the very nearest. Cells of which a part lies outside of the cone may miss some.
    All nodes stay in the scratch; their number is returned.
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
    """Write relative positions, opponent channels and weights of the cells shown; add up their moments."""
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
    """Write the local means of the channels and 1 / deviations (6, cells) around cells of positive weight.

    Taken at the wider cells that hold the moments, and interpolated between these.
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
            for k in range(8):  # two of them 0, as above; and stored apart, or each is read for itself
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
    """Write position, opponent channels, weight and local statistics of each cell shown, from its sums."""
    moments = np.empty((view.num_stats, 8), np.float32)
    average_colors(sums, view, shown, offsets, channels, weights, moments)
    cell_statistics(moments, view, weights, stats)


@kernel
def normalize_cells(
    sums: Array32, view: ViewArrays, shown: Mask, offsets: Array32, channels: Array32, weights: Array32
) -> None:
    """Write position, locally normalised channels and weight of each cell shown, from its sums."""
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
    """Write ranges [m] of the nearest nodes in the cells (n, cells) around each centre (n, 3), 0 for none."""
    for k in range(len(centers)):
        n = locate_nodes(tree, centers[k], voxel_per_range, view, EVERYWHERE, scratch)
        ranges[k] = F0
        for i in range(n):
            cell = scratch.cells[i]
            if ranges[k, cell] == F0 or scratch.ranges[i] < ranges[k, cell]:
                ranges[k, cell] = scratch.ranges[i]


_local = threading.local()


def thread_scratch() -> Scratch:
    """Return the calling thread's own scratch, for the largest view: fresh memory costs as much as a view."""
    if not hasattr(_local, "scratch"):
        nodes, cells = np.empty((2, MAX_NODES), np.int32)
        floats = np.empty((5, MAX_NODES), np.float32)
        _local.scratch = Scratch(nodes, floats[:3], cells, floats[3], floats[4])
    scratch: Scratch = _local.scratch
    return scratch


def average_view(octree: Octree, center_map: Center, config: ViewConfig, cone: Cone = EVERYWHERE) -> Array32:
    """Render a view from a centre (3,) [m]; return its sums (cells, 8) as `average_nodes` writes them.

    Only the cells in a cone, in the map's frame, are needed.
    """
    sums = np.empty((len(make_grid(config.num_rings)), 8), np.float32)
    center = np.asarray(center_map, np.float64)
    average_nodes(octree, center, config.voxel_per_range, config.arrays, cone, thread_scratch(), sums)
    if config.draws_edges:
        replace_by_edges(sums, config.num_rings)
    return sums


def empty_cells(n: int, center_map: Center) -> Cells:
    """Return arrays, not filled, for `n` cells or points around a centre (3,) [m]."""
    offsets, channels = np.empty((2, 3, n), np.float32)
    return Cells(offsets, channels, np.empty(n, np.float32), np.asarray(center_map, np.float64))


def normalize_view(sums: Array32, center_map: Center, config: ViewConfig, shown: Mask) -> Cells:
    """Normalise a view from a centre (3,) [m], given its sums (N, 8); cells not shown (N,) weigh 0."""
    cells = empty_cells(len(sums), center_map)
    normalize_cells(sums, config.arrays, shown, *cells[:3])
    return cells


def ranges_around(octree: Octree, centers_map: Floats, config: ViewConfig) -> Array32:
    """Return the range [m] of the nearest node in each cell around each centre: (n, cells), 0 for none."""
    ranges = np.empty((len(centers_map), len(make_grid(config.num_rings))), np.float32)
    centers_map = np.ascontiguousarray(centers_map)  # one kernel for all
    nearest_node_ranges(octree, centers_map, config.voxel_per_range, config.arrays, thread_scratch(), ranges)
    return ranges
