"""The cloud seen from a position: z-buffered cells of the sphere, from voxels as fine as the cells ask."""

import math
import threading
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree
from ..geometry.sphere_grid import cell_of, make_neighbors, make_tiling
from ..panorama.channels import LEVELS_PER_UNIT, opponent, standardized
from ..runtime.jit import F0, F1, HALF, kernel
from .cells import average_cells, average_colors, collect, local_statistics, locate

VISIBLE_OFFSET = np.float32(0.1)  # [m] of range noise


Kind = tuple[Any, ...]  # what ViewKind.arrays gives; kernels read it by position
Cells = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class ViewKind:
    """How a view is made: its cells, the neighbourhood that normalises colours, the voxels' angular size."""

    num_rings: int
    stats_rings: int  # cells of these rings carry the local statistics: no wider than sigma
    sigma_deg: float
    voxel_per_range: float  # largest voxel size by its distance
    front: float = 1.15  # a cell's colour is the mean of points up to this times its nearest range
    visible: float = 1.08  # a point is seen up to this times (and VISIBLE_OFFSET): grazing floors pass

    @cached_property
    def arrays(self) -> Kind:
        """What the kernels read."""
        tiling = make_tiling(self.num_rings)
        neighbors = make_neighbors(self.num_rings, self.stats_rings, self.sigma_deg)
        return (
            tiling.num_columns,
            tiling.first,
            cell_of(tiling.directions, self.stats_rings),
            len(make_tiling(self.stats_rings)),
            tiling.solid_angle,
            neighbors.row,
            neighbors.cell,
            neighbors.weight,
            np.float32(self.front),
            np.float32(self.visible),
        )


@kernel
def render_cells(tree, center, voxel_per_range, kind, scratch, offsets, features, weights, sums, stats):
    """One view: relative position, opponent channels, their local statistics and weight of each cell."""
    found, directions, cells, ranges, turns = scratch
    n = collect(tree[0], tree[1], tree[2], tree[3], center, voxel_per_range, found, directions)
    locate(
        directions[0, :n],
        directions[1, :n],
        directions[2, :n],
        kind[0],
        kind[1],
        cells[:n],
        ranges[:n],
        turns,
    )
    average_cells(tree[0], found, directions, cells[:n], ranges, kind[8], sums)
    moments = np.empty((kind[3], 8), np.float32)
    average_colors(sums, kind, offsets, features, weights, moments)
    local_statistics(moments, kind, weights, stats)
    return n


@kernel
def render(tree, center, voxel_per_range, kind, scratch, offsets, features, weights):
    """One view: position relative to the centre, normalised channels and weight of each cell."""
    sums = np.empty((len(weights), 8), np.float32)
    stats = np.empty((6, len(weights)), np.float32)
    render_cells(tree, center, voxel_per_range, kind, scratch, offsets, features, weights, sums, stats)
    for k in range(3):
        for c in range(len(weights)):
            if weights[c] > F0:
                features[k, c] = standardized(features[k, c], stats[k, c], stats[3 + k, c])


@kernel
def render_block(tree, centers, voxel_per_range, kind, scratch, offsets, unit, levels, is_seen):
    """Views from several centres in few bits: offsets in units of their own, channels in levels."""
    n = len(kind[4])
    points, features, weights = (
        np.empty((3, n), np.float32),
        np.empty((3, n), np.float32),
        np.empty(n, np.float32),
    )
    for k in range(len(centers)):
        render(tree, centers[k], voxel_per_range, kind, scratch, points, features, weights)
        largest = np.float32(1e-3)
        for i in range(3):
            for c in range(n):
                largest = max(largest, abs(points[i, c]))
        unit[k] = largest / np.float32(32767)
        for i in range(3):
            for c in range(n):
                offsets[k, i, c] = np.int16(points[i, c] / unit[k])
                level = features[i, c] * np.float32(LEVELS_PER_UNIT)
                levels[k, i, c] = np.int8(
                    min(max(math.floor(level + HALF), np.float32(-127)), np.float32(127))
                )
        for c in range(n):
            is_seen[k, c] = weights[c] > F0


