"""Errors of poses that a photo does not fix."""

import functools

import numpy as np
import pytest
import rooms

from piccolo.evidence.covariance import estimate_covariance, sandwich_covariance
from piccolo.evidence.examine import examine
from piccolo.evidence.loose_covariance import FLAT_DEVIATION, estimate_loosely, loose_covariance

TIER = "scene"

SEED = 2
RANGE = 2.5  # [m]


@functools.lru_cache
def _narrow():
    """A photo of 65 degrees as it is asked for in the map, and its true pose there."""
    ((panorama, pose),) = rooms.take_photos(SEED, 65.0, {3.0: (0.1, 0.2, 0.1)}, 1024)
    scan_map = rooms.scan_map(SEED)
    return rooms.ask(panorama, scan_map, rooms.KNOWN), scan_map.from_world(pose)


def _draw(seed):
    """A Hessian (6, 6) whose directions are alike as angles, its axes there, and gradients (30, 6)."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    units = np.repeat([1.0, 1.0 / RANGE], 3)
    gradients = rng.normal(size=(30, 6)) * units
    return axes, units, gradients


def _hessian(axes, units, curvatures):
    return units[:, None] * ((axes * curvatures) @ axes.T) * units


def test_where_a_photo_fixes_its_pose_the_errors_are_those_of_the_sandwich():
    axes, units, gradients = _draw(1)
    hessian = _hessian(axes, units, [1.0, 2.0, 5.0, 9.0, 20.0, 30.0])
    num_flat, covariance = loose_covariance(hessian, gradients, 1.7, RANGE)
    assert num_flat == 0
    np.testing.assert_allclose(covariance, 1.7 * sandwich_covariance(hessian, gradients), rtol=1e-9)


@pytest.mark.parametrize("flat", [0.0, -3.0])
def test_a_direction_in_which_the_loss_does_not_rise_is_left_open(flat):
    axes, units, gradients = _draw(2)
    num_flat, covariance = loose_covariance(
        _hessian(axes, units, [flat, 2.0, 5.0, 9.0, 20.0, 30.0]), gradients, 1.0, RANGE
    )
    along = units * axes[:, 0]  # its variance is that of an angle: moves count as seen from the range
    assert num_flat == 1
    assert along @ covariance @ along == pytest.approx(FLAT_DEVIATION**2)
    others = (units[:, None] * axes[:, 1:]).T @ covariance @ (units[:, None] * axes[:, 1:])
    full = loose_covariance(_hessian(axes, units, [1.0, 2.0, 5.0, 9.0, 20.0, 30.0]), gradients, 1.0, RANGE)[1]
    expected = (units[:, None] * axes[:, 1:]).T @ full @ (units[:, None] * axes[:, 1:])
    np.testing.assert_allclose(others, expected, rtol=1e-9)


def test_what_a_photo_shows_well_has_about_the_usual_errors():
    problem, true_pose = _narrow()
    candidate = examine(problem, true_pose)
    loose = estimate_loosely(problem, candidate)
    usual = estimate_covariance(problem, candidate, rooms.WORKERS).gaussian
    assert loose.pose is true_pose
    ratio = loose.largest_std / usual.largest_std
    assert 0.5 < ratio < 2.0


def test_a_grey_photo_tells_nothing():
    problem, true_pose = _narrow()
    blank = rooms.as_panorama(np.full((256, 512, 3), 127, np.uint8))
    grey = rooms.ask(blank, problem.scan_map)
    assert estimate_loosely(grey, examine(grey, true_pose)) is None
