"""The points that a camera sees around it, as fine as it can tell them apart: for the last millimetres."""

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree, collect
from ..cloud.soa import PackedPoints
from ..kernels.jit import F0, F1, HALF, inline_kernel, kernel
from ..panorama.local_normalization import opponent, zscore
from .cells import locate
from .view import Cells, Center, ViewConfig, average_nodes, describe_cells, empty_cells, thread_scratch

VISIBLE_OFFSET = np.float32(0.1)  # [m] of range noise
U15, U16, LOW_32 = np.uint64(15), np.uint64(16), np.uint64(0xFFFFFFFF)
MIX_1, MIX_2 = np.uint64(0x7FEB352D), np.uint64(0x846CA68B)
OPAQUE = np.int32(1 << 24)  # the fourth of a packed point's bytes
FILLED = 0.97  # of the room for points; the rest is for chance


@inline_kernel
def node_fraction(node):
    """A number in [0, 1) that is drawn from a node's index, always the same (lowbias32, Wellons 2018)."""
    h = np.uint64(node)
    h = ((h ^ (h >> U16)) * MIX_1) & LOW_32
    h = ((h ^ (h >> U15)) * MIX_2) & LOW_32
    return np.float32(h ^ (h >> U16)) * np.float32(2.0**-32)


@inline_kernel
def keep_visible(tree, nodes, cells, ranges, limits):
    """Put the visible ones of some nodes first. Returns how many these are, and their children."""
    count = num_children = 0
    for i in range(len(cells)):
        if ranges[i] <= limits[cells[i], 7]:
            node = nodes[i]
            nodes[count] = node
            count += 1
            num_children += max(tree.first_child[node + 1] - tree.first_child[node], 1)
    return count, num_children


@inline_kernel
def take_children(tree, nodes, kept, found):
    """Write the children of some nodes, or those without any, each with the probability `kept`; how many.

    Each is kept or left out by its own number, so that a camera a little farther on sees nearly the same
    points: a descent that is begun again from where it ended then ends there.
    """
    count = 0
    for i in range(len(nodes)):
        node = nodes[i]
        first, last = tree.first_child[node], tree.first_child[node + 1]
        if first == last:
            first, last = node, node + 1
        for child in range(first, last):
            if node_fraction(child) < kept and count < len(found):
                found[count] = child
                count += 1
    return count


@kernel
def render_points(tree, center, voxel_per_range, view, scratch, shown, offsets, channels, weights):
    """The visible points in cells that are shown, thinned to what fits: as `normalize_cells`, with weight 1.

    Voxels twice as large tell what is in front, and how colours vary. Returns how many.
    """
    num_cells, s = len(view.solid_angle), scratch
    sums, stats = np.empty((num_cells, 8), np.float32), np.empty((6, num_cells), np.float32)
    cell_offsets, cell_channels = np.empty((3, num_cells), np.float32), np.empty((3, num_cells), np.float32)
    cell_weights = np.empty(num_cells, np.float32)
    n = average_nodes(tree, center, 2.0 * voxel_per_range, view, scratch, sums)
    describe_cells(sums, view, shown, cell_offsets, cell_channels, cell_weights, stats)
    for c in range(num_cells):  # how far what is seen reaches; nothing of cells that are not shown
        sums[c, 7] = sums[c, 7] * view.visible + VISIBLE_OFFSET if cell_weights[c] > F0 else F0
    n, num_visible = keep_visible(tree, s.nodes, s.cells[:n], s.ranges, sums)
    kept = np.float32(FILLED * len(weights) / max(num_visible, 1))
    found = np.empty(len(weights), np.int32)
    n = take_children(tree, s.nodes[:n], kept, found)
    for i in range(n):
        for k in range(3):
            offsets[k, i] = tree.nodes[found[i], k] - np.float32(center[k])
    cells, ranges, turns = np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32)
    x, y, z = offsets[0, :n], offsets[1, :n], offsets[2, :n]
    locate(x, y, z, view.num_columns, view.first, cells, ranges, turns)
    count = 0
    for i in range(n):
        node, c = found[i], cells[i]
        if ranges[i] <= sums[c, 7]:
            colors = opponent(tree.nodes[node, 3], tree.nodes[node, 4], tree.nodes[node, 5])
            for k in range(3):
                offsets[k, count] = offsets[k, i]
                channels[k, count] = zscore(colors[k], stats[k, c], stats[3 + k, c])
            weights[count] = F1
            count += 1
    return count


def visible_points(
    octree: Octree, center_map: Center, config: ViewConfig, shown: NDArray[np.bool_], count: int
) -> Cells:
    """What is seen around a centre (3,) [m], as at most `count` points with equal weights, not as cells."""
    *found, center = empty_cells(count, center_map)
    how = config.voxel_per_range, config.arrays, thread_scratch(), shown
    n = render_points(octree, center, *how, *found)
    offsets, channels, weights = (values[..., :n].copy() for values in found)
    return Cells(offsets, channels, weights, center)


@inline_kernel
def in_8_bits(color, shift):
    """A colour in [0, 1], rounded, at its place among 32 bits."""
    return np.int32(np.int32(color * np.float32(255.0) + HALF) << np.int32(shift))


@kernel
def pack_nodes(nodes, found, x, y, z, rgbx):
    """Write the positions of some nodes and their colours in 8 bits."""
    for i in range(len(found)):
        node = nodes[found[i]]
        x[i], y[i], z[i] = node[0], node[1], node[2]
        rgbx[i] = np.int32(in_8_bits(node[3], 0) | in_8_bits(node[4], 8) | in_8_bits(node[5], 16) | OPAQUE)


def points_around(octree: Octree, center_map: NDArray[np.float64], voxel_per_range: float) -> PackedPoints:
    """All nodes as coloured points, those far from a centre (3,) [m] as large as it is far to them.

    Of however large a scan, some hundred thousand.
    """
    scratch, center = thread_scratch(), np.asarray(center_map, np.float64)
    n = collect(octree, center, voxel_per_range, scratch.nodes, scratch.directions)
    x, y, z = np.empty((3, n), np.float32)
    points = PackedPoints(x, y, z, np.empty(n, np.int32))
    pack_nodes(octree.nodes, scratch.nodes[:n], points.x, points.y, points.z, points.rgbx)
    return points
