"""Rotations to try, and other tools' camera axes and angles. Ours: +x the image centre, +y left, +z up.

A matrix other_from_cam takes our camera coordinates to theirs: R_other_from_world = other_from_cam @
R_cam_from_world; the camera's position does not change.
"""

import math
from functools import lru_cache
from typing import Literal

import numpy as np

from ..arrays import Array
from .pose import Pose, exp_so3, rotation_from_quaternion_wxyz, yaw_rotation

# of a query: known: the camera is upright, up to yaw; unknown: any rotation; auto: both are tried
Gravity = Literal["auto", "known", "unknown"]

# Psi, the real root of x^4 = x + 4 (Alexa, "Super-Fibonacci Spirals: Fast,
# Low-Discrepancy Sampling of SO(3)", CVPR 2022).
SUPER_FIBONACCI_PSI = 1.533751168755204288118041
OPTICAL_FROM_CAM = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # right, down, forward
OPENGL_FROM_CAM = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # right, up, back
CAMERA_AXES = {"optical": OPTICAL_FROM_CAM, "piccolo": np.eye(3)}  # by the name in the options
DECIMALS = 9  # of degrees


def uniform_yaws(num_rotations: int) -> Array:
    """Return R_cam_from_world (num_rotations, 3, 3) of an upright camera at evenly spaced yaws."""
    return np.stack([yaw_rotation(2.0 * math.pi * k / num_rotations) for k in range(num_rotations)])


@lru_cache(maxsize=4)
def uniform_rotations(num_rotations: int) -> Array:
    """Return rotations (num_rotations, 3, 3) spread evenly over SO(3) by the super-Fibonacci spiral."""
    s = np.arange(num_rotations) + 0.5
    r = np.sqrt(s / num_rotations)
    R = np.sqrt(1.0 - s / num_rotations)
    alpha = 2.0 * np.pi * s / math.sqrt(2.0)
    beta = 2.0 * np.pi * s / SUPER_FIBONACCI_PSI
    quaternions = np.stack([r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)], axis=1)
    rotations = np.stack([rotation_from_quaternion_wxyz(q) for q in quaternions])
    rotations.flags.writeable = False  # it is kept for the next query
    return rotations


def turn_axes(pose: Pose, other_from_cam: Array) -> Pose:
    """Return the pose with its rotation to another tool's camera axes, by `other_from_cam` (3, 3)."""
    return Pose(other_from_cam @ pose.R_cam_from_world, pose.center_world)


def translation(pose: Pose) -> Array:
    """Return the t (3,) of x_cam = R x_world + t."""
    return np.asarray(-pose.R_cam_from_world @ pose.center_world)


def R_cam_from_angles(heading_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Return R_cam_from_world (3, 3) of the angles [deg] that `heading_pitch_roll_deg` returns."""
    yaw = exp_so3(np.radians([0.0, 0.0, 90.0 - heading_deg]))
    pitch = exp_so3(np.radians([0.0, -pitch_deg, 0.0]))
    roll = exp_so3(np.radians([roll_deg, 0.0, 0.0]))
    return np.asarray((yaw @ pitch @ roll).T)


def heading_pitch_roll_deg(pose: Pose) -> tuple[float, float, float]:
    """Return heading in [0, 360), pitch in [-90, 90], roll in (-180, 180] [deg], as Photo Sphere XMP does.

    Heading is that of the image centre, clockwise from the world's +y; pitch is its elevation above the
    horizon; as roll grows the camera's right side goes down: the horizon turns counterclockwise in the image:
    R_world_from_cam = R_z(90 deg - heading) R_y(-pitch) R_x(roll).
    https://developers.google.com/streetview/spherical-metadata
    """
    forward, left, up = pose.R_cam_from_world  # the camera's axes in the world
    heading = np.arctan2(forward[0], forward[1])
    pitch = np.arctan2(forward[2], np.hypot(forward[0], forward[1]))
    # Against the level left of this very heading: right at the zenith too, where any heading would do.
    level_left = np.array([-np.cos(heading), np.sin(heading), 0.0])
    roll = np.arctan2(-up @ level_left, left @ level_left)
    rounded = [round(float(np.degrees(angle)), DECIMALS) for angle in (heading, pitch, roll)]
    return rounded[0] % 360.0, rounded[1], 180.0 if rounded[2] == -180.0 else rounded[2]
