"""The vertical of a cloud, which end of it is up, and when that is not known."""

import numpy as np
import pytest
import rooms
from rooms import room
from scans import bare_room

from piccolo.cloud import gravity as alignment
from piccolo.cloud.gravity import DominantPlanes
from piccolo.cloud.octree import build_octree
from piccolo.geometry.pose import exp_so3, rotation_to_z, yaw_rotation

Z = np.array([0.0, 0.0, 1.0])
TURNS = [np.array(w) for w in ([0.3, -0.2, 0.9], [1.4, 0.6, -0.3], [2.9, -0.5, 0.4])]


def up_of(points, w=(0.0, 0.0, 0.0)):
    """Up (3,) of points (N, 3) turned by a rotation vector, None if it is not known, and why."""
    points = (points @ exp_so3(np.asarray(w)).T).astype(np.float32)
    octree = build_octree(rooms.voxels(points))
    axis, sense, reason, _ = alignment.find_up(octree)
    assert np.linalg.norm(axis) == pytest.approx(1.0)
    assert "\n" not in reason
    return sense * axis if sense else None, reason


def box(low, high, density=400):
    """Points (N, 3) on the six faces of a box."""
    rng = np.random.default_rng(7)
    low, high = np.asarray(low, float), np.asarray(high, float)
    faces = []
    for axis, side in np.ndindex(3, 2):
        area = np.prod(np.delete(high - low, axis))
        face = rng.uniform(low, high, (int(density * area), 3))
        face[:, axis] = (low, high)[side][axis]
        faces.append(face)
    return np.concatenate(faces)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
@pytest.mark.parametrize("w", TURNS, ids=str)
def test_furniture_tells_up_in_a_turned_room(seed, w):
    up, _ = up_of(room(seed)[1].points, w)
    true_up = exp_so3(w) @ Z
    assert np.degrees(np.arctan2(np.linalg.norm(np.cross(up, true_up)), up @ true_up)) < 0.5


