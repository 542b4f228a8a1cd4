"""Voxels and octrees of clouds."""

import functools
import itertools

import naive
import numpy as np
import pytest
import rooms
from clouds import LEVEL, TURN, seeded_cloud, stream
from scipy.spatial import cKDTree

from piccolo.cloud import octree as octree_module, voxels as voxel_table
from piccolo.cloud.octree import MAX_NODES, build_octree, collect
from piccolo.cloud.readers.reader import RawCloud
from piccolo.geometry.cone import EVERYWHERE, Cone
from piccolo.geometry.pose import rotate_points
from piccolo.system.errors import InputError

CORNER = -voxel_table.PHASE / voxel_table.QUANTA_PER_METRE


@pytest.mark.parametrize("turn", [LEVEL, TURN])
@pytest.mark.parametrize("size", [0.3, 300.0])  # many points a voxel, or one, so that the table grows
def test_voxels_equal_their_twin(size, turn):
    raw = seeded_cloud(1, 40_000 if size > 1 else 20_000, size=(size, 0.9 * size, 0.8 * size))
    found = stream(raw, chunk=7001).voxels(turn)
    expected = naive.voxels(raw.points_world @ turn.T, raw.colors, voxel_table.LEAF_SIZE, CORNER)
    assert len(found.nodes) == len(expected)
    distance, match = cKDTree(found.nodes[:, :3] + found.origin).query(expected[:, :3])
    assert distance.max() < 7e-5 + 1e-7 * size  # half a quantum along each axis
    np.testing.assert_allclose(found.nodes[match, 3:], expected[:, 3:] / 255.0, atol=1e-6)
    np.testing.assert_array_equal(found.origin, np.round(found.origin))
    assert (np.diff(found.codes) > 0).all()


def test_whole_metres_move_the_origin_and_no_bit_of_the_rest():
    raw = seeded_cloud(4, size=(2.0, 2.0, 2.0))
    raw = RawCloud(np.round(raw.points_world * 4096) / 4096, raw.colors)  # exact at either place
    shift = np.array([637_012.0, 5_849_028.0, -431.0])
    near, far = (stream(RawCloud(raw.points_world + s, raw.colors)).voxels(LEVEL) for s in (0 * shift, shift))
    np.testing.assert_array_equal(far.origin - near.origin, shift)
    by_place = [v.nodes[np.lexsort(v.nodes.T)] for v in (near, far)]
    np.testing.assert_allclose(by_place[0], by_place[1], atol=1e-6)


@pytest.mark.parametrize("z", [0.0, 3.0, -17.0, 0.1])
def test_a_floor_at_a_round_height_is_one_layer_at_every_level(z):
    raw = seeded_cloud(17, 5000, size=(3.0, 2.0, 0.005))
    raw.points_world[:, 2] += z
    flat = stream(raw).voxels(LEVEL)
    octree = build_octree(flat)
    for k, (begin, end) in enumerate(itertools.pairwise(octree.level_start)):
        size = voxel_table.COARSEST * voxel_table.LEAF_SIZE / 2**k
        columns = np.floor((octree.nodes[begin:end, :2] + flat.origin[:2] - CORNER) / size)
        assert len(np.unique(columns, axis=0)) == end - begin


