import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rooms import room
from scans import bare_room

from piccolo import gravity
from piccolo.cloud.octree import build_octree
from piccolo.errors import InputError
from piccolo.geometry.pose import angle_between, exp_so3
from piccolo.gravity import estimate_normals, rotation_to_z_up
from piccolo.scenes.synthetic.buildings import BUILDINGS

Z = np.array([0.0, 0.0, 1.0])
TURNS = [np.array(w) for w in ([0.3, -0.2, 0.9], [1.4, 0.6, -0.3], [-0.7, 2.2, 1.0], [2.9, -0.5, 0.4])]
Y_UP, Z_DOWN = np.array([-np.pi / 2, 0.0, 0.0]), np.array([np.pi, 0.0, 0.0])
DIRECTIONS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda d: np.linalg.norm(d) > 1e-3)


def find_up(points, *priors):
    return gravity.find_up(estimate_normals(points), *priors)


def thinned(seed):
    return build_octree(room(seed)[1].voxels(np.eye(3))).level(0.08)[:, :3]


def turned(points, w):
    return (points @ exp_so3(w).T).astype(np.float32)


def error_deg(up, true_up):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(up, true_up)), up @ true_up))


def plane(rng, num_points, spread):
    """Points (N, 3) evenly over a slab around the origin, `spread` (3,) each way [m]."""
    return rng.uniform(-1.0, 1.0, (num_points, 3)) * spread


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("w", TURNS, ids=str)
def test_up_is_found_in_a_turned_room_as_no_convention_speaks_for_an_axis_that_is_not_z(seed, w):
    up, same = (find_up(turned(thinned(seed), w), log_odds) for log_odds in (0.0, 50.0))
    assert error_deg(up.direction_world, exp_so3(w) @ Z) < 0.5
    assert np.linalg.norm(up.direction_world) == pytest.approx(1.0)
    assert 0.5 < up.confidence <= 1.0
    assert "\n" not in up.reason
    assert (up.direction_world.tobytes(), up.confidence) == (same.direction_world.tobytes(), same.confidence)


@pytest.mark.parametrize("w", [Y_UP, Z_DOWN], ids=["y up", "z down"])
def test_a_file_whose_z_is_square_to_its_levels_is_turned_by_strong_evidence_only(w):
    points, true_up = turned(thinned(2), w), exp_so3(w) @ Z
    assert error_deg(find_up(points, 0.0).direction_world, true_up) < 0.5
    np.testing.assert_array_equal(find_up(points, 50.0).direction_world, Z)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_z_up_stays_exactly_so(seed):
    up = find_up(thinned(seed))
    np.testing.assert_array_equal(up.direction_world, Z)
    np.testing.assert_array_equal(rotation_to_z_up(up.direction_world), np.eye(3))
    assert up.confidence > 0.8


@pytest.mark.parametrize("w", [*TURNS, Y_UP, Z_DOWN], ids=str)
def test_without_the_convention_the_answer_turns_with_the_cloud(w):
    level, up = find_up(thinned(1), 0.0), find_up(turned(thinned(1), w), 0.0)
    np.testing.assert_allclose(up.direction_world, exp_so3(w) @ level.direction_world, atol=1e-3)
    assert up.confidence == pytest.approx(level.confidence, abs=0.02)
    assert level.direction_world[2] < 1.0  # as found, not rounded to +z


def test_the_convention_counts_as_much_as_it_is_given():
    points = bare_room().astype(np.float32)
    confidences = [find_up(points, log_odds).confidence for log_odds in (0.0, 3.0, 6.9)]
    assert confidences[0] < 0.4 < confidences[1] < confidences[2]


@pytest.mark.parametrize("w", TURNS, ids=str)
def test_ground_with_things_on_it_needs_no_ceiling(w):
    rng = np.random.default_rng(5)
    trees = [rng.normal([x, y, 4.0], [1.0, 1.0, 1.5], (400, 3)) for x, y in rng.uniform(-15, 15, (15, 2))]
    points = np.concatenate([plane(rng, 15_000, np.array([18.0, 18.0, 0.02])), *trees])
    up = find_up(turned(points, w))
    assert error_deg(up.direction_world, exp_so3(w) @ Z) < 0.5
    assert up.confidence > 0.8


