"""Points averaged voxel by voxel: the table, its grid and its limits."""

import itertools

import naive
import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_cloud_morton import seeded_cloud
from test_cloud_stream import LEVEL, TURN, stream

from piccolo.cloud import voxels
from piccolo.cloud.octree import build_octree
from piccolo.cloud.readers.reader import RawCloud
from piccolo.cloud.voxels import COUNT, LEAF_SIZE, NUM_COLUMNS, POSITION, VoxelTable, add_points, fill_index
from piccolo.errors import InputError
from piccolo.geometry.pose import rotate_points

CORNER = -voxels.PHASE / voxels.QUANTA_PER_METRE


@pytest.mark.parametrize("turn", [LEVEL, TURN])
@pytest.mark.parametrize("size", [0.3, 300.0])  # many points a voxel, or one, so that the table grows
def test_voxels_equal_their_twin(size, turn):
    raw = seeded_cloud(1, 60_000 if size > 1 else 20_000, size=(size, 0.9 * size, 0.8 * size))
    found = stream(raw, chunk=7001).voxels(turn)
    expected = naive.voxels(raw.points_world @ turn.T, raw.colors, LEAF_SIZE, CORNER)
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
        size = voxels.COARSEST * LEAF_SIZE / 2**k
        columns = np.floor((octree.nodes[begin:end, :2] + flat.origin[:2] - CORNER) / size)
        assert len(np.unique(columns, axis=0)) == end - begin


def test_a_larger_index_names_the_same_rows_and_the_table_may_be_fed_with_nothing():
    index, larger = np.zeros(64, np.int32), np.zeros(256, np.int32)
    rows, base = np.full((40, NUM_COLUMNS), -1, np.int32), np.zeros(3, np.int64)
    raw = seeded_cloud(16, 41)
    assert add_points(raw.points_world, raw.colors, base, index, rows, 0) == (40, 40)
    fill_index(rows, 40, larger)
    for names in (index, larger):
        assert sorted(names[names > 0]) == list(range(1, 41))
    more = np.vstack([rows, rows])
    assert add_points(raw.points_world[:40], raw.colors, base, larger, more, 40) == (40, 40)
    np.testing.assert_array_equal(more[:, COUNT], np.repeat([2, 1], 40))
    table = VoxelTable("a")
    table.add(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    table.add(np.full((2, 3), 7.5), np.full((2, 3), 51, np.uint8))
    found = table.finish()
    np.testing.assert_allclose(found.nodes[0, 3:], 0.2)
    np.testing.assert_allclose(found.nodes[0, :3] + found.origin, 7.5, atol=4e-5)


def test_a_full_voxel_takes_no_more_and_fits_its_sums(monkeypatch):
    monkeypatch.setattr(voxels, "MAX_COUNT", 3)
    index, rows = np.zeros(8, np.int32), np.zeros((4, NUM_COLUMNS), np.int32)
    points, colors = np.full((5, 3), 0.01), np.full((5, 3), 200, np.uint8)
    add = getattr(add_points, "py_func", add_points)  # itself where nothing is compiled
    done = add(points, colors, np.zeros(3, np.int64), index, rows, 0)
    assert done == (5, 1)
    row = rows[0]
    assert row[COUNT] == 3
    assert row[POSITION] == 3 * ((128 + voxels.PHASE) % 256)
    assert voxels.MAX_COUNT * max(255, voxels.QUANTUM_MASK) <= np.iinfo(np.int32).max


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
    monkeypatch.setattr(voxels, "MAX_VOXELS", 40_000)
    with pytest.raises(InputError, match=r"more than 40000 voxels of 0\.02 m are filled.*`units`"):
        stream(seeded_cloud(9, 50_000, size=(900.0, 900.0, 900.0))).voxels(LEVEL)
