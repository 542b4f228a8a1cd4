"""The points that a camera sees around it, as fine as its pixels, for the last descents.

Views are rendered from places on a fine grid, and the last few are kept: poses near each other share them.
"""

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from ..cloud.octree import Octree, collect
from ..geometry.cone import EVERYWHERE, Cone
from ..geometry.points import PackedPoints, pack_points
from ..geometry.pose import Pose
from ..photo.panorama.local_normalization import opponent, zscore
from ..system.arrays import Array32, Int32s, Mask
from ..system.kernels.jit import F0, F1, HALF, inline_kernel, kernel
from .view import (
    Cells,
    Center,
    Scratch,
    ViewArrays,
    ViewConfig,
    average_nodes,
    average_view,
    describe_cells,
    empty_cells,
    locate,
    thread_scratch,
)
from .zbuffer import VISIBLE_OFFSET

LOW_32 = np.uint64(0xFFFFFFFF)
FILLED = 0.97  # of the room for points, in the mean: their number is random
PLACE_SPACING = 0.01  # [m] between the places from which views are rendered
NUM_KEPT_VIEWS = 32  # views that are kept, 12 MB
NUM_POINT_SETS = 8  # sets of visible points that are kept, 7 MB
NUM_SURROUNDINGS = 2  # sets of points in all directions that are kept, 11 MB

Place = tuple[float, float, float]  # [m] in the map


@inline_kernel
def node_fraction(node: int) -> np.float32:
    """Return a number in [0, 1) that looks random: a hash of a node's index (lowbias32, Wellons 2018)."""
    h = np.uint64(node)
    h = ((h ^ (h >> np.uint64(16))) * np.uint64(0x7FEB352D)) & LOW_32
    h = ((h ^ (h >> np.uint64(15))) * np.uint64(0x846CA68B)) & LOW_32
    return np.float32(h ^ (h >> np.uint64(16))) * np.float32(2.0**-32)


@inline_kernel
def keep_visible(
    tree: Octree, nodes: Int32s, cells: Int32s, ranges: Array32, limits: Array32
) -> tuple[int, int]:
    """Move the visible nodes to the front of `nodes`; return their number, and that of their children.

    A node is visible up to the range [m] in column 7 of `limits` (cells, 8). A node without children counts
    as its own child.
    """
    count = num_children = 0
    for i in range(len(cells)):
        if ranges[i] <= limits[cells[i], 7]:
            node = nodes[i]
            nodes[count] = node
            count += 1
            num_children += max(tree.first_child[node + 1] - tree.first_child[node], 1)
    return count, num_children


@inline_kernel
def take_children(tree: Octree, nodes: Int32s, kept: np.float32, found: Int32s) -> int:
    """Write a sample of the nodes' children, each with the probability `kept`; return their number.

    A node without children counts as its own child. A hash of its index decides whether a child is kept, so
    that nearby cameras get nearly the same points: a descent that starts again where it ended stays there.
    """
    count = 0
    for i in range(len(nodes)):
        first = tree.first_child[nodes[i]]
        last = tree.first_child[nodes[i] + 1]
        if first == last:
            first = nodes[i]
            last = first + 1
        for child in range(first, last):
            if node_fraction(child) < kept and count < len(found):
                found[count] = child
                count += 1
    return count


