"""How far a pose is from the true one, and what counts as correct."""

import math

import numpy as np

from .pose import Pose, angle_between

MAX_DISTANCE, MAX_ANGLE = 0.1, math.radians(5.0)  # the paper's line between correct and wrong [m], [rad]


def pose_errors(pose: Pose, true_pose: Pose) -> tuple[float, float]:
    """Position error [m] and rotation error [rad]."""
    distance = float(np.linalg.norm(pose.center_world - true_pose.center_world))
    return distance, angle_between(pose.R_cam_from_world, true_pose.R_cam_from_world)


def is_correct(pose: Pose | None, true_pose: Pose) -> bool:
    """True for a pose that counts as correct in the paper."""
    if pose is None:
        return False
    distance, angle = pose_errors(pose, true_pose)
    return distance < MAX_DISTANCE and angle < MAX_ANGLE
