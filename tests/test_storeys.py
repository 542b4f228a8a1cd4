"""Storeys of a scan, and how far it is to walk in it: never through a wall."""

import numpy as np
import pytest
import rooms
from rooms import scan_map

from piccolo.cloud.octree import build_octree
from piccolo.cloud.stream import stream_of_arrays
from piccolo.scan_map.camera_positions import FreeSpace
from piccolo.scan_map.scan_map import prepare_map
from piccolo.scan_map.storeys import Storey, find_storeys
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import make_world, scan_world

TIER = "scene"


def _octree(*parts):
    voxels = rooms.voxels(np.concatenate(parts))
    return build_octree(voxels), voxels.origin


def _plate(x0, y0, x1, y1, z, slope=0.0):
    step = 0.08
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    return np.column_stack([x.ravel(), y.ravel(), z + slope * x.ravel()])


def _box(x0, y0, x1, y1, low, high):
    """Floor, ceiling and walls."""
    z, x, y = np.arange(low, high, 0.08), np.arange(x0, x1, 0.08), np.arange(y0, y1, 0.08)
    walls = [np.stack(np.meshgrid([at], y, z), axis=-1).reshape(-1, 3) for at in (x0, x1)] + [
        np.stack(np.meshgrid(x, [at], z), axis=-1).reshape(-1, 3) for at in (y0, y1)
    ]
    return np.concatenate([_plate(x0, y0, x1, y1, low), _plate(x0, y0, x1, y1, high), *walls])


def _storeys(*parts):
    """The floors of some surfaces [m], and what tells the storey and height of places (N, 3)."""
    octree, origin = _octree(*parts)
    storeys = find_storeys(octree)
    floors = [storey.floor + origin[2] for storey in storeys.storeys]
    return floors, lambda places: storeys.at(np.array(places) - origin)


def test_storeys_one_above_the_other_lowest_first():
    floors, at = _storeys(*(_box(0, 0, 6, 5, low, low + 2.5) for low in (-2.9, 0.0, 2.9)))
    assert floors == pytest.approx([-2.9, 0.0, 2.9], abs=0.05)
    storey, height = at([[3, 2, 4.5], [3, 2, 1.5], [1, 1, -1.4], [9.0, 2, 1.0]])
    assert storey.tolist() == [2, 1, 0, 1]  # the last is outside: of the floor below its height
    np.testing.assert_allclose(height, [1.6, 1.5, 1.5, 1.0], atol=0.05)


def test_shelves_tables_and_stairs_are_no_storeys():
    shelves = [_plate(1, y, 5, y + 0.5, z) for y in (1.0, 2.5) for z in (0.5, 2.6)]
    table = _plate(3, 4, 4.5, 4.9, 0.75)
    stairs = [_plate(0.3 * k, 0, 0.3 * k + 0.3, 0.9, 0.18 * k) for k in range(16)]
    assert len(_storeys(_box(0, 0, 7, 6, 0.0, 5.0), *shelves, table, *stairs)[0]) == 1


def test_wings_at_different_heights_are_one_storey():
    floors, at = _storeys(_box(0, 0, 6, 5, 0.0, 2.6), _box(8, 0, 13, 5, 1.2, 3.8))
    assert floors == pytest.approx([0.0], abs=0.05)
    storey, height = at([[3.0, 2.0, 1.5], [10.0, 2.0, 2.8]])
    assert storey.tolist() == [0, 0]
    np.testing.assert_allclose(height, [1.5, 1.6], atol=0.05)  # above the floor of each wing


def test_a_gallery_above_the_hall_is_a_storey_of_its_own():
    floors, at = _storeys(_box(0, 0, 12, 8, 0.0, 6.0), _plate(0, 0, 12, 3, 3.0))
    assert floors == pytest.approx([0.0, 3.0], abs=0.05)
    storey, _ = at([[6.0, 1.5, 4.5], [6.0, 1.5, 1.5], [6.0, 6.5, 4.5]])
    assert storey.tolist() == [1, 0, 0]  # high above the hall beside the gallery is still the hall


def test_a_camera_over_a_sofa_is_as_high_as_beside_it():
    _, at = _storeys(_box(0, 0, 6, 5, 0.0, 2.6), _plate(2, 2, 4, 2.8, 0.42))
    np.testing.assert_allclose(at([[3.0, 2.4, 1.5], [3.0, 4.0, 1.5]])[1], [1.5, 1.5], atol=0.05)


