"""Pose covariance and its least constrained direction."""

import math
from dataclasses import dataclass

import numpy as np

from ..geometry.pose import ByValue
from ..geometry.pose_gaussian import PoseGaussian, largest_std, turn_positions
from ..system.arrays import Array

SAME_STD_RATIO = 1.5  # deviations whose ratio is less are much the same in all directions


@dataclass(frozen=True, eq=False)
class PoseCovariance(ByValue):
    """Covariance (6, 6) of a pose: rotation [rad] about the camera's axes, then translation [m] in the world.

    The true pose is R_true = exp([w]x) R_cam_from_world, center_true = center_world + d, with (w, d) of mean
    zero and this covariance.
    """

    matrix: Array
    least_constrained_direction: str  # of the translation, in words

    @property
    def std_deg(self) -> Array:
        """Standard deviations (3,) of the rotation about the camera's axes [deg]."""
        return np.asarray(np.degrees(np.sqrt(np.diag(self.matrix)[:3])))

    @property
    def std_mm(self) -> Array:
        """Standard deviations (3,) of the position along the world's axes [mm]."""
        return np.asarray(1000.0 * np.sqrt(np.diag(self.matrix)[3:]))

    @property
    def largest_std(self) -> float:
        """Standard deviation of the position in its least constrained direction [m]."""
        return largest_std(self.matrix)


def describe_errors(found: PoseGaussian | None, R_world_from_map: Array) -> PoseCovariance | None:
    """Return the covariance in the world of a pose in a map, whose z is up; None for None."""
    if found is None:
        return None
    in_map = found.covariance
    in_world = turn_positions(in_map, R_world_from_map)
    words = least_constrained_direction(in_map[3:, 3:], in_world[3:, 3:])
    return PoseCovariance(0.5 * (in_world + in_world.T), words)


def least_constrained_direction(covariance_up: Array, covariance: Array) -> str:
    """Return the direction of the largest translational deviation, in words.

    Both are covariances (3, 3) of the position: `covariance_up` in a frame whose z is up, `covariance` in the
    world. Headings are clockwise from +y.
    """
    variances, axes = np.linalg.eigh(covariance_up)
    if variances[2] < SAME_STD_RATIO**2 * max(variances[0], 0.0):
        return "much the same in all directions"
    direction = axes[:, 2]
    if abs(direction[2]) > math.cos(math.radians(30.0)):
        return "up and down"
    _, axes_world = np.linalg.eigh(covariance)
    heading = math.degrees(math.atan2(axes_world[0, 2], axes_world[1, 2])) % 180.0
    return f"along heading {heading:.0f}/{heading + 180.0:.0f} deg"
