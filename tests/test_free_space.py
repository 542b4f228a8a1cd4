"""How far it is to walk: never through a wall."""

import numpy as np
import pytest
import rooms

from piccolo.cloud.stream import stream_of_arrays
from piccolo.jobs.threads import Workers
from piccolo.scan_map.free_space import FreeSpace
from piccolo.scan_map.scan_map import prepare_map
from research.synthetic.world import make_world, scan_world


@pytest.fixture(scope="module")
def two_rooms():
    world = make_world(5, np.array(rooms.SIZE), 2)
    points, colors, _ = scan_world(world, 80_000, Workers(2))
    cloud = stream_of_arrays(points.astype(np.float64), colors)
    return world, prepare_map(cloud, Workers(2), "z", has_features=False)


def test_nobody_walks_through_a_wall(two_rooms):
    world, scan_map = two_rooms
    centers = scan_map.centers + scan_map.origin_world
    is_high = np.abs(centers[:, 2] - 1.6) < 0.4
    first, second = (
        scan_map.centers[is_high & ((centers > r.corner) & (centers < r.corner + rooms.SIZE)).all(axis=1)]
        for r in world.rooms
    )
    space, start = FreeSpace(scan_map, Workers(2)), first[np.argmax(first[:, 1])]
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


def test_far_places_are_beyond_the_limit(two_rooms):
    centers = two_rooms[1].centers
    space = FreeSpace(two_rooms[1], Workers(1))
    distance = space.distances(centers[:1], centers, 1.0)[0]
    assert np.isinf(distance[np.linalg.norm(centers - centers[0], axis=1) > 1.0]).all()
    assert distance[0] == 0.0


def test_distances_are_the_same_one_by_one_and_together(two_rooms):
    centers = two_rooms[1].centers
    space = FreeSpace(two_rooms[1], Workers(1))
    together = space.distances(centers[:9], centers[::7], 4.0)
    alone = [space.distances(start[None], centers[::7], 4.0)[0] for start in centers[:9]]
    assert together.tobytes() == np.array(alone).tobytes()
