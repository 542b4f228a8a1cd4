import math

import numpy as np
import pytest
import rooms

from piccolo.cloud import surfaces
from piccolo.cloud.octree import build_octree
from piccolo.cloud.surfaces import (
    FULL_SHARE,
    MIN_CELLS,
    NOISE_CELLS,
    NOISE_SHARE,
    UNKNOWN_DISPLACEMENT,
    displacement,
    residual_moments,
    share_in_full,
    surface_variance,
)

SIZE = np.array([5.0, 4.0, 2.6])  # [m] of a room turned by 20 degrees, so that no wall is along an axis
TURN = np.array([[0.9397, -0.342, 0.0], [0.342, 0.9397, 0.0], [0.0, 0.0, 1.0]])


def _room(count, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3)) * SIZE
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.integers(0, 2, count) * SIZE[axis]
    return points @ TURN.T


def _deviations(points):
    """Square roots of the variance's eigenvalues (3,) [m], and axes (3, 3), greatest last."""
    values, axes = np.linalg.eigh(surface_variance(build_octree(rooms.voxels(points))))
    return np.sqrt(np.maximum(values, 0.0)), axes


def test_clean_surfaces_have_hardly_any():
    deviations, _ = _deviations(_room(400_000))
    assert deviations.max() < 0.002


@pytest.mark.parametrize("noise", [0.01, 0.02, 0.04])
def test_a_part_of_the_noise_alike_in_all_directions(noise):
    points = _room(800_000)
    points += np.random.default_rng(1).normal(0.0, noise, points.shape)
    deviations, _ = _deviations(points)
    assert deviations.min() > 0.6 * NOISE_SHARE * noise
    assert deviations.max() < 1.4 * NOISE_SHARE * noise


def test_last_digits_are_not_those_of_a_blas_library(monkeypatch):
    octree = build_octree(rooms.voxels(_room(100_000)))
    expected = surface_variance(octree)
    fit = surfaces.fit_tensor
    monkeypatch.setattr(surfaces, "fit_tensor", lambda *cells: fit(*cells) * (1.0 + 1e-15))
    np.testing.assert_array_equal(surface_variance(octree), expected)
    assert expected.max() > 0.0


@pytest.mark.parametrize("gap", [0.03, 0.05])
def test_a_doubled_scan_has_half_the_gap_along_the_shift_alone(gap):
    """Also where the shift is along a wall, which then does not show it."""
    points = _room(800_000)
    along = TURN[:, 0]
    points[::2] += gap * along
    deviations, axes = _deviations(points)
    assert abs(axes[:, 2] @ along) > 0.94
    assert 0.5 * gap / 2 < deviations[2] < 1.15 * gap / 2
    assert deviations[1] < 0.25 * deviations[2]


def test_too_few_points_tell_nothing():
    assert _deviations(_room(300))[0].max() == 0.0


def _displacement_of_waves(height):
    """Of a noisy wall with waves of a metre, and so high [m]."""
    rng = np.random.default_rng(4)
    across = rng.uniform(-2.5, 2.5, (300_000, 2))
    waves = height * np.sin(math.tau * across).sum(axis=1)
    points = np.column_stack([across, waves + rng.normal(0.0, 0.003, len(across))])
    return displacement(build_octree(rooms.voxels(points)))


def test_surfaces_of_a_wavy_scan_are_displaced():
    """As far as it is wavy; noise, to which no size adds, is no wave."""
    assert _displacement_of_waves(0.0) < 0.003
    low = _displacement_of_waves(0.01)
    assert 0.004 < low < 0.01
    assert _displacement_of_waves(0.02) == pytest.approx(2.0 * low, rel=0.3)


def test_a_scan_without_flat_cells_has_displacements_that_nobody_knows():
    points = np.random.default_rng(5).uniform(-1.0, 1.0, (50_000, 3))
    assert displacement(build_octree(rooms.voxels(points))) == UNKNOWN_DISPLACEMENT


def thin(points, spacing):
    """Keep one point of each cube of a side [m]."""
    cubes = np.floor(points / spacing).astype(np.int64)
    return points[np.unique(cubes, axis=0, return_index=True)[1]]


@pytest.mark.parametrize("spacing", [0.05, 0.1])
def test_a_thin_scan_has_no_more_noise_for_its_corners_and_furniture(spacing):
    """Of small cells only those with several surfaces are full then; see `surface_variance`."""
    points = rooms.room(2, 400_000)[1].points.astype(np.float64)
    whole, thinned = (build_octree(rooms.voxels(some)) for some in (points, thin(points, spacing)))
    assert share_in_full(whole, *NOISE_CELLS[0]) > FULL_SHARE > share_in_full(thinned, *NOISE_CELLS[0])
    for octree in (whole, thinned):
        assert np.sqrt(np.linalg.eigvalsh(surface_variance(octree)).max()) < 0.003


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_noise_of_a_scan_with_a_point_every_10_cm_is_that_of_its_surfaces(noise):
    """Cells of 32 cm with ten leaves tell it: those of 64 cm are few, or most have several surfaces."""
    points = _room(800_000)
    points += np.random.default_rng(1).normal(0.0, noise, points.shape)
    thinned = thin(points, 0.1)
    octree = build_octree(rooms.voxels(thinned))
    assert share_in_full(octree, *NOISE_CELLS[2]) > 2.0 * share_in_full(octree, *NOISE_CELLS[1])
    assert (
        len(residual_moments(octree, *NOISE_CELLS[3])[1])
        < MIN_CELLS
        < len(residual_moments(octree, *NOISE_CELLS[2])[1])
    )
    deviations, _ = _deviations(thinned)
    assert 0.0 < deviations.max() < 0.001 + 0.6 * noise
    assert deviations.min() > 0.6 * NOISE_SHARE * noise
