"""Cones of directions: what lies outside of the one that a photo shows need not be looked at."""

import math
from typing import NamedTuple

import numpy as np

from ..system.arrays import Array, Floats, Mask
from ..system.kernels.jit import F0, Scalar, inline_kernel


class Cone(NamedTuple):
    """The directions within an angle of an axis, in any frame; kernels take it, and it is hashable."""

    x: float  # of the axis, a unit vector
    y: float
    z: float
    cos_angle: float  # -2 for the whole sphere

    @property
    def axis(self) -> Array:
        """Return the axis (3,)."""
        return np.array(self[:3])

    def contains(self, rays: Floats) -> Mask:
        """Return True for each of the unit directions (N, 3) that lies in the cone."""
        return np.asarray(rays @ self.axis.astype(rays.dtype) >= self.cos_angle)

    def turn(self, R_target_from_source: Floats) -> "Cone":
        """Return the cone in another frame, given the rotation (3, 3)."""
        return cone_about(R_target_from_source @ self.axis, self.cos_angle)

    def widen(self, angle: float) -> "Cone":
        """Return the cone with a half angle larger by `angle` [rad]."""
        half = math.acos(self.cos_angle) + angle if self.cos_angle >= -1.0 else math.pi
        return self._replace(cos_angle=math.cos(half)) if half < math.pi else EVERYWHERE


EVERYWHERE = Cone(1.0, 0.0, 0.0, -2.0)


def cone_about(axis: Floats, cos_angle: float) -> Cone:
    """Return the cone about an axis (3,), a unit vector."""
    return Cone(float(axis[0]), float(axis[1]), float(axis[2]), float(cos_angle))


def cone_around(rays: Floats) -> Cone:
    """Return the cone around the mean of unit directions (N, 3) that holds them all; their own frame."""
    axis = rays.sum(axis=0, dtype=np.float64)
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    return cone_about(axis, np.clip((rays @ axis).min(initial=1.0), -1.0, 1.0))


@inline_kernel
def is_apart(cone: Cone, sine: np.float32, x: Scalar, y: Scalar, z: Scalar, radius: np.float32) -> bool:
    """Return True if nothing of a ball lies in a cone with the sine `sine` of its half angle.

    The ball's middle (x, y, z) is relative to the cone's tip. A ball behind the tip may count as in the cone.
    """
    along = np.float32(cone.x) * x + np.float32(cone.y) * y + np.float32(cone.z) * z
    across = math.sqrt(max(x * x + y * y + z * z - along * along, F0))
    return bool(across * np.float32(cone.cos_angle) - along * sine > radius)
