import math

import naive
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from piccolo.geometry import sphere
from piccolo.geometry.pose import exp_so3

TILTED = exp_so3(np.array([0.4, -1.1, 0.7]))
CENTER = np.array([0.3, -0.2, 1.5])
WIDTH = 2048
RAYS = sphere.pixel_rays(WIDTH)


def _pixels(points, R_cam_from_world=TILTED, center_world=CENTER, width=WIDTH):
    x_cam = ((points - center_world) @ R_cam_from_world.T).astype(np.float32)
    rho = np.hypot(x_cam[:, 0], x_cam[:, 1])
    pixel = sphere.direction_to_pixel
    return np.array([pixel(*p, r, np.float32(width)) for p, r in zip(x_cam, rho, strict=True)])


def test_pixel_of_a_direction_equals_its_twin():
    points = np.random.default_rng(0).normal(size=(5_000, 3)) * [5, 4, 2]
    points = points.astype(np.float32)
    difference = np.abs(_pixels(points) - naive.project(points, TILTED, CENTER, WIDTH))
    difference[:, 0] = np.minimum(difference[:, 0], WIDTH - difference[:, 0])
    # float32: a point near a pole moves far in u by rounding, so u is judged by the arc it spans
    x_cam = (points - CENTER) @ TILTED.T
    sine = np.hypot(x_cam[:, 0], x_cam[:, 1]) / np.linalg.norm(x_cam, axis=1)
    assert (difference[:, 0] * sine).max() < 2e-3
    assert difference[:, 1].max() < 2e-3


def test_arctangent_polynomial_error():
    angles = np.linspace(-np.pi, np.pi, 100_001)[1:]
    x = np.cos(angles).astype(np.float32)
    y = np.sin(angles).astype(np.float32)
    ours = np.array([sphere.atan2(b, a) for a, b in zip(x[::50], y[::50], strict=True)], dtype=np.float64)
    theirs = np.arctan2(y[::50].astype(np.float64), x[::50].astype(np.float64))
    assert np.abs(ours - theirs).max() < 6e-7
    assert sphere.atan2(np.float32(0), np.float32(0)) == 0.0


def test_seam_has_both_sides():
    left = _pixels(np.array([[-1.0, 1e-4, 0.0]]), np.eye(3), np.zeros(3))[0, 0]
    right = _pixels(np.array([[-1.0, -1e-4, 0.0]]), np.eye(3), np.zeros(3))[0, 0]
    assert 0 <= left < 0.1
    assert WIDTH - 0.1 < right < WIDTH