def test_walls_at_odd_angles_tell_up_without_floor_or_ceiling():
    rng = np.random.default_rng(6)
    walls = [
        plane(rng, 2500, np.array([0.005, 3.0, 1.3])) @ exp_so3(np.array([0.0, 0.0, a])).T
        + 4.0 * np.array([np.cos(a), np.sin(a), 0.0])
        for a in (0.0, 1.0, 2.3, 3.5, 5.0)
    ]
    up = find_up(turned(np.concatenate(walls), TURNS[1]))
    assert abs(up.direction_world @ exp_so3(TURNS[1]) @ Z) > np.cos(np.radians(0.5))
    assert up.confidence < 0.5  # nothing says which end is up


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("missing", ["floor", "ceiling"])
def test_a_room_without_floor_or_ceiling_is_not_turned_over(seed, missing):
    points, z = thinned(seed), thinned(seed)[:, 2]
    points = points[z > z.min() + 0.1] if missing == "floor" else points[z < z.max() - 0.1]
    up = find_up(turned(points, TURNS[0]), 0.0)
    assert error_deg(up.direction_world, exp_so3(TURNS[0]) @ Z) < 0.5 or up.confidence < 0.75


def test_from_above_roofs_are_no_furniture():
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, 50.0, (20_000, 2))
    z = rng.normal(0.0, 0.03, len(xy))
    for at in rng.uniform(8.0, 42.0, (9, 2)):
        z[np.all(np.abs(xy - at) < [6.0, 4.0], axis=1)] += 4.0
    up = find_up(turned(np.column_stack([xy, z]), Z_DOWN), 0.0)
    assert error_deg(up.direction_world, -Z) < 1.0


def test_points_too_sparse_for_furniture_are_no_evidence():
    rng = np.random.default_rng(5)
    ground = plane(rng, 9000, np.array([400.0, 400.0, 0.02]))
    things = plane(rng, 900, np.array([400.0, 400.0, 8.0])) + np.array([0.0, 0.0, 8.0])
    sparse = find_up(np.concatenate([ground, things]).astype(np.float32))
    assert sparse.confidence == 0.0
    assert "so sparse" in sparse.reason


def test_what_could_stand_another_way_is_uncertain():
    for seed, reason in ((18, "ground and the front of a building look alike"), (16, "maybe a wall")):
        up = find_up(turned(BUILDINGS["front"](seed), TURNS[2]), 0.0)
        assert up.confidence < 0.75
        assert reason in up.reason
    points = plane(np.random.default_rng(1), 2000, np.array([0.002, 3.0, 3.0]))
    assert find_up(np.append(points, [[5.0, 0, 0]], axis=0).astype(np.float32)).confidence < 0.5
    up = find_up(turned(bare_room(), TURNS[0]))
    assert abs(up.direction_world @ exp_so3(TURNS[0]) @ Z) > np.cos(np.radians(0.5))
    assert up.confidence < 0.5


def test_a_file_of_roofs_is_not_turned_though_nothing_is_square_to_its_z():
    for seed in (10, 13, 14, 18):
        points = BUILDINGS["roof"](seed)[::2].astype(np.float32)
        up = find_up(points)
        assert up.confidence < 0.6
        assert "what is slanted to it is a roof" in up.reason
        assert "is a roof" not in find_up(points, 0.0).reason
    w = np.array([0.4, 0.0, 0.0])  # 23 deg: nothing is square to the z of a tilted room either
    up = find_up(turned(thinned(1), w))
    assert error_deg(up.direction_world, exp_so3(w) @ Z) < 0.5
    assert up.confidence > 0.8


def test_a_ceiling_is_not_the_ground_though_furniture_hides_the_floor():
    points = bare_room()
    furniture = np.random.default_rng(9).uniform([0.0, 0.0, 0.2], [4.0, 4.0, 1.1], (4000, 3))
    is_hidden = (points[:, 2] < 0.02) & (points[:, 0] < 4.2)
    up = find_up(turned(np.concatenate([points[~is_hidden], furniture]), TURNS[3]))
    assert error_deg(up.direction_world, exp_so3(TURNS[3]) @ Z) < 0.5
    assert up.confidence > 0.5


