"""Corrections of a picture's geometry, which may be a little wrong, or altogether.

A picture claims how its pixels map to rays: by a calibration, or as a sphere that shows 360 by 180 degrees
with the horizon in the middle. Corrections act in the plane of the picture, (x, y) = (pixel - centre) / focal
length; for a sphere, x is the azimuth to the right and y the angle below the horizon [rad]:
    of a lens      x' = x exp(f) (1 + k r2) + cx,   y' = y exp(f + a) (1 + k r2) + cy,   r2 = x^2 + y^2;
    of a sphere    x' = x exp(w),                   y' = y exp(h) + cy.
A sphere that was cut to 1 / exp(h) of its height and resized has h > 0; cy is the position of its horizon.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...geometry.sphere import HALF_PI, PI, atan2
from ...system.arrays import Array, Array32
from ...system.kernels.jit import F0, F1, Scalar, kernel
from .calibration import Mount
from .model import PARTIAL_SPHERE, Camera

LENS = ("log_focal", "log_aspect", "center_x", "center_y", "radial")
FOCAL = LENS.index("log_focal")
OF_SPHERE = ("log_width", "log_height", "horizon")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")  # models in which each point of the plane is a ray
STEP_PX = 0.01  # step of the differences of rays by pixels


class Displaced(NamedTuple):
    """Points moved to where a corrected picture shows them, at the same distances; in the camera's axes."""

    points: Array32  # (3, N) [m]
    moves: Array32  # (p, 3, N) [m] their derivatives by the corrections
    is_shown: Array32  # (N,) 1 for points that the picture can show, else 0


@dataclass(frozen=True)
class Corrections:
    """Corrections of the camera that took a picture; their `names` are LENS or OF_SPHERE."""

    mount: Mount

    @property
    def is_of_sphere(self) -> bool:
        """True for a picture that shows a sphere or a part of one."""
        return self.mount.camera.lens == PARTIAL_SPHERE

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the corrections (p,)."""
        return OF_SPHERE if self.is_of_sphere else LENS

    def displace(self, points_cam: Array32, values: Array) -> Displaced:
        """Return points (3, N) [m] moved to where the picture shows them if corrections (p,) are true."""
        camera = self.mount.camera
        if not self.is_of_sphere and camera.model not in PINHOLES:
            return self._displace_in_lens(points_cam, values)
        num = points_cam.shape[1]
        moves = np.empty((len(self.names), 3, num), np.float32)
        displaced = Displaced(np.empty((3, num), np.float32), moves, np.empty(num, np.float32))
        values32 = np.asarray(values, np.float32)
        if self.is_of_sphere:
            displace_on_sphere(points_cam, values32, *displaced)
        else:
            R_lens_from_cam = np.asarray(self.mount.rotation, np.float32)
            least_ahead = np.float32(self.least_ahead)
            displace_in_pinhole(points_cam, R_lens_from_cam, least_ahead, values32, *displaced)
        return displaced

    @property
    def least_ahead(self) -> float:
        """Cosine of the angle from the lens's axis beyond which nothing is shown."""
        return math.cos(min(self.mount.camera.max_angle, 0.5 * math.pi))

    def _displace_in_lens(self, points_cam: Array32, values: Array) -> Displaced:
        camera = self.mount.camera
        R_cam_from_lens = self.mount.rotation.T
        ranges = np.linalg.norm(points_cam, axis=0).astype(np.float64)
        rays = (points_cam / ranges).T @ R_cam_from_lens
        pixels, is_in = camera.pixels(rays)
        is_ahead = is_in | (rays[:, 0] > self.least_ahead)
        center = np.array(camera.center)
        focal = np.array(camera.focal)
        plane, by_values = correct_plane((pixels - center) / focal, values)
        corrected = plane * focal + center
        new_rays, _ = camera.rays(corrected)  # also of pixels beyond the picture's edge
        steps = STEP_PX * np.eye(2)
        across, down = ((camera.rays(corrected + step)[0] - new_rays) / STEP_PX for step in steps)
        moves = by_values[..., :1] * focal[0] * across + by_values[..., 1:] * focal[1] * down
        kept = is_ahead[:, None]
        back = R_cam_from_lens.T
        return Displaced(
            np.ascontiguousarray((np.where(kept, new_rays, rays) @ back).T * ranges, np.float32),
            np.ascontiguousarray((np.where(kept, moves, 0.0) @ back).swapaxes(1, 2) * ranges, np.float32),
            is_ahead.astype(np.float32),
        )

    def apply(self, values: Array) -> Camera:
        """Return the camera of a sphere with corrections (3,)."""
        log_width, log_height, horizon = values
        camera = self.mount.camera
        across, down = camera.focal
        left, top = camera.center
        params = (across * math.exp(log_width), down * math.exp(log_height), left, top + down * horizon)
        return Camera(camera.model, camera.width, camera.height, tuple(float(v) for v in params))


