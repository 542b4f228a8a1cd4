import numpy as np
import pytest

from piccolo.confidence.covariance import PoseCovariance, least_constrained_direction
from piccolo.geometry.pose import exp_so3

BOX = np.random.default_rng(3).uniform(-1, 1, (2, 4000))


def _words(std_ratio=3.0, tilt_deg=0.0, reach=12.0, elevation_deg=0.0, turn=0.0):
    """Words for a camera least sure along heading 50 deg, in a cloud `reach` times as long that way."""
    R = exp_so3(np.array([0.0, 0.0, np.radians(40.0)]))
    direction = R @ exp_so3(np.array([0.0, -np.radians(tilt_deg), 0.0]))[:, 0]
    covariance = 1e-6 * (np.eye(3) + (std_ratio**2 - 1.0) * np.outer(direction, direction))
    x, y = BOX * [[reach], [1.0]]
    seen = R @ np.stack([x, y, np.tan(np.radians(elevation_deg)) * np.hypot(x, y)])
    R_world_from_map = exp_so3(np.array([0.0, 0.0, turn]))
    in_world = R_world_from_map @ covariance @ R_world_from_map.T
    return least_constrained_direction(covariance, in_world, seen.astype(np.float32))


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"std_ratio": 1.45}, "much the same in all directions"),
        ({"std_ratio": 1.55}, "along the corridor, heading 50 or 230 deg"),
        ({"tilt_deg": 61.0}, "up and down"),
        ({"tilt_deg": 59.0}, "along the corridor, heading 50 or 230 deg"),
        ({"reach": 2.4}, "heading 50 or 230 deg"),
        ({"reach": 2.6}, "along the corridor, heading 50 or 230 deg"),
        ({"elevation_deg": 31.0}, "heading 50 or 230 deg"),  # no walls
        ({"elevation_deg": 29.0}, "along the corridor, heading 50 or 230 deg"),
        (
            {"turn": np.radians(-90.0)},
            "along the corridor, heading 140 or 320 deg",
        ),  # the world's, not the map's
    ],
)
def test_direction_in_words(case, expected):
    assert _words(**case) == expected


def test_deviations():
    covariance = PoseCovariance(np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6]), "")
    np.testing.assert_allclose(covariance.std_deg, np.degrees([0.01, 0.02, 0.03]))
    np.testing.assert_allclose(covariance.std_mm, [1.0, 2.0, 3.0])
    assert np.isclose(covariance.largest_std, 0.003)
