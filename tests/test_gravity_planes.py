"""Dominant planes, what they are called, up as they agree on it, and the walls' direction."""

import numpy as np
import pytest

from piccolo.geometry.pose import exp_so3, yaw_rotation
from piccolo.gravity.planes import (
    Plane,
    PointNormals,
    classify_planes,
    estimate_normals,
    manhattan_yaw,
    ransac_planes,
    refine_up,
)
from piccolo.gravity.up import rotation_to_z_up

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
    return estimate_normals((np.concatenate(parts) @ TURN.T + [7.0, -3.0, 2.0]).astype(np.float32))


def test_every_plane_is_found_and_called_by_its_name(hut):
    planes = classify_planes(ransac_planes(hut), hut, UP)
    assert [plane.num_inliers for plane in planes] == sorted((p.num_inliers for p in planes), reverse=True)
    kinds = [plane.kind for plane in planes]
    assert sorted(kinds) == ["ceiling", "floor", "platform", "slanted", "wall", "wall"]
    height_of_origin = float(UP @ [7.0, -3.0, 2.0])
    for kind, height in (("floor", 0.0), ("platform", 0.8), ("ceiling", 2.5)):
        plane = planes[kinds.index(kind)]
        np.testing.assert_allclose(plane.normal_world, UP, atol=0.003)
        assert plane.offset == pytest.approx(height + height_of_origin, abs=0.02)
        assert 0.002 < plane.rms < 0.005
    assert sum(plane.fraction for plane in planes) == pytest.approx(1.0, abs=0.1)
    assert planes[0].num_inliers == pytest.approx(24 * 400, rel=0.05)


def test_names_turn_over_with_up_and_noise_has_no_planes(hut):
    kinds = [plane.kind for plane in classify_planes(ransac_planes(hut), hut, -UP)]
    assert kinds[0] == "ceiling"
    a, b = ransac_planes(hut), ransac_planes(hut)
    bits = [[(p.normal_world.tobytes(), p.offset, p.rms) for p in planes] for planes in (a, b)]
    assert bits[0] == bits[1]
    points = np.random.default_rng(2).uniform(-3.0, 3.0, (9000, 3)).astype(np.float32)
    assert ransac_planes(estimate_normals(points)) == []
    assert ransac_planes(estimate_normals(points[:10])) == []


def plane(normal, fraction=0.2, rms=0.003, kind="wall"):
    return Plane(np.asarray(normal, float) / np.linalg.norm(normal), 1.0, 1000, fraction, rms, kind)


def test_planes_correct_up_and_plumb_walls_count_more_than_uneven_ground(hut):
    askew = exp_so3(np.array([0.004, 0.002, 0.0])) @ UP
    refined, spread = refine_up(askew, ransac_planes(hut))
    assert np.linalg.norm(refined - UP) < 0.001 < np.linalg.norm(askew - UP)
    assert 0.0 < spread < 0.002
    up = np.array([0.0, 0.01, 1.0]) / np.hypot(1.0, 0.01)
    walls = [plane([1, 0, 0], 0.1), plane([0, 1, 0], 0.1)]
    refined, spread = refine_up(up, [plane([0.0, 0.02, 1.0], 0.4, rms=0.1), *walls])
    assert np.degrees(np.arccos(refined[2])) < 0.1
    assert spread > 0.0


def test_what_has_no_say_changes_nothing():
    up = np.array([0.0, 0.0, 1.0])
    assert refine_up(up, [])[1] is None
    for planes in ([plane([1, 0, 0.001])], [plane([1, 0, 1])]):
        refined, spread = refine_up(up, planes)
        np.testing.assert_array_equal(refined, up)
        assert spread is None
    refined, spread = refine_up(up, [plane([0.01, 0, 1])])
    assert (refined[0] > 0.009, spread) == (True, None)
    far = refine_up(up, [plane([0.03, 0.0, 1.0])])[0]  # 1.7 deg
    np.testing.assert_array_equal(far, up)


@pytest.mark.parametrize("azimuth_deg", [-170, -100, -46, -44, -1, 0, 30, 44, 46, 91, 179])
def test_the_smallest_turn_puts_walls_along_the_axes(azimuth_deg):
    a = np.radians(azimuth_deg)
    along = [plane([np.cos(a + k), np.sin(a + k), 0.0]) for k in (0.0, 0.5 * np.pi, 0.001)]
    odd = plane([np.cos(a + 0.6), np.sin(a + 0.6), 0.0], 0.3)
    R = rotation_to_z_up(UP)
    scan = [Plane(R.T @ p.normal_world, 0.0, 10, p.fraction, 0.0, "wall") for p in [*along, odd]]
    turn = manhattan_yaw(scan, R)
    assert -np.pi / 4 < turn <= np.pi / 4
    normal = yaw_rotation(-turn) @ along[0].normal_world
    assert np.abs(normal).max() == pytest.approx(1.0, abs=1e-5)


def test_walls_at_45_degrees_turn_one_way_and_none_none():
    assert manhattan_yaw([plane([1.0, 1.0, 0.0])], np.eye(3)) == pytest.approx(np.pi / 4)
    assert manhattan_yaw([plane([1.0, -1.0, 0.0])], np.eye(3)) == pytest.approx(np.pi / 4)
    assert manhattan_yaw([plane([0, 0, 1], kind="floor")], np.eye(3)) is None


def test_estimate_normals_too_few_points_have_no_reach():
    found = estimate_normals(np.zeros((5, 3), np.float32))
    assert isinstance(found, PointNormals)
    assert not found.is_flat.any()
    assert found.neighborhood_radius == np.inf