def correct_plane(plane: Array, values: Array) -> tuple[Array, Array]:
    """Correct positions (N, 2) in a lens's plane; return them and derivatives (p, N, 2) by corrections."""
    log_focal, log_aspect, center_x, center_y, radial = values
    x, y = plane.T
    zero = np.zeros_like(x)
    one = np.ones_like(x)
    r2 = x * x + y * y
    x_wide = x * math.exp(log_focal)
    y_wide = y * math.exp(log_focal + log_aspect)
    x_new = x_wide * (1.0 + radial * r2)
    y_new = y_wide * (1.0 + radial * r2)
    moves = [(x_new, y_new), (zero, y_new), (one, zero), (zero, one), (x_wide * r2, y_wide * r2)]
    corrected = np.stack([x_new + center_x, y_new + center_y], axis=1)
    return corrected, np.stack([np.stack(move, axis=1) for move in moves])


@kernel
def displace_on_sphere(
    points: Array32, values: Array32, displaced: Array32, moves: Array32, is_shown: Array32
) -> None:
    """Write points (3, N) [m] displaced on a sphere by corrections (3,), and their derivatives (3, 3, N).

    Angles are those to the left and above the horizon. A point beyond a pole or the seam is not shown.
    """
    wide = np.float32(math.exp(values[0]))
    high = np.float32(math.exp(values[1]))
    horizon = values[2]
    for n in range(points.shape[1]):
        x = points[0, n]
        y = points[1, n]
        z = points[2, n]
        rho2 = x * x + y * y
        r = np.float32(math.sqrt(rho2 + z * z))
        left = atan2(y, x) * wide
        above = atan2(z, np.float32(math.sqrt(rho2))) * high
        up = above - horizon
        cos_left = np.float32(math.cos(left))
        sin_left = np.float32(math.sin(left))
        cos_up = np.float32(math.cos(up))
        sin_up = np.float32(math.sin(up))
        displaced[0, n] = r * cos_up * cos_left
        displaced[1, n] = r * cos_up * sin_left
        displaced[2, n] = r * sin_up
        moves[0, 0, n] = -r * cos_up * sin_left * left
        moves[0, 1, n] = r * cos_up * cos_left * left
        moves[0, 2, n] = F0
        moves[1, 0, n] = -r * sin_up * cos_left * above
        moves[1, 1, n] = -r * sin_up * sin_left * above
        moves[1, 2, n] = r * cos_up * above
        moves[2, 0, n] = r * sin_up * cos_left
        moves[2, 1, n] = r * sin_up * sin_left
        moves[2, 2, n] = -r * cos_up
        is_shown[n] = F1 if abs(left) <= PI and abs(up) <= HALF_PI else F0


@kernel
def displace_in_pinhole(
    points: Array32,
    R_lens_from_cam: Array32,
    least_ahead: Scalar,
    values: Array32,
    displaced: Array32,
    moves: Array32,
    is_shown: Array32,
) -> None:
    """Write where points (3, N) are seen by a pinhole with corrections (5,), and derivatives (5, 3, N).

    A ray is u = q / |q|, q = (1, -x, -y), and moves by (I - u u^T) dq / |q|: `by_x` and `by_y` where x or y
    grows. What is not ahead stays.
    """
    R = R_lens_from_cam
    wide = np.float32(math.exp(values[0]))
    high = np.float32(math.exp(values[0] + values[1]))
    for n in range(points.shape[1]):
        a = points[0, n]
        b = points[1, n]
        c = points[2, n]
        r = np.float32(math.sqrt(a * a + b * b + c * c))
        depth = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        is_ahead = depth > least_ahead * r
        is_shown[n] = F1 if is_ahead else F0
        if not is_ahead:
            displaced[:, n] = points[:, n]
            moves[:, :, n] = F0
            continue
        x = -(R[1, 0] * a + R[1, 1] * b + R[1, 2] * c) / depth
        y = -(R[2, 0] * a + R[2, 1] * b + R[2, 2] * c) / depth
        r2 = x * x + y * y
        x_wide = x * wide
        y_wide = y * high
        scale = F1 + values[4] * r2
        x_scaled = x_wide * scale
        y_scaled = y_wide * scale
        x_new = x_scaled + values[2]
        y_new = y_scaled + values[3]
        ahead = F1 / np.float32(math.sqrt(F1 + x_new * x_new + y_new * y_new))
        left = -x_new * ahead
        up = -y_new * ahead
        far = r * ahead
        for i in range(3):
            ray = R[0, i] * ahead + R[1, i] * left + R[2, i] * up
            by_x = far * (left * ray - R[1, i])
            by_y = far * (up * ray - R[2, i])
            displaced[i, n] = r * ray
            moves[0, i, n] = x_scaled * by_x + y_scaled * by_y
            moves[1, i, n] = y_scaled * by_y
            moves[2, i, n] = by_x
            moves[3, i, n] = by_y
            moves[4, i, n] = r2 * (x_wide * by_x + y_wide * by_y)