@given(st.integers(0, WIDTH - 1), st.integers(0, WIDTH // 2 - 1))
@settings(max_examples=100)
def test_pixel_to_ray_to_pixel(column, row):
    ray = RAYS[row, column]
    pixel = _pixels(ray[None] * 3.0, np.eye(3), np.zeros(3))[0]
    sine = math.cos((0.5 - (row + 0.5) / (WIDTH // 2)) * math.pi)
    assert abs(pixel[0] - (column + 0.5)) * sine < 1e-3
    assert abs(pixel[1] - (row + 0.5)) < 1e-3


def test_solid_angles_sum_to_the_sphere_and_jacobians_are_finite_at_a_pole():
    assert 512 * sphere.solid_angles(512).sum() == pytest.approx(4 * math.pi)
    row = sphere.solid_angles(512)
    assert row[0] == pytest.approx((1 - math.cos(math.pi / 256)) * 2 * math.pi / 512)
    zero = np.float32(0)
    for z in (zero, np.float32(1)):
        assert np.isfinite(sphere.pixel_jacobian(zero, zero, z, zero, np.float32(WIDTH))).all()


@pytest.mark.parametrize("where", ["anywhere", "seam", "zenith", "nadir"])
def test_pixel_jacobian_against_central_differences(where):
    rng = np.random.default_rng(1)
    base = {"anywhere": (1, 2, 0.5), "seam": (-2, 0, 0.3), "zenith": (0, 0, 2), "nadir": (0, 0, -2)}[where]
    for p in np.array(base) + rng.normal(size=(50, 3)) * 0.05:
        ux, uy, vx, vy, vz = sphere.pixel_jacobian(*p, p[0] ** 2 + p[1] ** 2, float(WIDTH))
        numbers = np.empty((2, 3))
        for axis in range(3):
            h = 1e-6 * np.eye(3)[axis]
            ahead, behind = (naive.project((p + s)[None], np.eye(3), np.zeros(3), WIDTH)[0] for s in (h, -h))
            difference = ahead - behind
            difference[0] -= WIDTH * np.round(difference[0] / WIDTH)
            numbers[:, axis] = difference / 2e-6
        np.testing.assert_allclose(numbers, [[ux, uy, 0.0], [vx, vy, vz]], rtol=1e-4, atol=1e-2)


def test_pixel_centres_come_back_from_their_rays():
    for width in (32, 250):
        u, v = sphere.compute_pixels(sphere.pixel_rays(width), width)
        np.testing.assert_allclose(u, np.broadcast_to(np.arange(width) + 0.5, u.shape), atol=1e-9)
        np.testing.assert_allclose(v[:, 0], np.arange(width // 2) + 0.5, atol=1e-9)
        rows, columns = sphere.compute_indices(sphere.pixel_rays(width), width)
        assert np.array_equal(columns[0], np.arange(width))
        assert np.array_equal(rows[:, 0], np.arange(width // 2))
    rows, columns = sphere.compute_indices(np.array([[0.0, 0, 1], [0, 0, -1], [-1, 0, 0], [-1, -0.0, 0]]), 8)
    assert rows.tolist() == [0, 3, 2, 2]
    assert set(columns[2:]) <= {0, 7}


@pytest.mark.parametrize("num_rings", [12, 24, 96])
def test_cells_share_the_sphere_nearly_evenly(num_rings):
    grid = sphere.make_grid(num_rings)
    assert grid.solid_angle.sum() == pytest.approx(1.0, abs=1e-5)
    assert grid.solid_angle.max() / grid.solid_angle.min() < 2.0
    np.testing.assert_allclose(np.linalg.norm(grid.directions, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("num_rings", [12, 24])
def test_a_cells_centre_lies_in_it(num_rings):
    grid = sphere.make_grid(num_rings)
    np.testing.assert_array_equal(sphere.find_cell(grid.directions, num_rings), np.arange(len(grid)))


def test_neighbours_are_near_and_weighted_by_a_gaussian():
    near = sphere.make_neighbors(24, 14.0)
    grid = sphere.make_grid(24)
    for cell in (0, len(grid) // 2, len(grid) - 1):
        rows = slice(near.row[cell], near.row[cell + 1])
        angle = np.arccos(np.clip(grid.directions[near.cell[rows]] @ grid.directions[cell], -1, 1))
        assert np.degrees(angle.max()) < 2.4 * 14.0
        gaussian = np.exp((np.cos(angle) - 1) / np.radians(14.0) ** 2) * grid.solid_angle[near.cell[rows]]
        np.testing.assert_allclose(near.weight[rows], gaussian, rtol=1e-3)


@pytest.mark.parametrize(("num_rings", "coarse_rings"), [(24, 12), (96, 24), (24, 16), (12, 12)])
def test_interpolated_values_are_those_of_a_smooth_field(num_rings, coarse_rings):
    fine, coarse = sphere.make_grid(num_rings), sphere.make_grid(coarse_rings)
    cells, weights = sphere.interpolation(num_rings, coarse_rings)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert weights.min() >= 0.0
    width = np.pi / coarse_rings
    for axis in np.eye(3):
        found = (weights * (coarse.directions @ axis)[cells]).sum(axis=1)
        off = np.abs(found - fine.directions @ axis)
        assert np.median(off) < width**2 / 8
        assert off.max() < width / 4  # three cells around a pole
    apart = np.arccos(np.clip((coarse.directions[cells] * fine.directions[:, None]).sum(axis=2), -1.0, 1.0))
    assert (apart[weights > 1e-6]).max() < 2.0 * width


def test_wider_cells_add_up_the_solid_angle_in_whole_numbers():
    (cells, areas) = sphere.wider_cells(12)
    wide = sphere.make_grid(12)
    np.testing.assert_array_equal(areas, np.rint(areas))
    np.testing.assert_array_equal(np.unique(cells), np.arange(len(wide)))
    apart = np.arccos(np.sum(wide.directions[cells] * sphere.make_grid(24).directions, axis=1))
    assert apart.max() < np.pi / 12
    area = sphere.make_grid(24).solid_angle
    units = sphere.whole_areas(24)
    np.testing.assert_allclose(units, 1000 * area / area.max(), atol=0.51)
    np.testing.assert_array_equal(areas, [units[cells == k].sum() for k in range(len(wide))])
    np.testing.assert_allclose(areas / areas.sum(), wide.solid_angle, rtol=0.5)
