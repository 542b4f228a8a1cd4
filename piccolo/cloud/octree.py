"""The octree of a cloud: its voxels at several sizes, in Morton order, and the nodes that a view needs."""

import math
from typing import NamedTuple

import numpy as np

from ..geometry.cone import Cone, is_apart
from ..geometry.vectors import Triple
from ..system.arrays import Array, Array32, Int32s
from ..system.jobs.memory import check_memory
from ..system.kernels.jit import F0, Scalar, inline_kernel, kernel
from .voxels import LEAF_SIZE, NUM_LEVELS, THIN, VOXELS_AT_ONCE, Voxels

NODE_BYTES = 6 * 4 + 4  # mean, first child
LEVEL_BYTES = 8 + 1 + 8 + 4 + 8  # codes, flags of first children, their indices twice, their codes
MAX_NODES = 1 << 22  # nodes of a view, at most; memory is reserved, but used only as far as it is filled
RANGES_BELOW = 1 / 20  # [voxel per range] coarser views are rarely drawn at one level below a node
DIAGONAL = 1.75  # of a voxel of width 1, with room for rounding: all in it is nearer to its mean


class Octree(NamedTuple):
    """Nodes of all levels, coarsest first, in Morton order within a level; kernels take it as an argument."""

    nodes: Array32  # (nodes, 6) mean x, y, z [m], r, g, b in [0, 1]
    first_child: Int32s  # (nodes + 1,) the children of node i are first_child[i]:first_child[i + 1]
    level_start: Int32s  # (levels + 1,) index of each level's first node
    leaf_size: float  # [m] width of the finest voxels

    def level(self, size: float) -> Array32:
        """Return the nodes (N, 6) of the level whose voxels are nearest to `size` [m] in width."""
        finest = len(self.level_start) - 2
        level = finest - int(np.clip(np.rint(np.log2(size / self.leaf_size)), 0, finest))
        return self.nodes[self.level_start[level] : self.level_start[level + 1]]

    def without_leaves(self) -> "Octree":
        """Return the octree without its finest level: the parents of its leaves become the leaves."""
        end = self.level_start[-2]
        first_child = np.minimum(self.first_child[: end + 1], end)
        return Octree(self.nodes[:end], first_child, self.level_start[:-1], 2.0 * self.leaf_size)


def build_octree(voxels: Voxels) -> Octree:
    """Return the octree whose leaves are the voxels."""
    codes = voxels.codes
    firsts: list[Int32s] = []  # for each level but the finest, its nodes' first children
    for _ in range(NUM_LEVELS - 1):
        check_memory(len(codes) * LEVEL_BYTES, f"the scan: a level of {len(codes)} voxels", THIN)
        codes = codes >> 3  # the children of a parent are consecutive
        is_first = np.ones(len(codes), dtype=np.bool_)
        np.not_equal(codes[1:], codes[:-1], out=is_first[1:])
        first = np.flatnonzero(is_first)
        firsts.insert(0, first.astype(np.int32))
        codes = codes[first]
    start = np.cumsum([0, *map(len, firsts), len(voxels.nodes)], dtype=np.int32)
    num_nodes = int(start[-1])
    check_memory(num_nodes * NODE_BYTES, f"the scan: a tree of {num_nodes} voxels", THIN)
    nodes = np.empty((num_nodes, 6), np.float32)
    nodes[start[-2] :] = voxels.nodes
    first_child = np.full(num_nodes + 1, num_nodes, np.int32)  # leaves have none
    for level in reversed(range(NUM_LEVELS - 1)):
        begin, end = start[level : level + 2]
        average_children(nodes[end : start[level + 2]], firsts[level], nodes[begin:end])
        np.add(firsts[level], end, out=first_child[begin:end])
    return Octree(nodes, first_child, start, LEAF_SIZE)


def average_children(children: Array32, first: Int32s, parents: Array32) -> None:
    """Write the means `parents` (M, 6) of the children (N, 6) that begin at the rows `first` (M,)."""
    for begin in range(0, len(first), VOXELS_AT_ONCE):
        part = slice(begin, begin + VOXELS_AT_ONCE)
        last = first[begin + VOXELS_AT_ONCE] if begin + VOXELS_AT_ONCE < len(first) else len(children)
        own = children[first[begin] : last]
        places = first[part] - first[begin]
        counts = np.diff(places, append=len(own))
        for k, column in enumerate(own.T):
            parents[part, k] = np.add.reduceat(column, places, dtype=np.float64) / counts


def recolor(octree: Octree, colors: Array32, weights: Array32) -> Octree:
    """Return the octree with other colours of its leaves (leaves, 3), in [0, 1].

    Each colour has a weight (leaves,). A leaf of weight 0 gets the weighted mean colour of the smallest voxel
    around it that has a weight.
    """
    start = octree.level_start
    nodes = octree.nodes.copy()
    nodes[start[-2] :, 3:] = colors
    loads = np.zeros(len(nodes), np.float32)
    loads[start[-2] :] = weights
    levels = [slice(*start[k : k + 2]) for k in range(len(start) - 1)]
    firsts = [octree.first_child[own] - own.stop for own in levels[:-1]]
    for own, children, first in zip(levels[-2::-1], levels[:0:-1], firsts[::-1], strict=True):
        loads[own] = np.add.reduceat(loads[children], first)
        for k in range(3, 6):
            sums = np.add.reduceat(nodes[children, k] * loads[children], first, dtype=np.float64)
            nodes[own, k] = sums / np.maximum(loads[own], 1e-9)
    for own, children, first in zip(levels[:-1], levels[1:], firsts, strict=True):
        parents = np.repeat(nodes[own, 3:], np.diff(first, append=children.stop - children.start), axis=0)
        nodes[children, 3:] = np.where(loads[children, None] > 0.0, nodes[children, 3:], parents)
    for own, children, first in zip(levels[-2::-1], levels[:0:-1], firsts[::-1], strict=True):
        average_children(nodes[children], first, nodes[own])
    return octree._replace(nodes=nodes)