def test_no_storey_where_nothing_is_level():
    floors, at = _storeys(_plate(0, 0, 6, 6, 0.0, slope=1.0))
    assert floors == []
    storey, height = at(np.zeros((2, 3)))
    assert storey.tolist() == [-1, -1]
    assert np.isnan(height).all()


def test_a_scanned_room_has_its_floor_at_its_own_height():
    m = scan_map(3)
    storeys = find_storeys(m.octree)
    assert [s.floor + m.origin_world[2] for s in storeys.storeys] == pytest.approx([0.0], abs=0.02)
    storey, height = storeys.at(m.centers)
    assert (storey == 0).all()
    error = np.abs(height - m.centers[:, 2] - m.origin_world[2])
    assert np.percentile(error, 97.0) < 0.02  # others are above the middle of a large table


def test_nearest_surfaces_are_those_of_all():
    rng = np.random.default_rng(2)
    surfaces = (rng.uniform(0, 1, (900, 3)) * [30, 20, 0.1]).astype(np.float32)
    surfaces = np.asfortranarray(surfaces[np.argsort(surfaces[:, 0])])
    floor = Storey(0.0, surfaces)
    assert len(floor.nearest(np.array([np.nan, 0.0, 0.0]), 40)[0]) == 0
    for center in ([15.0, 10.0, 1.5], [0.0, 0.0, 1.5], [-40.0, 10.0, 1.5], [29.9, 90.0, 1.5]):
        beside = np.hypot(*(surfaces[:, :2] - np.float32(center[:2])).T)
        for count in (1, 40, 1000):
            distance, heights = floor.nearest(np.array(center), count)
            order = np.argsort(beside, kind="stable")[:count]
            np.testing.assert_allclose(distance, beside[order], rtol=1e-5)
            np.testing.assert_array_equal(heights, surfaces[order, 2])


@pytest.fixture(scope="module")
def two_rooms():
    world = make_world(5, np.array(rooms.SIZE), 2)
    points, colors, _ = scan_world(world, 80_000, Workers(2))
    cloud = stream_of_arrays(points.astype(np.float64), colors)
    return world, prepare_map(cloud, Workers(2), "z")


def test_nobody_walks_through_a_wall(two_rooms):
    world, scan_map = two_rooms
    centers = scan_map.centers + scan_map.origin_world
    is_high = np.abs(centers[:, 2] - 1.6) < 0.4
    first, second = (
        scan_map.centers[is_high & ((centers > r.corner) & (centers < r.corner + rooms.SIZE)).all(axis=1)]
        for r in world.rooms
    )
    space = FreeSpace(scan_map.octree, scan_map.centers, Workers(2))
    start = first[np.argmax(first[:, 1])]
    same = space.distances(start[None], first, 20.0)[0]
    assert len(first) > 20
    assert np.isfinite(same).mean() > 0.95
    straight = np.linalg.norm(first - start, axis=1)
    assert (same >= straight - 1e-9).all()
    assert np.median(same[straight > 1.0] / straight[straight > 1.0]) < 1.4
    assert len(second) > 20
    assert np.linalg.norm(second - start, axis=1).min() < 2.0
    across = space.distances(start[None], second, 20.0)[0]  # by the windows at best
    assert across.min() > np.linalg.norm(second - start, axis=1).min() + 1.5
    assert np.isinf(space.distances(start[None], second, 2.3)).all()


def test_far_places_are_beyond_the_limit_and_distances_the_same_one_by_one_and_together(two_rooms):
    centers = two_rooms[1].centers
    space = FreeSpace(two_rooms[1].octree, two_rooms[1].centers, Workers(1))
    distance = space.distances(centers[:1], centers, 1.0)[0]
    assert np.isinf(distance[np.linalg.norm(centers - centers[0], axis=1) > 1.0]).all()
    assert distance[0] == 0.0
    together = space.distances(centers[:9], centers[::7], 4.0)
    alone = [space.distances(start[None], centers[::7], 4.0)[0] for start in centers[:9]]
    assert together.tobytes() == np.array(alone).tobytes()
