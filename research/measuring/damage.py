"""Damaged panoramas and scans with known poses."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..synthetic.world import blur
from .confidence import Points, light_unevenly, mask_outside_field, occlude, thin_points
from .photos import Image

POINT_NOISE = 0.05  # [m]
JPEG_QUALITY = 10


class Damaged(NamedTuple):
    """A panorama after some damage."""

    name: str
    rgb: Image  # (H, W, 3)
    has_answer: bool = True  # False if it shows no place of the scan as a camera would
    is_masked: NDArray[np.bool_] | None = None  # (H, W) pixels to ignore


def take_at_night(rgb: Image, rng: np.random.Generator) -> Image:
    """Dim and tint the light by four stops, and add the noise of a sensor that makes up for most of it."""
    linear = (rgb / 255.0) ** 2.2 * 2.0**-4 * np.array([1.3, 0.8, 0.6])
    noisy = rng.poisson(900.0 * linear) / 900.0 + rng.normal(0.0, 0.004, rgb.shape)
    return np.asarray(255.0 * (5.0 * noisy).clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def compress_noisy(rgb: Image, rng: np.random.Generator) -> Image:
    """Add noise, and store the picture as a JPEG of low quality."""
    noisy = (rgb + rng.normal(0.0, 15.0, rgb.shape)).clip(0.0, 255.0).astype(np.uint8)
    _, content = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.uint8)


def damage_panorama(rgb: Image, other: Image, rng: np.random.Generator) -> Iterator[Damaged]:
    """Yield the panorama after each kind of damage; pieces of `other` hide it."""
    height, width = rgb.shape[:2]
    other = np.asarray(cv2.resize(other, (width, height)), np.uint8)
    yield Damaged("as taken", rgb)
    for fraction in (0.2, 0.4, 0.6):
        yield Damaged(f"{fraction:.0%} hidden by objects", occlude(rgb, other, fraction, rng))
    lit = light_unevenly(rgb, 2.0, rng)
    yield Damaged("uneven light (2 stops), 30% hidden", occlude(lit, other, 0.3, rng))
    yield Damaged("night", take_at_night(rgb, rng))
    yield Damaged(f"noise and JPEG quality {JPEG_QUALITY}", compress_noisy(rgb, rng))
    blurred = np.asarray(blur(rgb.astype(float), width / 360.0), np.uint8)
    yield Damaged("blurred by 1 deg (one sigma)", blurred)
    small = cv2.resize(rgb, (256, 128), interpolation=cv2.INTER_AREA)
    yield Damaged("256 x 128 pixels", np.asarray(small, np.uint8))
    is_outside = mask_outside_field(width, 90.0, float(rng.uniform(0.0, 2.0 * np.pi)))
    yield Damaged("masked outside of 90 x 74 deg", rgb, is_masked=is_outside)
    is_behind = np.broadcast_to(np.abs(np.arange(width) - width // 2) >= width // 4, (height, width))
    yield Damaged("half of the sphere masked", rgb, is_masked=is_behind)
    yield Damaged("mirrored", np.ascontiguousarray(rgb[:, ::-1]), has_answer=False)
    yield Damaged("another place", other, has_answer=False)


def add_point_noise(points: Points, rng: np.random.Generator) -> Points:
    """Move each point by a Gaussian."""
    return points[0] + rng.normal(0.0, POINT_NOISE, points[0].shape), points[1]


DAMAGED_SCANS: dict[str, Callable[[Points, np.random.Generator], Points]] = {
    "scan thinned to 5%": thin_points,
    "scan with 5 cm noise": add_point_noise,
}
