"""The photometric loss that the paper compares its own with: the cloud is rendered, and pixels are compared.

    L(R, t) = (1 / N') sum_u || V(u) - I(u) ||_2

over the N' pixels u in which the view V, z-buffered at the pose, shows points, and the panorama I counts. A
pixel's depth says which point p it shows. A step (w, d) moves it by dp = w x p - d and in the image by
du = J dp, so at a fixed pixel V changes by -grad V . J dp. Rasterisation and occlusions have no derivative.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np

from piccolo import InputError, PaperSettings, Pose
from piccolo.geometry.points import PackedPoints
from piccolo.geometry.sphere import pixel_rays
from piccolo.localization.paper_descent import Equations, Loss
from piccolo.photo.panorama import Panorama
from piccolo.photo.panorama.panorama import shrink
from piccolo.system.arrays import Array, Array32, Mask
from piccolo.views.zbuffer import MAX_VIEW_WIDTH, MIN_VIEW_WIDTH, View, render_view

MIN_SHOWN_SHARE = 0.5  # of what is rendered, as of the sampling loss: masked pixels may not hide more
MIN_FILLED_SHARE = 0.1  # of the pixels that the points could fill: fewer are seen from outside of a scan
LEAST_DEPTH = 1e-3  # [m]
LEAST_NORM = 0.5 / 255.0  # a residual below half an 8-bit level has the weight of half a level


@dataclass(frozen=True)
class PhotometricSettings(PaperSettings):
    """Algorithm 1 of the paper on the photometric loss."""

    photometric_width: int = 256  # [px] at most, of the views and of the panorama

    def __post_init__(self) -> None:
        super().__post_init__()
        if not MIN_VIEW_WIDTH <= self.photometric_width <= MAX_VIEW_WIDTH or self.photometric_width % 2:
            wanted = f"wanted an even number of {MIN_VIEW_WIDTH} to {MAX_VIEW_WIDTH}"
            raise InputError(f"photometric_width: found {self.photometric_width}, {wanted}")

    def make_loss(self, panorama: Panorama) -> Loss:
        """Return the loss of poses of a panorama."""
        small = shrink(panorama, self.photometric_width)
        return Loss(
            lambda points, pose: photometric_loss(points, small, pose),
            lambda points, pose: photometric_equations(points, small, pose),
        )


def photometric_loss(points: PackedPoints, panorama: Panorama, pose: Pose) -> float:
    """Return the loss in [0, sqrt(3)] at `pose`, over the panorama's own pixels; inf if too few are shown."""
    found = _compare(points, panorama, pose)
    return math.inf if found is None else float(np.linalg.norm(found[1], axis=-1).mean(dtype=np.float64))


def photometric_equations(points: PackedPoints, panorama: Panorama, pose: Pose) -> Equations:
    """Return the loss at `pose`, its gradient (6,) and the matrix (6, 6) of reweighted least squares."""
    found = _compare(points, panorama, pose)
    if found is None:
        return math.inf, np.zeros(6), np.eye(6)
    view, residuals, counts = found
    norms = np.linalg.norm(residuals, axis=-1)
    by_u, by_v = (gradient[counts] for gradient in view_gradient(view))
    rows_u, rows_v = pixel_motion(view.depth, counts)
    weights = 1.0 / np.maximum(norms, LEAST_NORM)
    e_u, e_v = (weights * (by * residuals).sum(axis=1) for by in (by_u, by_v))
    gradient = -(e_u @ rows_u + e_v @ rows_v)
    a_uu, a_uv, a_vv = (weights * (a * b).sum(axis=1) for a, b in ((by_u, by_u), (by_u, by_v), (by_v, by_v)))
    cross = (rows_u * a_uv[:, None]).T @ rows_v
    matrix = (rows_u * a_uu[:, None]).T @ rows_u + (rows_v * a_vv[:, None]).T @ rows_v + cross + cross.T
    count = len(norms)
    return float(norms.mean(dtype=np.float64)), gradient / count, matrix / count


def _compare(points: PackedPoints, panorama: Panorama, pose: Pose) -> tuple[View, Array32, Mask] | None:
    """Render the view at `pose`; return it, its differences (N, 3) in [-1, 1], and their mask (H, W).

    None where masked pixels hide too much of the view, or it is nearly empty, as from outside a scan.
    """
    view = render_view(points, pose, panorama.rgb.shape[1])
    counts = view.is_seen & panorama.is_valid
    num_seen = int(view.is_seen.sum())
    least_shown = MIN_SHOWN_SHARE * float(panorama.is_valid.mean()) ** 2 * num_seen
    least_seen = MIN_FILLED_SHARE * min(view.is_seen.size, len(points))
    if num_seen <= least_seen or int(counts.sum()) <= least_shown:
        return None
    return view, view.rgb[counts] - panorama.rgb[counts].astype(np.float32) / np.float32(255.0), counts


def view_gradient(view: View) -> tuple[Array32, Array32]:
    """Return derivatives (H, W, 3) by u and v [1/px]: central, one-sided at a hole, 0 between two."""
    seen = view.is_seen[..., None].astype(np.float32)
    gradients = []
    for axis in (1, 0):
        ahead, behind = (np.roll(view.rgb, -step, axis=axis) for step in (1, -1))
        has_ahead, has_behind = (np.roll(seen, -step, axis=axis) for step in (1, -1))
        if axis == 0:  # rows do not wrap
            has_ahead[-1] = 0.0
            has_behind[0] = 0.0
        total = (ahead - view.rgb) * has_ahead + (view.rgb - behind) * has_behind
        gradients.append(total / np.maximum(has_ahead + has_behind, 1.0))
    return gradients[0], gradients[1]


@functools.lru_cache(maxsize=2)
def _unit_motion(width: int) -> tuple[Array, Array]:
    """Return derivatives (H, W, 6) of u and v by a step, for points at 1 m in each pixel's centre."""
    rays = pixel_rays(width)
    rows_u, rows_v = (np.concatenate([np.cross(rays, by_p), -by_p], axis=-1) for by_p in ray_jacobian(rays))
    return rows_u, rows_v


def pixel_motion(depth: Array32, counts: Mask) -> tuple[Array, Array]:
    """Return derivatives (N, 6) of u and v [px] by a step, for pixels of `counts` at `depth` (H, W)."""
    rows_u, rows_v = (rows[counts] for rows in _unit_motion(depth.shape[1]))
    per_depth = 1.0 / np.maximum(depth[counts], LEAST_DEPTH)[:, None]
    rows_u[:, 3:] *= per_depth  # a turn moves pixels alike at every depth
    rows_v[:, 3:] *= per_depth
    return rows_u, rows_v


def ray_jacobian(rays: Array) -> tuple[Array, Array]:
    """Return the gradients (H, W, 3) of u and of v in camera coordinates, at `pixel_rays`, 1 m away."""
    x, y, z = np.moveaxis(rays, -1, 0)
    rho = np.hypot(x, y)
    scale = rays.shape[1] / (2.0 * math.pi)
    by_u = np.stack([y, -x, np.zeros_like(x)], axis=-1) / rho[..., None] ** 2
    by_v = np.stack([x * z, y * z, -(rho**2)], axis=-1) / rho[..., None]
    return scale * by_u, scale * by_v
