"""The vertical of a cloud, which end of it is up, and when that is not known."""

import numpy as np
import pytest
from rooms import room
from scans import bare_room

from piccolo.cloud.octree import build_octree
from piccolo.cloud.stream import Cloud
from piccolo.geometry.pose import exp_so3
from piccolo.gravity.alignment import find_levels, find_up, furniture_cue, passage_cue

Z = np.array([0.0, 0.0, 1.0])
TURNS = [np.array(w) for w in ([0.3, -0.2, 0.9], [1.4, 0.6, -0.3], [2.9, -0.5, 0.4])]


def up_of(points, w=(0.0, 0.0, 0.0)):
    """Up (3,) of points (N, 3) turned by a rotation vector, None if it is not known, and why."""
    points = (points @ exp_so3(np.asarray(w)).T).astype(np.float32)
    octree = build_octree(Cloud(points, np.full(points.shape, 99, np.uint8), np.zeros(3)).voxels(np.eye(3)))
    axis, sense, reason, _ = find_up(octree)
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


def test_two_far_strays_change_little():
    strays = np.float32([[1e4, 0, 0], [0, -1e4, 1e4]])
    up, _ = up_of(np.concatenate([room(1)[1].points, strays]), TURNS[0])
    assert up @ exp_so3(TURNS[0]) @ Z > np.cos(np.radians(0.5))


@pytest.mark.parametrize("w", TURNS, ids=str)
def test_a_bare_room_may_be_upside_down(w):
    up, reason = up_of(bare_room(), w)
    assert up is None
    assert reason == "floor and ceiling look alike: furniture +0.0, free ways +0.0"


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
        (roofs(), "neither level nor upright"),
        (np.random.default_rng(9).uniform(-9.0, 9.0, (50_000, 3)) * [1, 1, 1e-4], "a floor and a ceiling"),
    ],
    ids=["volume", "line", "tower", "roofs", "ground"],
)
def test_what_tells_nothing_is_not_known(points, reason):
    up, found = up_of(points, TURNS[1])
    assert up is None
    assert any(text in found for text in reason.split("|"))


def test_levels_are_a_person_apart_and_tables_are_none():
    class Planes:
        normals = np.array([Z, -Z, Z, Z, [1.0, 0.0, 0.0]])
        centers = np.array([[0, 0, 0.0], [0, 0, 2.5], [0, 0, 0.5], [0, 0, 5.0], [3, 0, 1.0]])
        areas = np.array([0.3, 0.25, 0.2, 0.05, 0.15])

    np.testing.assert_array_equal(find_levels(Planes, Z), [0.0, 2.5])
    np.testing.assert_array_equal(find_levels(Planes, -Z), [-2.5, 0.0])


def test_tables_stand_on_floors_and_what_is_higher_says_nothing():
    levels = np.array([0.0, 2.6])
    for height, sign in ((0.75, 1.0), (1.3, 0.0), (2.1, -1.0), (0.1, 0.0)):
        heights = np.append(np.repeat(levels, 500), np.full(60, height))
        cue = furniture_cue(heights, np.ones(1060, bool), levels)
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
    cue = passage_cue(
        points[:, 2], np.isin(points[:, 2], [0.0, 2.6]), np.array([0.0, 2.6]), points[:, :2].copy()
    )
    assert least < cue < least + 0.4


def test_trusses_below_a_high_ceiling_are_no_tables():
    """In a hall both cues must agree; in a room one is enough."""
    for height, is_known in ((2.6, True), (6.0, False)):
        tops = np.random.default_rng(2).uniform([1, 1, 0.7], [9, 7, 0.7], (20_000, 3))
        tables = tops[np.sin(4.0 * tops[:, 0]) > 0.5]
        up, reason = up_of(np.concatenate([box([0, 0, 0], [10, 8, height]), tables]))
        assert (up is not None) == is_known, reason
        assert not is_known or up[2] > 0.999
