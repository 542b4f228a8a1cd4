"""The equirectangular camera: direction <-> pixel and its derivative. The only owner of the pixel convention.

For x_cam = (x, y, z), +x the image centre, +y left, +z up, and an image of W x H pixels, W = 2 H:
    azimuth phi = atan2(y, x),  elevation theta = atan2(z, hypot(x, y)),
    u = (1/2 - phi / 2 pi) W,   v = (1/2 - theta / pi) H,
continuous coordinates, the centre of image[i, j] at (j + 1/2, i + 1/2). u wraps, v does not.
As W = 2 H, both coordinates have the same scale: -W / 2 pi pixels a radian.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import F0, HALF, inline_kernel

PI = np.float32(math.pi)
HALF_PI = np.float32(math.pi / 2)
TINY = np.float32(1e-18)

# what files with poses say of them
CONVENTION = (
    "x_cam = R_cam_from_world @ (x_world - center_world) in metres; +x_cam points to the image centre, "
    "+y_cam left, +z_cam up; u = (1/2 - atan2(y, x) / 2 pi) W, v = (1/2 - atan2(z, hypot(x, y)) / pi) H, "
    "pixel centres at half-integers"
)

# atan(q) = q P(q^2) on [0, 1], minimax in the absolute error: 2.5e-7 rad, 3.4e-7 with float32 rounding.
# math.atan2 is a library call that keeps a loop from being vectorised.
A0 = np.float32(0.99999612569809)
A1 = np.float32(-0.33317369222641)
A2 = np.float32(0.19807815551758)
A3 = np.float32(-0.13233341276646)
A4 = np.float32(0.07962366193533)
A5 = np.float32(-0.03360421210527)
A6 = np.float32(0.00681171109960)


@inline_kernel
def atan2(y, x):
    """Angle [rad] of (x, y) in (-pi, pi], float32, within 6e-7 of math.atan2; 0 at the origin."""
    abs_x = abs(x)
    abs_y = abs(y)
    q = min(abs_x, abs_y) / max(abs_x, abs_y, TINY)
    s = q * q
    angle = q * (A0 + s * (A1 + s * (A2 + s * (A3 + s * (A4 + s * (A5 + s * A6))))))
    angle = HALF_PI - angle if abs_y > abs_x else angle
    angle = PI - angle if x < F0 else angle
    return -angle if y < F0 else angle


@inline_kernel
def direction_to_pixel(x, y, z, rho, width):
    """Continuous pixel (u, v) of the camera direction (x, y, z), rho = hypot(x, y), in a `width` image."""
    scale = width / (PI + PI)
    u = HALF * width - scale * atan2(y, x)
    v = HALF * HALF * width - scale * atan2(z, rho)
    return u, v


@inline_kernel
def pixel_jacobian(x, y, z, rho2, width):
    """Derivative of (u, v) by the camera coordinates: (du/dx, du/dy, dv/dx, dv/dy, dv/dz); du/dz is 0.

    At a pole and at the camera itself, where there is none, the divisor stays above zero and the rows finite.
    """
    scale = width / (PI + PI)
    rho2 = max(rho2, TINY)
    per_rho2 = scale / rho2
    per_rho_r2 = scale / (math.sqrt(rho2) * (rho2 + z * z))
    return y * per_rho2, -x * per_rho2, x * z * per_rho_r2, y * z * per_rho_r2, -rho2 * per_rho_r2


def pixel_rays(width: int, rows: slice = slice(None)) -> NDArray[np.float64]:
    """Unit camera directions (width / 2, width, 3) of pixel centres of a `width` image, or of its `rows`."""
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2.0 * np.pi
    elevation = (0.5 - (np.arange(width // 2)[rows] + 0.5) / (width // 2)) * np.pi
    rays = np.empty((len(elevation), width, 3))
    rays[..., 0] = np.cos(elevation)[:, None] * np.cos(azimuth)
    rays[..., 1] = np.cos(elevation)[:, None] * np.sin(azimuth)
    rays[..., 2] = np.sin(elevation)[:, None]
    return rays


def ray_jacobian(rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives (H, W, 3) of u and of v by the camera coordinates, at pixel_rays, 1 m from the camera."""
    x, y, z = np.moveaxis(rays, -1, 0)
    rho = np.hypot(x, y)
    scale = rays.shape[1] / (2.0 * math.pi)
    by_u = np.stack([y, -x, np.zeros_like(x)], axis=-1) / rho[..., None] ** 2
    by_v = np.stack([x * z, y * z, -(rho**2)], axis=-1) / rho[..., None]
    return scale * by_u, scale * by_v


def solid_angles(width: int) -> NDArray[np.float64]:
    """Solid angle [sr] of a pixel of each row, (width / 2,), of an image of `width`; exact, sums to 4 pi."""
    edges = np.sin((0.5 - np.arange(width // 2 + 1) / (width // 2)) * np.pi)
    return np.asarray((edges[:-1] - edges[1:]) * 2.0 * np.pi / width)
