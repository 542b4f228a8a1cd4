"""Pictures of the scan from few positions: where these are, what they show, and when they are drawn."""

import naive
import numpy as np
import rooms
from scipy.spatial import cKDTree

from piccolo.geometry.sphere import SEARCH_RINGS, make_grid
from piccolo.scan_map import drawn_places
from piccolo.scan_map.drawn_places import DrawnPlaces, cell_table, choose_positions, draw_around
from piccolo.system.jobs.threads import Workers

TIER = "scene"

CELLS = len(make_grid(SEARCH_RINGS))


def _open(count, distance=50.0):
    return np.full((count, CELLS), distance, np.float32)


def _positions(centers, ranges):
    """Positions, of which each is looked from but once."""
    looked = []
    found = choose_positions(centers, lambda k: looked.append(k) or ranges[k])
    assert len(looked) == len(set(looked)) <= len(centers)
    return found


def test_positions_equal_their_twin():
    rng = np.random.default_rng(4)
    centers = rng.uniform([0, 0, 0], [9, 7, 3], (120, 3))
    ranges = rng.choice([0.0, 0.3, 1.0, 2.0], (120, CELLS)).astype(np.float32)
    found = _positions(centers, ranges)
    assert 5 < len(found) < 120
    assert found.tolist() == naive.view_positions(centers, ranges, SEARCH_RINGS)


def test_what_is_near_and_seen_needs_no_position():
    centers = np.array([[0.0, 0, 1], [2.0, 0, 1], [2.6, 0, 1], [0.0, 0, 3.3], [0.0, 0, 3.5]])
    assert _positions(centers, _open(5)).tolist() == [0, 2, 4]
    behind_a_wall = _open(5)
    behind_a_wall[0, cell_table(SEARCH_RINGS)[24]] = 0.5  # level, all around
    assert _positions(centers[:2], behind_a_wall[:2]).tolist() == [0, 1]
    thin = _open(5)
    thin[0, cell_table(SEARCH_RINGS)[24]] = 1.1  # what is hardly behind is seen
    assert _positions(centers[:2], thin[:2]).tolist() == [0]
    assert len(_positions(np.empty((0, 3)), _open(0))) == 0


def test_there_is_room_for_any_number_of_positions():
    centers = np.stack(np.meshgrid(np.arange(15) * 3.0, np.arange(15) * 3.0, [1.5]), axis=-1).reshape(-1, 3)
    assert len(_positions(centers, _open(len(centers)))) == 225


def _places():
    """Those of a room, none drawn."""
    scan_map = rooms.scan_map(1)
    return DrawnPlaces(scan_map.octree, scan_map.centers)


def test_what_is_drawn_lies_on_the_surfaces_with_its_directions():
    places = _places()
    octree = rooms.scan_map(1).octree
    leaves = octree.level(octree.leaf_size)[:, :3]
    for keypoints, ranges, pose in places.draw(range(len(places.positions)), rooms.WORKERS):
        assert len(ranges) > 100
        distance = cKDTree(leaves).query(pose.center_world + keypoints.rays * ranges[:, None])[0]
        assert np.median(distance) < 0.02
        assert (distance < 0.06).mean() > 0.95
        assert np.abs(np.sum(keypoints.rays * keypoints.tangents, axis=1)).max() < 0.02


def test_a_scan_of_one_grey_shows_hardly_any():
    octree = rooms.scan_map(1).octree
    gray = octree._replace(nodes=np.where(np.arange(6) < 3, octree.nodes, np.float32(128 / 255)))
    assert len(draw_around(gray, _places().positions[0]).ranges) < 5  # at the edges of what was scanned


def test_pictures_are_drawn_once_and_the_same_bits_by_any_number_of_threads():
    places = _places()
    workers, asked = rooms.listen()
    first = places.draw([0, 1], workers)
    again = places.draw([1, 0], workers)
    assert [label for label, _ in asked].count("draw") == 2
    assert [one is other for one, other in zip(first, again[::-1], strict=True)] == [True, True]
    for own, other in zip(first, _places().draw([0, 1], Workers(1)), strict=True):
        np.testing.assert_array_equal(own.ranges, other.ranges)
        for values, others in zip(own.keypoints, other.keypoints, strict=True):
            np.testing.assert_array_equal(values, others)


def test_old_pictures_make_room(monkeypatch):
    monkeypatch.setattr(drawn_places, "MOST_DRAWN_KEPT", 2)
    places = _places()
    first = places.draw([0], rooms.WORKERS)[0]
    assert places.draw([0, 1], rooms.WORKERS)[0] is first
    places.draw([2], rooms.WORKERS)
    other = places.draw([0], rooms.WORKERS)[0]
    assert other is not first
    np.testing.assert_array_equal(other.ranges, first.ranges)


def test_the_scan_is_drawn_where_a_photo_may_be_and_first_where_it_is_likely(monkeypatch):
    places = _places()
    positions = places.positions
    nowhere = np.empty((0, 3))

    def choose(allowed, likely):
        return places.choose(allowed, likely, 2).tolist()

    assert choose(rooms.scan_map(1).centers, nowhere) == list(range(len(positions)))
    assert choose(positions[:1] + 0.1, nowhere)[0] == 0
    assert choose(positions[:1] + 100.0, nowhere) == []
    assert choose(nowhere, nowhere) == []
    monkeypatch.setattr(drawn_places, "MOST_DRAWN", 3)
    assert choose(positions, nowhere) == [0, 1, 2]
    for k in range(len(positions)):
        chosen = choose(positions, positions[k : k + 1])
        assert chosen[0] == k
        assert len(chosen) == 2
