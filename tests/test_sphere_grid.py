import numpy as np
import pytest

from piccolo.geometry.sphere import (
    cell_of,
    interpolation,
    make_grid,
    make_neighbors,
    whole_areas,
    wider_cells,
)


@pytest.mark.parametrize("num_rings", [12, 24, 96])
def test_cells_share_the_sphere_nearly_evenly(num_rings):
    grid = make_grid(num_rings)
    assert grid.solid_angle.sum() == pytest.approx(1.0, abs=1e-5)
    assert grid.solid_angle.max() / grid.solid_angle.min() < 2.0
    np.testing.assert_allclose(np.linalg.norm(grid.directions, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("num_rings", [12, 24])
def test_a_cells_centre_lies_in_it(num_rings):
    grid = make_grid(num_rings)
    np.testing.assert_array_equal(cell_of(grid.directions, num_rings), np.arange(len(grid)))


def test_neighbours_are_near_and_weighted_by_a_gaussian():
    near, grid = make_neighbors(24, 14.0), make_grid(24)
    for cell in (0, len(grid) // 2, len(grid) - 1):
        rows = slice(near.row[cell], near.row[cell + 1])
        angle = np.arccos(np.clip(grid.directions[near.cell[rows]] @ grid.directions[cell], -1, 1))
        assert np.degrees(angle.max()) < 2.4 * 14.0
        gaussian = np.exp((np.cos(angle) - 1) / np.radians(14.0) ** 2) * grid.solid_angle[near.cell[rows]]
        np.testing.assert_allclose(near.weight[rows], gaussian, rtol=1e-3)


@pytest.mark.parametrize(("num_rings", "coarse_rings"), [(24, 12), (96, 24), (24, 16), (12, 12)])
def test_interpolated_values_are_those_of_a_smooth_field(num_rings, coarse_rings):
    fine, coarse = make_grid(num_rings), make_grid(coarse_rings)
    cells, weights = interpolation(num_rings, coarse_rings)
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
    (cells, areas), wide = wider_cells(12), make_grid(12)
    np.testing.assert_array_equal(areas, np.rint(areas))
    np.testing.assert_array_equal(np.unique(cells), np.arange(len(wide)))
    apart = np.arccos(np.sum(wide.directions[cells] * make_grid(24).directions, axis=1))
    assert apart.max() < np.pi / 12
    area, units = make_grid(24).solid_angle, whole_areas(24)
    np.testing.assert_allclose(units, 1000 * area / area.max(), atol=0.51)
    np.testing.assert_array_equal(areas, [units[cells == k].sum() for k in range(len(wide))])
    np.testing.assert_allclose(areas / areas.sum(), wide.solid_angle, rtol=0.5)
