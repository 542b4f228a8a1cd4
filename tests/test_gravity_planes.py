"""Dominant planes, the vertical by them near what is said, and the walls' direction."""

import numpy as np
import pytest

from piccolo.geometry.pose import exp_so3, rotation_to_z, yaw_rotation
from piccolo.gravity.alignment import Planes, estimate_normals, level, ransac_planes, wall_yaw

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


def test_every_plane_is_found_the_largest_first(hut):
    planes = ransac_planes(hut)
    assert (np.diff(planes.areas) <= 0.0).all()
    assert planes.areas.sum() == pytest.approx(1.0, abs=0.1)
    sines = np.abs(planes.normals @ UP)
    assert [np.count_nonzero(sines > 0.999), np.count_nonzero(sines < 0.03), len(sines)] == [3, 2, 6]
    heights = (planes.centers[sines > 0.999] - [7.0, -3.0, 2.0]) @ UP
    np.testing.assert_allclose(sorted(heights), [0.0, 0.8, 2.5], atol=0.02)


def test_same_points_same_planes_and_noise_has_none(hut):
    a, b = ransac_planes(hut), ransac_planes(hut)
    assert all(own.tobytes() == other.tobytes() for own, other in zip(a, b, strict=True))
    points = np.random.default_rng(2).uniform(-3.0, 3.0, (9000, 3)).astype(np.float32)
    for few in (points, points[:10], points[:1]):
        assert ransac_planes(estimate_normals(few)).normals.shape == (0, 3)


def planes_of(*normals, areas=None):
    normals = np.array(normals, float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Planes(normals, np.zeros_like(normals), np.array(areas or [1.0 / len(normals)] * len(normals)))


@pytest.mark.parametrize("lean_deg", [0.5, 3.0, 14.0])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_vertical_near_what_is_said_keeps_its_sense(hut, lean_deg, sense):
    lean = exp_so3(np.radians(lean_deg) * np.array([0.6, 0.8, 0.0]))
    found = level(ransac_planes(hut), sense * lean @ UP)
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
    np.testing.assert_array_equal(level(planes, np.array(said, float)), said)


@pytest.mark.parametrize("azimuth_deg", [-170, -100, -46, -44, -1, 0, 30, 44, 46, 91, 179])
def test_the_smallest_turn_puts_walls_along_the_axes(azimuth_deg):
    a = np.radians(azimuth_deg)
    angles = [a, a + 0.5 * np.pi, a + 0.001, a + 0.6]
    R = rotation_to_z(UP)
    normals = np.array([[np.cos(b), np.sin(b), 0.0] for b in angles])
    turn = wall_yaw(planes_of(*(normals @ R), areas=[0.2, 0.2, 0.2, 0.3]), R)
    assert -np.pi / 4 < turn <= np.pi / 4
    assert np.abs(yaw_rotation(-turn) @ normals[0]).max() == pytest.approx(1.0, abs=1e-5)


def test_walls_at_45_degrees_turn_one_way_and_none_none():
    assert wall_yaw(planes_of([1, 1, 0]), np.eye(3)) == pytest.approx(np.pi / 4)
    assert wall_yaw(planes_of([1, -1, 0]), np.eye(3)) == pytest.approx(np.pi / 4)
    assert wall_yaw(planes_of([0, 0, 1]), np.eye(3)) is None