def test_a_larger_index_names_the_same_rows_and_the_table_may_be_fed_with_nothing():
    index, larger = np.zeros(64, np.int32), np.zeros(256, np.int32)
    rows = np.full((40, voxel_table.NUM_COLUMNS), -1, np.int32)
    base = np.zeros(3, np.int64)
    raw = seeded_cloud(16, 41)
    assert voxel_table.add_points(raw.points_world, raw.colors, base, index, rows, 0) == (40, 40)
    voxel_table.fill_index(rows, 40, larger)
    for names in (index, larger):
        assert sorted(names[names > 0]) == list(range(1, 41))
    more = np.vstack([rows, rows])
    assert voxel_table.add_points(raw.points_world[:40], raw.colors, base, larger, more, 40) == (40, 40)
    np.testing.assert_array_equal(more[:, voxel_table.COUNT_COLUMN], np.repeat([2, 1], 40))
    table = voxel_table.VoxelTable("a")
    table.add(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    table.add(np.full((2, 3), 7.5), np.full((2, 3), 51, np.uint8))
    found = table.finish()
    np.testing.assert_allclose(found.nodes[0, 3:], 0.2)
    np.testing.assert_allclose(found.nodes[0, :3] + found.origin, 7.5, atol=4e-5)


def test_a_full_voxel_takes_no_more_and_fits_its_sums(monkeypatch):
    monkeypatch.setattr(voxel_table, "MAX_COUNT", 3)
    index, rows = np.zeros(8, np.int32), np.zeros((4, voxel_table.NUM_COLUMNS), np.int32)
    points, colors = np.full((5, 3), 0.01), np.full((5, 3), 200, np.uint8)
    add = getattr(
        voxel_table.add_points, "py_func", voxel_table.add_points
    )  # itself where nothing is compiled
    done = add(points, colors, np.zeros(3, np.int64), index, rows, 0)
    assert done == (5, 1)
    row = rows[0]
    assert row[voxel_table.COUNT_COLUMN] == 3
    assert row[voxel_table.POSITION] == 3 * ((128 + voxel_table.PHASE) % 256)
    assert voxel_table.MAX_COUNT * max(255, voxel_table.QUANTUM_MASK) <= np.iinfo(np.int32).max


def test_turning_gives_each_point_the_same_bits_alone_as_among_others():
    points = seeded_cloud(6).points_world
    alone = np.concatenate([rotate_points(p[None], TURN) for p in points])
    assert alone.tobytes() == rotate_points(points, TURN).tobytes()
    np.testing.assert_allclose(alone, points @ TURN.T, atol=1e-12)


def test_points_too_far_away_are_left_out_and_two_scenes_are_no_map():
    raw = seeded_cloud(7)
    raw.points_world[5:8] += [0.0, 30_000.0, 0.0]
    found = stream(raw).voxels(LEVEL)
    assert "0.ply: 3 points farther than 21 km from the middle left out" in found.warnings
    assert np.abs(found.nodes[:, :3]).max() < 4.0
    raw.points_world[5] = [0.0, 0.0, -9e7]
    with pytest.raises(InputError, match=r"0\.ply: points more than 42950 km apart, wanted one scene"):
        stream(raw).voxels(LEVEL)
    raw = seeded_cloud(8, 2000)
    raw.points_world[:1000, 0] += 50_000.0
    assert len(stream(raw).voxels(LEVEL).nodes) >= 900  # one of them
    raw.points_world[:] = np.diag([1e5, 1e5, 1e5])[np.arange(2000) % 3]
    with pytest.raises(InputError, match=r"2000 points farther than 21 km .*none nearer, wanted one scene"):
        stream(raw).voxels(LEVEL)


def test_too_many_voxels_are_refused(monkeypatch):
    monkeypatch.setattr(voxel_table, "MAX_VOXELS", 40_000)
    with pytest.raises(InputError, match=r"more than 40000 voxels of 0\.02 m are filled.*`units`"):
        stream(seeded_cloud(9, 50_000, size=(900.0, 900.0, 900.0))).voxels(LEVEL)


def _cloud(count=5000, seed=0):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(count, 3)) * [3, 2, 1]).astype(np.float32)
    return points, rng.integers(0, 256, (count, 3), dtype=np.uint8)


def _build(points, colors):
    return build_octree(rooms.voxels(points, colors))


@functools.lru_cache
def _octree():
    """The octree of the cloud, only to be read."""
    return _build(*_cloud())


@functools.lru_cache
def _octree_with_a_wall():
    """The same of a wall beside the cloud, all of one colour."""
    rng = np.random.default_rng(1)
    wall = np.stack([rng.uniform(-9, 9, 60_000), np.full(60_000, 3.0), rng.uniform(0, 4, 60_000)], axis=1)
    points = np.concatenate([wall.astype(np.float32), _cloud()[0]])
    return _build(points, np.full((len(points), 3), 90, np.uint8))


