import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piccolo.cloud import Cloud
from piccolo.cloud.octree import build_octree
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


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_shuffling_points_changes_no_bit(seed):
    points, colors = _cloud(2000)
    order = np.random.default_rng(seed).permutation(len(points))
    a, b = _octree(points, colors), _octree(points[order], colors[order])
    np.testing.assert_array_equal(a.nodes, b.nodes)
    np.testing.assert_array_equal(a.first_child, b.first_child)


@pytest.mark.parametrize(("size", "level"), [(0.02, 7), (0.04, 6), (0.16, 4), (100.0, 0), (0.001, 7)])
def test_level_is_the_nearest_in_size(size, level):
    octree = _octree(*_cloud())
    begin, end = octree.level_start[level : level + 2]
    np.testing.assert_array_equal(octree.level(size), octree.nodes[begin:end])
