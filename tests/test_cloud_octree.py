import numpy as np
import pytest

from piccolo.cloud import Cloud
from piccolo.cloud import octree as octree_module
from piccolo.cloud import voxels as voxels_module
from piccolo.cloud.octree import MAX_NODES, build_octree, collect
from piccolo.cloud.voxels import LEAF_SIZE, NUM_LEVELS


def _cloud(count=5000, seed=0):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(count, 3)) * [3, 2, 1]).astype(np.float32)
    return points, rng.integers(0, 256, (count, 3), dtype=np.uint8)


def _octree(points, colors):
    return build_octree(Cloud(points, colors, np.zeros(3)).voxels(np.eye(3)))


def test_leaves_are_the_voxels_and_parents_the_means_of_their_children():
    voxels = Cloud(*_cloud(), np.zeros(3)).voxels(np.eye(3))
    np.testing.assert_array_equal(build_octree(voxels).level(LEAF_SIZE), voxels.nodes)
    octree = _octree(*_cloud())
    for level in range(NUM_LEVELS - 1):
        lo, hi = octree.level_start[level : level + 2]
        for node in (lo, (lo + hi) // 2, hi - 1):
            children = octree.nodes[octree.first_child[node] : octree.first_child[node + 1]]
            assert 1 <= len(children) <= 8
            np.testing.assert_allclose(octree.nodes[node], children.mean(axis=0), rtol=1e-5, atol=1e-5)
    octree = _octree(*_cloud())
    last = octree.level_start[-2]
    assert octree.first_child[0] == octree.level_start[1]
    assert (np.diff(octree.first_child[: last + 1]) >= 1).all()
    assert octree.first_child[last] == octree.level_start[-1]


@pytest.mark.parametrize("num", [1, 7, 1000])
def test_voxels_and_their_means_are_the_same_in_parts(monkeypatch, num):
    points, colors = _cloud(3000)
    whole = _octree(points, colors)
    for module in (octree_module, voxels_module):
        monkeypatch.setattr(module, "AT_ONCE", num)
    for values, others in zip(_octree(points, colors), whole, strict=True):
        np.testing.assert_array_equal(values, others)


@pytest.mark.parametrize(("size", "level"), [(0.02, 7), (0.04, 6), (0.16, 4), (100.0, 0), (0.001, 7)])
def test_level_is_the_nearest_in_size(size, level):
    octree = _octree(*_cloud())
    begin, end = octree.level_start[level : level + 2]
    np.testing.assert_array_equal(octree.level(size), octree.nodes[begin:end])


def _drawn(octree, center, voxel_per_range):
    """What `collect` is to find, from the definition: nodes far enough for their size, their parents not."""
    found = []
    waiting = [(node, 0) for node in range(octree.level_start[1])]
    while waiting:
        node, level = waiting.pop()
        size = octree.leaf_size * 2.0 ** (NUM_LEVELS - 1 - level)
        distance = np.linalg.norm(octree.nodes[node, :3] - center)
        if level == NUM_LEVELS - 1 or distance >= size / voxel_per_range:
            found.append(node)
        else:
            children = range(octree.first_child[node], octree.first_child[node + 1])
            waiting += [(child, level + 1) for child in children]
    return sorted(found)


@pytest.mark.parametrize("voxel_per_range", [1 / 4, 1 / 15, 1 / 30, 1 / 80, 1 / 300])
@pytest.mark.parametrize("center", [[0.0, 0.0, 0.0], [4.0, -1.0, 0.5], [60.0, 0.0, 0.0]])
def test_collects_the_coarsest_nodes_that_are_small_from_where_one_is(voxel_per_range, center):
    rng = np.random.default_rng(1)
    wall = np.stack([rng.uniform(-9, 9, 60_000), np.full(60_000, 3.0), rng.uniform(0, 4, 60_000)], axis=1)
    points = np.concatenate([wall.astype(np.float32), _cloud()[0]])
    octree = _octree(points, np.full((len(points), 3), 90, np.uint8))
    found, directions = np.empty(MAX_NODES, np.int32), np.empty((3, MAX_NODES), np.float32)
    count = collect(octree, np.array(center), voxel_per_range, found, directions)
    assert sorted(found[:count].tolist()) == _drawn(octree, np.float32(center), voxel_per_range)
    expected = octree.nodes[found[:count], :3] - np.float32(center)
    np.testing.assert_allclose(directions[:, :count].T, expected, atol=1e-5)


def test_without_leaves_their_parents_are_the_leaves():
    whole = _octree(*_cloud())
    thin = whole.without_leaves()
    assert thin.leaf_size == 2.0 * whole.leaf_size
    for k in range(1, NUM_LEVELS):
        np.testing.assert_array_equal(thin.level(LEAF_SIZE * 2**k), whole.level(LEAF_SIZE * 2**k))
    found, directions = np.empty(MAX_NODES, np.int32), np.empty((3, MAX_NODES), np.float32)
    count = collect(thin, np.zeros(3), 1e-6, found, directions)
    np.testing.assert_array_equal(np.sort(found[:count]), np.arange(*thin.level_start[-2:]))


def test_collects_no_more_than_there_is_room_for():
    octree = _octree(*_cloud())
    found, directions = np.full(110, -1, np.int32), np.zeros((3, 100), np.float32)
    assert collect(octree, np.zeros(3), 1 / 300, found[:100], directions) == 100
    assert (found[100:] == -1).all()