@inline_kernel
def uniform_level(least_distance: Array32, level: int, low: Scalar, high: Scalar) -> int:
    """Return the level at which all voxels below a node are drawn; 0 if they are not all drawn at one level.

    All of them are at distances [m] from `low` to `high`; `level` is that of the node's children.
    """
    k = level + 1
    while least_distance[k] > low and least_distance[k] > F0:
        k += 1
    return k if high < least_distance[k - 1] else 0


@inline_kernel
def take_all(
    nodes: Array32,
    first: int | np.int64,
    last: int | np.int64,
    center: Triple,
    found: Int32s,
    directions: Array32,
    count: int,
) -> None:
    """Write nodes from `first` to `last` and their positions [m] from the centre, from `count` on."""
    x, y, z = directions[0], directions[1], directions[2]
    for i in range(last - first):
        node = np.uintp(first + i)
        k = np.uintp(count + i)
        found[k] = node
        x[k] = nodes[node, 0] - center[0]
        y[k] = nodes[node, 1] - center[1]
        z[k] = nodes[node, 2] - center[2]


@inline_kernel
def take_far(
    nodes: Array32,
    first: int | np.int64,
    last: int | np.int64,
    center: Triple,
    least: Scalar,
    found: Int32s,
    directions: Array32,
    count: int,
    stack: Int32s,
    top: int,
) -> tuple[int, int]:
    """Write the nodes at a squared distance of at least `least` [m^2], as `take_all` does.

    The other nodes go on the stack, from `top` on. Return the new `count` and the new `top`.
    """
    x, y, z = directions[0], directions[1], directions[2]
    for node in range(first, last):
        i = np.uintp(node)
        k = np.uintp(count)
        dx, dy, dz = nodes[i, 0] - center[0], nodes[i, 1] - center[1], nodes[i, 2] - center[2]
        if dx * dx + dy * dy + dz * dz >= least:
            found[k] = node
            x[k] = dx
            y[k] = dy
            z[k] = dz
            count += 1
        else:
            stack[top] = node
            top += 1
    return count, top


@kernel
def collect(
    tree: Octree, center: Array, voxel_per_range: float, cone: Cone, found: Int32s, directions: Array32
) -> int:
    """Write the largest nodes that are small enough, seen from a centre, or leaves; return their number.

    A voxel is small enough if it is at most `voxel_per_range` times its distance wide. `found` (N,) gets the
    nodes, `directions` (3, N) their positions from the centre [m]. Most nodes outside of the cone, in the
    octree's frame, are left out; the order of the others is the same as without a cone. If all voxels below
    a node are drawn at one level, they are consecutive there: most are found so, without a test of each.
    """
    nodes = tree.nodes
    first_child = tree.first_child
    num_levels = len(tree.level_start) - 1
    num_roots = tree.level_start[1]
    room = num_roots + 8 * num_levels
    stack = np.empty(room, np.int32)
    levels = np.empty(room, np.int32)
    at = np.float32(center[0]), np.float32(center[1]), np.float32(center[2])
    least_distance = np.empty(num_levels, np.float32)
    diagonal = np.empty(num_levels, np.float32)
    for level in range(num_levels):
        size = tree.leaf_size * 2.0 ** (num_levels - 1 - level)
        least_distance[level] = size / voxel_per_range
        diagonal[level] = size * DIAGONAL
    least_distance[num_levels - 1] = F0
    sine = np.float32(math.sqrt(max(1.0 - cone.cos_angle**2, 0.0)))
    has_cone = cone.cos_angle >= -1.0
    least = least_distance[0] * least_distance[0]
    count, top = take_far(nodes, 0, min(num_roots, len(found)), at, least, found, directions, 0, stack, 0)
    levels[:top] = 0
    while top > 0:
        top -= 1
        node = stack[top]
        level = levels[top] + 1
        dx, dy, dz = nodes[node, 0] - at[0], nodes[node, 1] - at[1], nodes[node, 2] - at[2]
        if has_cone and is_apart(cone, sine, dx, dy, dz, diagonal[level - 1]):
            continue
        first = np.int64(first_child[node])
        last = np.int64(first_child[node + 1])
        is_uniform = level == num_levels - 1
        if voxel_per_range < RANGES_BELOW and level < num_levels - 2:
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            reach = diagonal[level - 1]
            uniform = uniform_level(least_distance, level, distance - reach, distance + reach)
            is_uniform = level < uniform
            while level < uniform:
                first = np.int64(first_child[first])
                last = np.int64(first_child[last])
                level += 1
        last = min(last, first + len(found) - count)
        if is_uniform:
            take_all(nodes, first, last, at, found, directions, count)
            count += int(last - first)
        else:
            least = least_distance[level] * least_distance[level]
            begin = top
            count, top = take_far(nodes, first, last, at, least, found, directions, count, stack, top)
            levels[begin:top] = level
    return count


@inline_kernel
def find_level(tree: Octree, node: int) -> int:
    """Return the level of a node; 0 is that of the coarsest voxels."""
    level = 0
    while node >= tree.level_start[level + 1]:
        level += 1
    return level
