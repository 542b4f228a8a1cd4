import numpy as np

from piccolo.confidence.covariance import PoseCovariance, least_constrained_direction
from piccolo.geometry.pose import exp_so3

RNG = np.random.default_rng(3)
LONG = (RNG.uniform(-1, 1, (3, 4000)) * np.array([[12.0], [1.1], [1.3]])).astype(np.float32)  # along x
WIDE = (RNG.uniform(-1, 1, (3, 4000)) * np.array([[5.0], [5.0], [1.3]])).astype(np.float32)
ALONG_X, UP = np.diag([9e-6, 1e-6, 1e-6]), np.diag([1e-6, 1e-6, 9e-6])


def test_direction_in_words():
    assert least_constrained_direction(UP, UP, LONG) == "up and down"
    assert least_constrained_direction(np.eye(3), np.eye(3), LONG) == "much the same in all directions"
    assert least_constrained_direction(ALONG_X, ALONG_X, LONG) == "along the corridor, heading 90 or 270 deg"
    assert least_constrained_direction(ALONG_X, ALONG_X, WIDE) == "heading 90 or 270 deg"
    above = np.array([[0.1], [0.1], [3.0]], np.float32)  # no walls
    assert least_constrained_direction(ALONG_X, ALONG_X, above) == "heading 90 or 270 deg"


def test_heading_is_the_worlds_not_the_maps():
    R_world_from_map = exp_so3(np.array([0.0, 0.0, np.radians(90.0)]))  # the map's x is the world's y
    in_world = R_world_from_map @ ALONG_X @ R_world_from_map.T
    words = least_constrained_direction(ALONG_X, in_world, LONG)
    assert words in ("along the corridor, heading 0 or 180 deg", "along the corridor, heading 180 or 360 deg")


def test_deviations():
    covariance = PoseCovariance(np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6]), "")
    np.testing.assert_allclose(covariance.std_deg, np.degrees([0.01, 0.02, 0.03]))
    np.testing.assert_allclose(covariance.std_mm, [1.0, 2.0, 3.0])
    assert np.isclose(covariance.largest_std, 0.003)