@kernel
def render_points(tree, center, voxel_per_range, kind, scratch, offsets, features, weights):
    """The visible points, evenly thinned to what fits: relative position, normalised channels, weight 1.

    Returns how many.
    """
    num_cells = len(kind[4])
    sums, stats = np.empty((num_cells, 8), np.float32), np.empty((6, num_cells), np.float32)
    cell_offsets, cell_features = np.empty((3, num_cells), np.float32), np.empty((3, num_cells), np.float32)
    cell_weights = np.empty(num_cells, np.float32)
    n = render_cells(
        tree, center, voxel_per_range, kind, scratch, cell_offsets, cell_features, cell_weights, sums, stats
    )
    found, directions, cells, ranges, _ = scratch
    visible = 0
    for i in range(n):
        if ranges[i] <= sums[cells[i], 7] * kind[9] + VISIBLE_OFFSET:
            visible += 1
    stride = (visible + len(weights) - 1) // len(weights)
    count = seen = 0
    for i in range(n):
        if ranges[i] <= sums[cells[i], 7] * kind[9] + VISIBLE_OFFSET:
            seen += 1
            if seen % stride == 0:
                node, c = found[i], cells[i]
                channels = opponent(tree[0][node, 3], tree[0][node, 4], tree[0][node, 5])
                for k in range(3):
                    offsets[k, count] = directions[k, i]
                    features[k, count] = standardized(channels[k], stats[k, c], stats[3 + k, c])
                weights[count] = F1
                count += 1
    return count


@kernel
def filled_shares(tree, centers, voxel_per_range, kind, scratch, share):
    """Write the share of the sphere (n,) around each centre (n, 3) whose cells hold any node."""
    found, directions, cells, ranges, turns = scratch
    is_filled = np.empty(len(kind[4]), np.bool_)
    for k in range(len(centers)):
        n = collect(tree[0], tree[1], tree[2], tree[3], centers[k], voxel_per_range, found, directions)
        locate(
            directions[0, :n],
            directions[1, :n],
            directions[2, :n],
            kind[0],
            kind[1],
            cells[:n],
            ranges[:n],
            turns,
        )
        is_filled[:] = False
        for i in range(n):
            is_filled[cells[i]] = True
        share[k] = F0
        for c in range(len(is_filled)):
            if is_filled[c]:
                share[k] += kind[4][c]


MAX_NODES = 1 << 22  # of a view; reserved, but used only as far as a dense cloud fills it


def make_scratch() -> tuple[Any, ...]:
    """Arrays that one thread needs to render."""
    return (
        np.empty(MAX_NODES, np.int32), np.empty((3, MAX_NODES), np.float32),
        np.empty(MAX_NODES, np.int32), np.empty(MAX_NODES, np.float32), np.empty(MAX_NODES, np.float32),
    )  # fmt: skip


_local = threading.local()


def thread_scratch() -> Any:
    """The calling thread's own scratch: fresh memory costs as much as a view."""
    if not hasattr(_local, "scratch"):
        _local.scratch = make_scratch()
    return _local.scratch


def render_view(octree: Octree, center_world: NDArray[np.float64], kind: ViewKind) -> Cells:
    """Offsets from the centre (3, cells) [m], channels (3, cells), weights (cells,), 0 where unseen."""
    n = len(make_tiling(kind.num_rings))
    view = np.empty((3, n), np.float32), np.empty((3, n), np.float32), np.empty(n, np.float32)
    center = np.asarray(center_world, np.float64)
    render(octree.arrays(), center, kind.voxel_per_range, kind.arrays, thread_scratch(), *view)
    return view


def seen_points(octree: Octree, center_world: NDArray[np.float64], kind: ViewKind, max_points: int) -> Cells:
    """The same of at most `max_points` visible points instead of cells, with equal weights."""
    n = max_points
    points = np.empty((3, n), np.float32), np.empty((3, n), np.float32), np.empty(n, np.float32)
    center = np.asarray(center_world, np.float64)
    count = render_points(
        octree.arrays(), center, kind.voxel_per_range, kind.arrays, thread_scratch(), *points
    )
    return points[0][:, :count].copy(), points[1][:, :count].copy(), points[2][:count].copy()
