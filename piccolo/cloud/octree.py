"""The octree of a cloud: a pyramid of its voxels, in Morton order, and what of it a view needs."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import F0, inline_kernel, kernel
from ..runtime.memory import check_memory
from .voxels import LEAF_SIZE, NUM_LEVELS, THIN, Voxels

NODE_BYTES = 6 * 4 + 8 + 4  # mean, code, first child
MAX_NODES = 1 << 22  # that a view collects; reserved, but used only as far as a dense cloud fills it


class Octree(NamedTuple):
    """Nodes of all levels, coarsest first, in Morton order within a level; kernels read it as it is."""

    nodes: NDArray[np.float32]  # (nodes, 6) mean x, y, z [m], r, g, b in [0, 1]
    first_child: NDArray[np.int32]  # (nodes + 1,) children of i are first_child[i]:first_child[i + 1]
    level_start: NDArray[np.int32]  # (levels + 1,)
    leaf_size: float  # [m]

    def level(self, size: float) -> NDArray[np.float32]:
        """The nodes of the level whose voxels are nearest to `size` [m]."""
        level = NUM_LEVELS - 1 - int(np.clip(np.rint(np.log2(size / self.leaf_size)), 0, NUM_LEVELS - 1))
        return self.nodes[self.level_start[level] : self.level_start[level + 1]]


def build_octree(voxels: Voxels) -> Octree:
    """The octree whose leaves are the voxels."""
    nodes, node_codes = voxels.nodes, voxels.codes
    levels, children = [nodes], [np.zeros(len(nodes), np.int32)]
    for _ in range(NUM_LEVELS - 1):
        check_memory(2 * len(nodes) * NODE_BYTES, f"the scan: a level of {len(nodes)} voxels", THIN)
        first = np.flatnonzero(np.diff(node_codes >> 3, prepend=-1))  # children of a parent follow each other
        counts = np.diff(first, append=len(nodes))
        columns = [np.add.reduceat(column, first, dtype=np.float64) / counts for column in nodes.T]
        nodes, node_codes = np.stack(columns, axis=1, dtype=np.float32), node_codes[first] >> 3
        levels.insert(0, nodes)
        children.insert(0, first.astype(np.int32))
    num_nodes = sum(map(len, levels))
    check_memory(num_nodes * NODE_BYTES, f"the scan: a tree of {num_nodes} voxels", THIN)
    start = np.concatenate([[0], np.cumsum([len(level) for level in levels])]).astype(np.int32)
    first_child = [c + s for c, s in zip(children[:-1], start[1:-1], strict=True)]
    first_child.append(np.full(len(levels[-1]) + 1, start[-1], np.int32))  # leaves have none
    return Octree(np.concatenate(levels), np.concatenate(first_child).astype(np.int32), start, LEAF_SIZE)


@kernel
def collect(tree, center, voxel_per_range, found, directions):
    """Write the nodes that, seen from `center`, are as small as asked, or leaves; returns how many.

    `directions` (3, N) get the positions relative to the centre [m].
    """
    nodes, first_child = tree.nodes, tree.first_child
    num_levels = len(tree.level_start) - 1
    stack = np.empty(8 * num_levels, np.int32)
    levels = np.empty(8 * num_levels, np.int32)
    cx, cy, cz = np.float32(center[0]), np.float32(center[1]), np.float32(center[2])
    per2 = np.float32(1.0 / (voxel_per_range * voxel_per_range))
    min_d2 = np.empty(num_levels, np.float32)
    for level in range(num_levels):
        size = np.float32(tree.leaf_size * 2.0 ** (num_levels - 1 - level))
        min_d2[level] = size * size * per2
    min_d2[num_levels - 1] = F0
    count = 0
    for root in range(tree.level_start[1]):
        stack[0] = root
        levels[0] = 0
        top = 1
        while top > 0:
            top -= 1
            node = stack[top]
            level = levels[top]
            dx, dy, dz = nodes[node, 0] - cx, nodes[node, 1] - cy, nodes[node, 2] - cz
            if dx * dx + dy * dy + dz * dz >= min_d2[level]:
                if count < len(found):
                    found[count] = node
                    directions[0, count], directions[1, count], directions[2, count] = dx, dy, dz
                    count += 1
            else:
                for child in range(first_child[node], first_child[node + 1]):
                    stack[top] = child
                    levels[top] = level + 1
                    top += 1
    return count


@inline_kernel
def level_of(tree, node):
    """The level of a node, 0 for the coarsest voxels."""
    level = 0
    while node >= tree.level_start[level + 1]:
        level += 1
    return level