def test_leaves_are_the_voxels_and_parents_the_means_of_their_children():
    voxels = rooms.voxels(*_cloud())
    octree = build_octree(voxels)
    np.testing.assert_array_equal(octree.level(voxel_table.LEAF_SIZE), voxels.nodes)
    for level in range(voxel_table.NUM_LEVELS - 1):
        lo, hi = octree.level_start[level : level + 2]
        for node in (lo, (lo + hi) // 2, hi - 1):
            children = octree.nodes[octree.first_child[node] : octree.first_child[node + 1]]
            assert 1 <= len(children) <= 8
            np.testing.assert_allclose(octree.nodes[node], children.mean(axis=0), rtol=1e-5, atol=1e-5)
    last = octree.level_start[-2]
    assert octree.first_child[0] == octree.level_start[1]
    assert (np.diff(octree.first_child[: last + 1]) >= 1).all()
    assert octree.first_child[last] == octree.level_start[-1]


@pytest.mark.parametrize("num", [1, 7, 1000])
def test_voxels_and_their_means_are_the_same_in_parts(monkeypatch, num):
    points, colors = _cloud(3000)
    whole = _build(points, colors)
    for module in (octree_module, voxel_table):
        monkeypatch.setattr(module, "VOXELS_AT_ONCE", num)
    for values, others in zip(_build(points, colors), whole, strict=True):
        np.testing.assert_array_equal(values, others)


@pytest.mark.parametrize(("size", "level"), [(0.02, 7), (0.04, 6), (0.16, 4), (100.0, 0), (0.001, 7)])
def test_level_is_the_nearest_in_size(size, level):
    octree = _octree()
    begin, end = octree.level_start[level : level + 2]
    np.testing.assert_array_equal(octree.level(size), octree.nodes[begin:end])


def _drawn(octree, center, voxel_per_range):
    """What `collect` is to find, from the definition: nodes far enough for their size, their parents not."""
    found = []
    waiting = [(node, 0) for node in range(octree.level_start[1])]
    while waiting:
        node, level = waiting.pop()
        size = octree.leaf_size * 2.0 ** (voxel_table.NUM_LEVELS - 1 - level)
        distance = np.linalg.norm(octree.nodes[node, :3] - center)
        if level == voxel_table.NUM_LEVELS - 1 or distance >= size / voxel_per_range:
            found.append(node)
        else:
            children = range(octree.first_child[node], octree.first_child[node + 1])
            waiting += [(child, level + 1) for child in children]
    return sorted(found)


@pytest.mark.parametrize("voxel_per_range", [1 / 4, 1 / 15, 1 / 30, 1 / 80, 1 / 300])
@pytest.mark.parametrize("center", [[0.0, 0.0, 0.0], [4.0, -1.0, 0.5], [60.0, 0.0, 0.0]])
def test_collects_the_coarsest_nodes_that_are_small_from_where_one_is(voxel_per_range, center):
    octree = _octree_with_a_wall()
    found, directions = np.empty(MAX_NODES, np.int32), np.empty((3, MAX_NODES), np.float32)
    count = collect(octree, np.array(center), voxel_per_range, EVERYWHERE, found, directions)
    assert sorted(found[:count].tolist()) == _drawn(octree, np.float32(center), voxel_per_range)
    expected = octree.nodes[found[:count], :3] - np.float32(center)
    np.testing.assert_allclose(directions[:, :count].T, expected, atol=1e-5)


@pytest.mark.parametrize("half_angle", [10.0, 45.0, 100.0, 175.0])
@pytest.mark.parametrize("voxel_per_range", [1 / 15, 1 / 80])
def test_of_nodes_in_a_cone_none_is_left_out_and_their_order_stays(voxel_per_range, half_angle):
    octree = _octree()
    center = np.array([0.3, -0.2, 0.1])
    found, directions = np.empty(MAX_NODES, np.int32), np.empty((3, MAX_NODES), np.float32)
    every = found[: collect(octree, center, voxel_per_range, EVERYWHERE, found, directions)].copy()
    rays = octree.nodes[every, :3] - center
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for axis in np.random.default_rng(3).normal(size=(8, 3)):
        cone = Cone(1.0, 0.0, 0.0, np.cos(np.radians(half_angle))).turn(
            np.outer(axis / np.linalg.norm(axis), [1.0, 0.0, 0.0])
        )
        some = found[: collect(octree, center, voxel_per_range, cone, found, directions)].copy()
        is_in = np.arccos(np.clip(rays @ cone.axis, -1.0, 1.0)) < np.radians(half_angle - 0.01)
        assert set(every[is_in]) <= set(some)
        np.testing.assert_array_equal(some, every[np.isin(every, some)])
        assert len(some) < 0.6 * len(every) or half_angle > 45.0


def test_without_leaves_their_parents_are_the_leaves():
    whole = _octree()
    thin = whole.without_leaves()
    assert thin.leaf_size == 2.0 * whole.leaf_size
    for k in range(1, voxel_table.NUM_LEVELS):
        np.testing.assert_array_equal(
            thin.level(voxel_table.LEAF_SIZE * 2**k), whole.level(voxel_table.LEAF_SIZE * 2**k)
        )
    found, directions = np.empty(MAX_NODES, np.int32), np.empty((3, MAX_NODES), np.float32)
    count = collect(thin, np.zeros(3), 1e-6, EVERYWHERE, found, directions)
    np.testing.assert_array_equal(np.sort(found[:count]), np.arange(*thin.level_start[-2:]))


def test_collects_no_more_than_there_is_room_for():
    octree = _octree()
    found = np.full(110, -1, np.int32)
    directions = np.zeros((3, 100), np.float32)
    assert collect(octree, np.zeros(3), 1 / 300, EVERYWHERE, found[:100], directions) == 100
    assert (found[100:] == -1).all()
