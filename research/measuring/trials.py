"""Photos to be localized in a scan: damaged, of another place, or of no place; and damaged scans."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from piccolo.arrays import Bytes, Floats, Mask
from piccolo.geometry.pose import Gravity, Pose

from ..synthetic import photos

POINT_NOISE = 0.05  # [m]
JPEG_QUALITY = 10
FOVS_DEG = (90.0, 120.0, 65.0)  # of narrow photos
Points = tuple[Floats, Bytes]


class Trial(NamedTuple):
    """A photo to be localized."""

    case: str
    rgb: Bytes  # (H, W, 3)
    true_pose: Pose | None  # None if it was not taken in the scan, or not as a camera would
    gravity: Gravity = "auto"
    is_masked: Mask | None = None  # (H, W) what the photo does not show
    focal_px: float | None = None  # of a pinhole photo; None for a sphere


def damage_trial(trial: Trial, other: Bytes, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield a panorama after each kind of damage, which is then its case; pieces of `other` hide it."""
    rgb = trial.rgb
    height, width = rgb.shape[:2]

    def change(case: str, rgb: NDArray[np.generic]) -> Trial:
        return trial._replace(case=case, rgb=np.asarray(rgb, np.uint8))

    for fraction in (0.2, 0.4, 0.6):
        yield change(f"{fraction:.0%} hidden by objects", photos.occlude(rgb, other, fraction, rng))
    lit = photos.light_unevenly(rgb, 2.0, rng)
    yield change("uneven light (2 stops), 30% hidden", photos.occlude(lit, other, 0.3, rng))
    yield change("night", photos.take_at_night(rgb, rng))
    noisy = photos.compress(rgb + rng.normal(0.0, 15.0, rgb.shape), JPEG_QUALITY)
    yield change(f"noise and JPEG quality {JPEG_QUALITY}", noisy)
    yield change("blurred by 1 deg (one sigma)", photos.blur(rgb, width / 360.0))
    yield change("256 x 128 pixels", cv2.resize(rgb, (256, 128), interpolation=cv2.INTER_AREA))
    for fov_deg in FOVS_DEG:
        is_outside = photos.mask_outside_field(width, fov_deg, float(rng.uniform(0.0, 2.0 * np.pi)))
        yield trial._replace(case=f"masked outside of {fov_deg:g} deg", is_masked=is_outside)
    is_behind = np.broadcast_to(np.abs(np.arange(width) - width // 2) >= width // 4, (height, width))
    yield trial._replace(case="half of the sphere masked", is_masked=is_behind)
    yield change("mirrored", np.ascontiguousarray(rgb[:, ::-1]))._replace(true_pose=None)


def make_sceneless(trial: Trial, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield images that show no place, and the photo blurred, which keeps its true pose."""
    rgb = trial.rgb
    yield Trial("black", np.zeros_like(rgb), None)
    yield Trial("white", np.full_like(rgb, 255), None)
    yield Trial("noise", rng.integers(0, 256, rgb.shape, dtype=np.uint8), None)
    yield Trial("cloudy", photos.draw_fractal_noise(rgb.shape, rng), None)
    yield Trial("blurred", photos.blur(rgb, 0.02 * rgb.shape[1]).astype(np.uint8), trial.true_pose)


def turn_over(trial: Trial) -> Trial:
    """Turn the camera over, and search for it as if it were upright."""
    pose = trial.true_pose
    if pose is not None:
        pose = Pose(photos.UPSIDE_DOWN @ pose.R_cam_from_world, pose.center_world)
    return Trial("upside down", np.ascontiguousarray(trial.rgb[::-1, ::-1]), pose, "known")


def thin_points(points: Points, rng: np.random.Generator) -> Points:
    """Draw one of twenty points, in order."""
    count = len(points[0])
    chosen = np.sort(rng.choice(count, int(0.05 * count), replace=False))
    return points[0][chosen], points[1][chosen]


def add_point_noise(points: Points, rng: np.random.Generator) -> Points:
    """Move each point by a Gaussian."""
    return points[0] + rng.normal(0.0, POINT_NOISE, points[0].shape), points[1]


DAMAGED_SCANS: dict[str, Callable[[Points, np.random.Generator], Points]] = {
    "scan thinned to 5%": thin_points,
    "scan with 5 cm noise": add_point_noise,
}
