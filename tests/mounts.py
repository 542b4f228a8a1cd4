"""A mount that is not the identity, and the poses of the body that carries the camera."""

import numpy as np

from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation

ORIGIN = np.array([500_000.0, 5_400_000.0, 300.0])
MOUNT = Pose(exp_so3(np.radians([1.2, -1.2, 1.1])), np.array([0.06, -0.05, 0.06]))  # 2 degrees, 10 cm


def body_at(time):
    """A walk in curves, with a nod."""
    nod = 0.5 + 0.15 * np.sin(1.3 * time)
    turn = exp_so3(np.array([0.1 * np.sin(2.1 * time), nod, 0.0])) @ yaw_rotation(1.0 + np.sin(0.7 * time))
    place = np.array([3.0 * np.cos(0.4 * time), 3.0 * np.sin(0.4 * time), 0.1 * np.sin(time)])
    return Pose(turn, ORIGIN + place)
