"""The cloud as a pyramid of voxels: mean position and mean colour of each, children next to each other."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud.order import spread_bits
from ..jit import kernel

NUM_LEVELS = 8  # from 128 leaves wide (2.56 m) down to one
QUANTUM = 2.0**-14  # [m] positions are summed as integers: no order of the points changes a bit


@dataclass(frozen=True)
class Octree:
    """Nodes of all levels, coarsest first, in Morton order within a level."""

    nodes: NDArray[np.float32]  # (nodes, 6) mean x, y, z [m], r, g, b in [0, 1]
    first_child: NDArray[np.int32]  # (nodes + 1,) children of i are first_child[i]:first_child[i + 1]
    level_start: NDArray[np.int32]  # (levels + 1,)
    leaf_size: float  # [m]

    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32], float]:
        """What the kernels read."""
        return self.nodes, self.first_child, self.level_start, self.leaf_size

    def level(self, size: float) -> NDArray[np.float32]:
        """The nodes of the level whose voxels are nearest to `size` [m]."""
        level = NUM_LEVELS - 1 - int(np.clip(np.rint(np.log2(size / self.leaf_size)), 0, NUM_LEVELS - 1))
        return self.nodes[self.level_start[level] : self.level_start[level + 1]]


@kernel
def voxel_codes(xyz, origin, size, codes):
    """Write the Morton code of the voxel of each point (N, 3)."""
    for i in range(len(xyz)):
        a = spread_bits(np.int64((xyz[i, 0] - origin[0]) / size))
        b = spread_bits(np.int64((xyz[i, 1] - origin[1]) / size))
        c = spread_bits(np.int64((xyz[i, 2] - origin[2]) / size))
        codes[i] = a | (b << 1) | (c << 2)


@kernel
def average_points(xyz, rgb, order, codes, origin, nodes, node_codes):
    """Write the mean of the points of each voxel, return how many; `order` sorts the points by `codes`."""
    count = -1
    n = len(order)
    lo = 0
    while lo < n:
        hi = lo
        sx = sy = sz = np.int64(0)
        sr = sg = sb = np.int64(0)
        while hi < n and codes[hi] == codes[lo]:
            i = order[hi]
            sx += np.int64((xyz[i, 0] - origin[0]) / QUANTUM)
            sy += np.int64((xyz[i, 1] - origin[1]) / QUANTUM)
            sz += np.int64((xyz[i, 2] - origin[2]) / QUANTUM)
            sr += rgb[i, 0]
            sg += rgb[i, 1]
            sb += rgb[i, 2]
            hi += 1
        count += 1
        per = 1.0 / (hi - lo)
        nodes[count, 0] = origin[0] + sx * per * QUANTUM
        nodes[count, 1] = origin[1] + sy * per * QUANTUM
        nodes[count, 2] = origin[2] + sz * per * QUANTUM
        nodes[count, 3] = sr * per / 255.0
        nodes[count, 4] = sg * per / 255.0
        nodes[count, 5] = sb * per / 255.0
        node_codes[count] = codes[lo]
        lo = hi
    return count + 1


@kernel
def average_children(child_nodes, child_codes, nodes, codes, first_child):
    """Write the mean of the children of each parent voxel and where they begin. Returns how many parents."""
    count = 0
    n = len(child_codes)
    lo = 0
    while lo < n:
        hi = lo
        code = child_codes[lo] >> 3
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        while hi < n and (child_codes[hi] >> 3) == code:
            s0 += child_nodes[hi, 0]
            s1 += child_nodes[hi, 1]
            s2 += child_nodes[hi, 2]
            s3 += child_nodes[hi, 3]
            s4 += child_nodes[hi, 4]
            s5 += child_nodes[hi, 5]
            hi += 1
        per = 1.0 / (hi - lo)
        nodes[count, 0] = s0 * per
        nodes[count, 1] = s1 * per
        nodes[count, 2] = s2 * per
        nodes[count, 3] = s3 * per
        nodes[count, 4] = s4 * per
        nodes[count, 5] = s5 * per
        codes[count] = code
        first_child[count] = lo
        count += 1
        lo = hi
    return count


def build_octree(xyz: NDArray[np.float32], rgb: NDArray[np.uint8], leaf_size: float = 0.02) -> Octree:
    """Octree of finite points (N, 3) [m] with colours (N, 3); the order of the points changes no bit."""
    origin = np.floor(xyz.min(axis=0).astype(np.float64)) - 1.0
    codes = np.empty(len(xyz), np.int64)
    voxel_codes(xyz, origin, leaf_size, codes)
    order = np.argsort(codes)
    nodes, node_codes = np.empty((len(xyz), 6), np.float32), np.empty(len(xyz), np.int64)
    count = average_points(xyz, rgb, order, codes[order], origin, nodes, node_codes)
    nodes, node_codes = nodes[:count].copy(), node_codes[:count].copy()
    levels, children = [nodes], [np.zeros(len(nodes), np.int32)]
    for _ in range(NUM_LEVELS - 1):
        parents, parent_codes = np.empty_like(nodes), np.empty_like(node_codes)
        first = np.empty(len(nodes), np.int32)
        count = average_children(nodes, node_codes, parents, parent_codes, first)
        nodes, node_codes = parents[:count].copy(), parent_codes[:count].copy()
        levels.insert(0, nodes)
        children.insert(0, first[:count].copy())
    start = np.concatenate([[0], np.cumsum([len(level) for level in levels])]).astype(np.int32)
    first_child = np.concatenate([c + s for c, s in zip(children[:-1], start[1:-1], strict=True)])
    leaves = np.full(len(levels[-1]) + 1, start[-1], np.int32)
    return Octree(
        np.concatenate(levels), np.concatenate([first_child, leaves]).astype(np.int32), start, leaf_size
    )