@pytest.mark.parametrize("seed", [1, 2, 4])
@pytest.mark.parametrize("rise", [0.8, 2.2])
def test_each_building_on_a_slope_has_its_own_floors(seed, rise):
    """With the heights of all together up was not known, or down."""
    points = room(seed)[1].points.astype(float)
    buildings = [points + np.array([20.0 * (k % 2), 20.0 * (k // 2), rise * k]) for k in range(4)]
    up, _ = up_of(np.concatenate(buildings), TURNS[0])
    assert up @ exp_so3(TURNS[0]) @ Z > np.cos(np.radians(0.5))


def test_two_far_strays_change_little():
    strays = np.float32([[1e4, 0, 0], [0, -1e4, 1e4]])
    up, _ = up_of(np.concatenate([room(1)[1].points, strays]), TURNS[0])
    assert up @ exp_so3(TURNS[0]) @ Z > np.cos(np.radians(0.5))


@pytest.mark.parametrize("w", TURNS, ids=str)
def test_a_bare_room_may_be_upside_down(w):
    up, reason = up_of(bare_room(), w)
    assert up is None
    assert reason == "floor and ceiling look alike: furniture +0.0, free space +0.0"


def roofs():
    rng = np.random.default_rng(3)
    slopes = []
    for k in range(4):
        xy = rng.uniform([14.0 * k - 6.0, -6.0], [14.0 * k + 6.0, 6.0], (9000, 2))
        slopes.append(np.column_stack([xy, 5.0 - 0.7 * np.abs(xy[:, 1])]))
    return np.concatenate(slopes)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.random.default_rng(8).uniform(-3.0, 3.0, (20_000, 3)), "no dominant planes"),
        (np.linspace(0.0, 9.0, 2000)[:, None] * [1.0, 2.0, 3.0], "no dominant planes"),
        (box([0, 0, 0], [3, 3, 9]), "9.0 m high|3.0 m high and 3.0 m wide, a wall may be the floor"),
        (roofs(), "neither horizontal nor vertical"),
        (np.random.default_rng(9).uniform(-9.0, 9.0, (50_000, 3)) * [1, 1, 1e-4], "a floor and a ceiling"),
    ],
    ids=["volume", "line", "tower", "roofs", "ground"],
)
def test_what_tells_nothing_is_not_known(points, reason):
    up, found = up_of(points, TURNS[1])
    assert up is None
    assert any(text in found for text in reason.split("|"))


def test_levels_are_a_person_apart_and_tables_are_none():
    class DominantPlanes:
        normals = np.array([Z, -Z, Z, Z, [1.0, 0.0, 0.0]])
        centers = np.array([[0, 0, 0.0], [0, 0, 2.5], [0, 0, 0.5], [0, 0, 5.0], [3, 0, 1.0]])
        areas = np.array([0.3, 0.25, 0.2, 0.05, 0.15])

    np.testing.assert_array_equal(alignment.find_levels(DominantPlanes, Z), [0.0, 2.5])
    np.testing.assert_array_equal(alignment.find_levels(DominantPlanes, -Z), [-2.5, 0.0])


def test_tables_stand_on_floors_and_what_is_higher_says_nothing():
    levels = np.array([0.0, 2.6])
    for height, sign in ((0.75, 1.0), (1.3, 0.0), (2.1, -1.0), (0.1, 0.0)):
        heights = np.append(np.repeat(levels, 500), np.full(60, height))
        cue = alignment.furniture_cue(heights, np.ones(1060, bool), levels)
        assert np.sign(cue) == sign
        assert abs(cue) < np.log(62.0)


def two_rooms(door_height):
    """Two rooms with a wall between them and a door in it."""
    wall = np.random.default_rng(4).uniform([5.9, 0, 0], [6.1, 6, 2.6], (20_000, 3))
    in_door = (np.abs(wall[:, 1] - 3.0) < 0.6) & (wall[:, 2] < door_height)
    return np.concatenate([box([0, 0, 0], [12, 6, 2.6]), wall[~in_door]])


@pytest.mark.parametrize(("door_height", "least"), [(2.0, 0.4), (2.6, -0.1), (0.0, -0.1)])
def test_people_walk_through_doors_and_below_lintels_only(door_height, least):
    points = two_rooms(door_height)
    is_level = np.isin(points[:, 2], [0.0, 2.6])
    cue = alignment.passage_cue(points[:, 2], is_level, np.array([0.0, 2.6]), points[:, :2].copy())
    assert least < cue < least + 0.4


def test_trusses_below_a_high_ceiling_are_no_tables():
    """In a hall both cues must agree; in a room one is enough."""
    for height, is_known in ((2.6, True), (6.0, False)):
        tops = np.random.default_rng(2).uniform([1, 1, 0.7], [9, 7, 0.7], (20_000, 3))
        tables = tops[np.sin(4.0 * tops[:, 0]) > 0.5]
        up, reason = up_of(np.concatenate([box([0, 0, 0], [10, 8, height]), tables]))
        assert (up is not None) == is_known, reason
        assert not is_known or up[2] > 0.999


TURN = exp_so3(np.array([0.7, -1.9, 0.5]))
UP = TURN[:, 2]


def rectangle(rng, corner, a, b, noise=0.003):
    """Points (N, 3) of a parallelogram, 400 a m2."""
    num_points = int(400 * np.linalg.norm(np.cross(a, b)))
    s = rng.uniform(0.0, 1.0, (num_points, 2))
    return np.asarray(corner) + s @ np.array([a, b], float) + rng.normal(0.0, noise, (num_points, 3))


@pytest.fixture(scope="module")
def hut():
    """A turned hut: floor, two walls, a table, a ceiling over one half, a roof over the other."""
    rng = np.random.default_rng(1)
    parts = [
        rectangle(rng, [0, 0, 0], [6, 0, 0], [0, 4, 0]),
        rectangle(rng, [0, 0, 0], [6, 0, 0], [0, 0, 2.5]),
        rectangle(rng, [0, 0, 0], [0, 4, 0], [0, 0, 2.5]),
        rectangle(rng, [0, 0, 2.5], [3, 0, 0], [0, 4, 0]),
        rectangle(rng, [3, 0, 2.5], [3, 0, 1.5], [0, 4, 0]),
        rectangle(rng, [2, 1.5, 0.8], [2, 0, 0], [0, 1.5, 0]),
    ]
    return alignment.estimate_normals((np.concatenate(parts) @ TURN.T + [7.0, -3.0, 2.0]).astype(np.float32))


def test_every_plane_is_found_the_largest_first(hut):
    planes = alignment.ransac_planes(hut)
    assert (np.diff(planes.areas) <= 0.0).all()
    assert planes.areas.sum() == pytest.approx(1.0, abs=0.1)
    sines = np.abs(planes.normals @ UP)
    assert [np.count_nonzero(sines > 0.999), np.count_nonzero(sines < 0.03), len(sines)] == [3, 2, 6]
    heights = (planes.centers[sines > 0.999] - [7.0, -3.0, 2.0]) @ UP
    np.testing.assert_allclose(sorted(heights), [0.0, 0.8, 2.5], atol=0.02)


def planes_of(*normals, areas=None):
    normals = np.array(normals, float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return DominantPlanes(
        normals, np.zeros_like(normals), np.array(areas or [1.0 / len(normals)] * len(normals))
    )


@pytest.mark.parametrize("lean_deg", [0.5, 3.0, 14.0])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_vertical_near_what_is_said_keeps_its_sense(hut, lean_deg, sense):
    lean = exp_so3(np.radians(lean_deg) * np.array([0.6, 0.8, 0.0]))
    found = alignment.level(alignment.ransac_planes(hut), sense * lean @ UP)
    assert np.linalg.norm(found - sense * UP) < 0.002


@pytest.mark.parametrize(
    ("planes", "said"),
    [
        (planes_of([0, 0.002, 1], [1, 0, 0]), [0, 0, 1]),  # it fits within 0.2 deg
        (planes_of([0, 0.5, 1], [1, 0, 0]), [0, 0, 1]),  # 27 deg off
        (planes_of([1, 0, 0], [0, 1, 0]), [0, 0, 1]),  # no floor
        (planes_of([0, 0.2, 1], [0, -0.2, 1], [1, 0, 1], [-1, 0, 1]), [0, 0, 1]),  # a roof
    ],
)
def test_what_is_said_is_kept_where_no_vertical_is_near(planes, said):
    np.testing.assert_array_equal(alignment.level(planes, np.array(said, float)), said)


@pytest.mark.parametrize("azimuth_deg", [-170, -100, -46, -44, -1, 0, 30, 44, 46, 91, 179])
def test_the_smallest_turn_puts_walls_along_the_axes(azimuth_deg):
    a = np.radians(azimuth_deg)
    angles = [a, a + 0.5 * np.pi, a + 0.001, a + 0.6]
    R = rotation_to_z(UP)
    normals = np.array([[np.cos(b), np.sin(b), 0.0] for b in angles])
    turn = alignment.wall_yaw(planes_of(*(normals @ R), areas=[0.2, 0.2, 0.2, 0.3]), R)
    assert -np.pi / 4 < turn <= np.pi / 4
    assert np.abs(yaw_rotation(-turn) @ normals[0]).max() == pytest.approx(1.0, abs=1e-5)


def test_walls_at_45_degrees_turn_one_way_and_none_none():
    assert alignment.wall_yaw(planes_of([1, 1, 0]), np.eye(3)) == pytest.approx(np.pi / 4)
    assert alignment.wall_yaw(planes_of([1, -1, 0]), np.eye(3)) == pytest.approx(np.pi / 4)
    assert alignment.wall_yaw(planes_of([0, 0, 1]), np.eye(3)) is None