@kernel
def sample_visible(
    tree: Octree,
    voxel_per_range: float,
    view: ViewArrays,
    shown: Mask,
    cone: Cone,
    scratch: Scratch,
    sample: Cells,
) -> int:
    """Write a sample of the visible points in the cells of a mask (cells,); return their number.

    The mask's cells lie in the cone, in the map's frame. There are no more points than the arrays hold.
    Offsets and channels are as in `normalize_cells`, weights are 1. Occlusion and local statistics are
    computed from voxels twice as large.
    """
    offsets, channels, weights, center = sample
    s = scratch
    num_cells = len(view.solid_angle)
    sums = np.empty((num_cells, 8), np.float32)
    stats = np.empty((6, num_cells), np.float32)
    cell_offsets = np.empty((3, num_cells), np.float32)
    cell_channels = np.empty((3, num_cells), np.float32)
    cell_weights = np.empty(num_cells, np.float32)
    n = average_nodes(tree, center, 2.0 * voxel_per_range, view, cone, scratch, sums)
    describe_cells(sums, view, shown, cell_offsets, cell_channels, cell_weights, stats)
    for c in range(num_cells):  # the range up to which points are visible; 0 in other cells
        sums[c, 7] = sums[c, 7] * view.visible + VISIBLE_OFFSET if cell_weights[c] > F0 else F0
    n, num_visible = keep_visible(tree, s.nodes, s.cells[:n], s.ranges, sums)
    kept = np.float32(FILLED * len(weights) / max(num_visible, 1))
    found = np.empty(len(weights), np.int32)
    n = take_children(tree, s.nodes[:n], kept, found)
    for i in range(n):
        for k in range(3):
            offsets[k, i] = tree.nodes[found[i], k] - np.float32(center[k])
    cells = np.empty(n, np.int32)
    ranges = np.empty(n, np.float32)
    turns = np.empty(n, np.float32)
    x = offsets[0, :n]
    y = offsets[1, :n]
    z = offsets[2, :n]
    locate(x, y, z, view.num_columns, view.first, cells, ranges, turns)
    count = 0
    for i in range(n):
        c = cells[i]
        if ranges[i] <= sums[c, 7]:
            node = tree.nodes[found[i]]
            colors = opponent(node[3], node[4], node[5])
            for k in range(3):
                offsets[k, count] = offsets[k, i]
                channels[k, count] = zscore(colors[k], stats[k, c], stats[3 + k, c])
            weights[count] = F1
            count += 1
    return count


def sample_visible_points(
    octree: Octree, center_map: Center, config: ViewConfig, shown: bytes, cone: Cone, count: int
) -> Cells:
    """Return at most `count` points that are visible from a centre (3,) [m], with equal weights.

    `shown` has a byte for each cell of `config`: 1 if points in it are wanted, else 0. The wanted cells lie
    in the cone, in the map's frame.
    """
    sample = empty_cells(count, center_map)
    is_shown = np.frombuffer(shown, np.bool_)
    scratch = thread_scratch()
    n = sample_visible(octree, config.voxel_per_range, config.arrays, is_shown, cone, scratch, sample)
    offsets, channels, weights = (values[..., :n].copy() for values in sample[:3])
    return Cells(offsets, channels, weights, sample.center_map)


def points_around(octree: Octree, center_map: Center, voxel_per_range: float) -> PackedPoints:
    """Return the scan in all directions from a centre (3,) [m], hidden or not, as coloured points.

    They are voxels at most `voxel_per_range` times their distance wide: some hundred thousand points, however
    large the scan.
    """
    scratch = thread_scratch()
    center = np.asarray(center_map, np.float64)
    n = collect(octree, center, voxel_per_range, EVERYWHERE, scratch.nodes, scratch.directions)
    nodes = octree.nodes[scratch.nodes[:n]]
    # rounded so that half a level goes up
    return pack_points(nodes[:, :3], (nodes[:, 3:] * np.float32(255.0) + HALF).astype(np.uint8))


class RecentViews:
    """Views of one scan; the last few are kept, others are rendered. Threads may share this."""

    def __init__(self, octree: Octree, averaged: Octree | None = None) -> None:
        """Take the octree that is rendered, and optionally another one for `averages`."""
        self.averages: Callable[[Place, ViewConfig, Cone], Array32] = lru_cache(NUM_KEPT_VIEWS)(
            partial(average_view, averaged or octree)
        )
        self.points: Callable[[Place, ViewConfig, bytes, Cone, int], Cells] = lru_cache(NUM_POINT_SETS)(
            partial(sample_visible_points, octree)
        )
        self.surroundings: Callable[[Place, float], PackedPoints] = lru_cache(NUM_SURROUNDINGS)(
            partial(points_around, octree)
        )


def round_position(pose: Pose) -> Place:
    """Return the place on the grid [m] that is nearest to a pose's centre, in the map."""
    x, y, z = (round(float(value) / PLACE_SPACING) * PLACE_SPACING for value in pose.center_world)
    return x, y, z
