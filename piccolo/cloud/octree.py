"""The cloud as a pyramid of voxels: mean position and mean colour of each, children next to each other."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel
from ..runtime.memory import check_memory
from .voxels import COARSEST, LEAF_SIZE, THIN, Voxels

NODE_BYTES = 6 * 4 + 8 + 4  # mean, code, first child
NUM_LEVELS = COARSEST.bit_length()  # from 128 leaves wide (2.56 m) down to one


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


@kernel
def average_children(child_nodes, child_codes, nodes, codes, first_child):
    """Write the mean of the children of each parent voxel and where they begin. Returns how many parents."""
    count = 0
    n, sums = len(child_codes), np.zeros(6)
    lo = 0
    while lo < n:
        hi = lo
        code = child_codes[lo] >> 3
        sums[:] = 0.0
        while hi < n and (child_codes[hi] >> 3) == code:
            for k in range(6):
                sums[k] += child_nodes[hi, k]
            hi += 1
        per = 1.0 / (hi - lo)
        for k in range(6):
            nodes[count, k] = sums[k] * per
        codes[count] = code
        first_child[count] = lo
        count += 1
        lo = hi
    return count


def build_octree(voxels: Voxels) -> Octree:
    """The octree whose leaves are the voxels."""
    nodes, node_codes = voxels.nodes, voxels.codes
    levels, children = [nodes], [np.zeros(len(nodes), np.int32)]
    for _ in range(NUM_LEVELS - 1):
        check_memory(2 * len(nodes) * NODE_BYTES, f"the scan: a level of {len(nodes)} voxels", THIN)
        parents, parent_codes = np.empty_like(nodes), np.empty_like(node_codes)
        first = np.empty(len(nodes), np.int32)
        count = average_children(nodes, node_codes, parents, parent_codes, first)
        nodes, node_codes = parents[:count].copy(), parent_codes[:count].copy()
        levels.insert(0, nodes)
        children.insert(0, first[:count].copy())
    num_nodes = sum(map(len, levels))
    check_memory(num_nodes * NODE_BYTES, f"the scan: a tree of {num_nodes} voxels", THIN)
    start = np.concatenate([[0], np.cumsum([len(level) for level in levels])]).astype(np.int32)
    first_child = np.concatenate([c + s for c, s in zip(children[:-1], start[1:-1], strict=True)])
    leaves = np.full(len(levels[-1]) + 1, start[-1], np.int32)
    return Octree(
        np.concatenate(levels), np.concatenate([first_child, leaves]).astype(np.int32), start, LEAF_SIZE
    )