def test_by_convention_a_bare_room_has_z_up():
    points = bare_room().astype(np.float32)
    up = find_up(points)
    np.testing.assert_array_equal(up.direction_world, Z)
    assert up.confidence > 0.5
    w = np.array([0.1, 0.0, 0.0])  # 5.7 deg: the convention gives the sense, planes the direction
    assert error_deg(find_up(turned(points, w)).direction_world, exp_so3(w) @ Z) < 0.5


def test_scanners_that_agree_tell_the_axis_and_its_sense():
    points, R = turned(bare_room(), TURNS[1]), exp_so3(TURNS[1])
    leaning = exp_so3(np.array([0.05, 0.0, 0.0])) @ R
    axes = [np.array([R[:, 2], leaning[:, 2]]), np.array([-R[:, 0]] * 2), np.array([R[:, 2], -R[:, 2]])]
    first, second, split = (find_up(points, 0.0, station_axes) for station_axes in axes)
    assert error_deg(first.direction_world, R[:, 2]) < 0.5
    assert error_deg(second.direction_world, -R[:, 0]) < 0.5
    assert min(first.confidence, second.confidence) > 0.8
    assert split.confidence < 0.55
    assert "stations +5.7" in first.reason


def test_two_far_strays_change_little():
    points = np.concatenate([turned(thinned(1), TURNS[2]), np.float32([[1e9, 0, 0], [0, -1e6, 1e6]])])
    up = find_up(points)
    assert error_deg(up.direction_world, exp_so3(TURNS[2]) @ Z) < 0.5
    assert up.confidence > 0.5


@pytest.mark.parametrize("kind", ["volume", "ball", "sphere", "line", "one place", "few", "none"])
def test_no_planes_no_confidence(kind):
    rng = np.random.default_rng(8)
    normal = rng.normal(size=(20_000, 3))
    points = {
        "volume": rng.uniform(-3.0, 3.0, (20_000, 3)),
        "ball": normal,
        "sphere": 3.0 * normal / np.linalg.norm(normal, axis=1, keepdims=True),
        "line": np.linspace(0.0, 9.0, 1000)[:, None] * [1.0, 2.0, 3.0],
        "one place": np.ones((1000, 3)),
        "few": normal[:20],
        "none": np.empty((0, 3)),
    }[kind]
    up = find_up(points.astype(np.float32))
    assert up.confidence < 0.1
    assert np.linalg.norm(up.direction_world) == pytest.approx(1.0)


def test_same_points_same_bits():
    points = turned(thinned(1), TURNS[0])
    a, b = find_up(points), find_up(points.copy())
    assert a.direction_world.tobytes() == b.direction_world.tobytes()
    assert (a.confidence, a.reason) == (b.confidence, b.reason)


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros(3), np.full((9, 3), np.nan)])
def test_what_is_no_cloud_is_refused(points):
    with pytest.raises(InputError, match=r"the shape is|not finite"):
        find_up(points.astype(np.float32))


@given(DIRECTIONS)
def test_rotation_takes_the_direction_to_z_by_the_smallest_turn(direction):
    direction = np.array(direction) / np.linalg.norm(direction)
    R = rotation_to_z_up(direction)
    np.testing.assert_allclose(R @ direction, Z, atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    smallest = np.arctan2(np.hypot(*direction[:2]), direction[2])
    assert angle_between(R, np.eye(3)) == pytest.approx(smallest, abs=1e-7)


@pytest.mark.parametrize("tiny", [0.0, 1e-300, 1e-12])
def test_rotation_near_the_poles(tiny):
    np.testing.assert_allclose(rotation_to_z_up(np.array([tiny, 0.0, 1.0])), np.eye(3), atol=2e-12)
    R = rotation_to_z_up(np.array([tiny, tiny, -1.0]))
    np.testing.assert_allclose(R @ [0.0, 0.0, -1.0], Z, atol=2e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
