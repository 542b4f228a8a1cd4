"""Rotations to try: upright at even yaws, spread evenly over SO(3), or drawn from it."""

import math
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .pose import rotation_from_quaternion_wxyz, yaw_rotation

# of a query: known: the camera is upright, up to yaw; unknown: any rotation; auto: both are tried
Gravity = Literal["auto", "known", "unknown"]

# Psi, the real root of x^4 = x + 4 (Alexa, "Super-Fibonacci Spirals: Fast,
# Low-Discrepancy Sampling of SO(3)", CVPR 2022).
SUPER_FIBONACCI_PSI = 1.533751168755204288118041


def uniform_yaws(num_rotations: int) -> NDArray[np.float64]:
    """R_cam_from_world (num_rotations, 3, 3) of an upright camera at evenly spaced yaws."""
    return np.stack([yaw_rotation(2.0 * math.pi * k / num_rotations) for k in range(num_rotations)])


@lru_cache(maxsize=4)
def uniform_rotations(num_rotations: int) -> NDArray[np.float64]:
    """Rotations (num_rotations, 3, 3) spread evenly over SO(3) by the super-Fibonacci spiral."""
    s = np.arange(num_rotations) + 0.5
    r, R = np.sqrt(s / num_rotations), np.sqrt(1.0 - s / num_rotations)
    alpha, beta = 2.0 * np.pi * s / math.sqrt(2.0), 2.0 * np.pi * s / SUPER_FIBONACCI_PSI
    quaternions = np.stack([r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)], axis=1)
    rotations = np.stack([rotation_from_quaternion_wxyz(q) for q in quaternions])
    rotations.flags.writeable = False  # it is kept for the next query
    return rotations


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """A rotation (3, 3) drawn evenly from SO(3) (Shoemake, 1992: a normalised Gaussian quaternion)."""
    quaternion = rng.normal(size=4)
    return rotation_from_quaternion_wxyz(quaternion / np.linalg.norm(quaternion))
