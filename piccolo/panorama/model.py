"""A panorama at any size, what is known of it, and how it is to be read."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cloud.label_colors import Labels
from ..errors import InputError

FACE_LETTERS = "rludfb"  # right, left, up, down, front, back


@dataclass(frozen=True)
class GPano:
    """How the camera was held, by the file's Photo Sphere XMP; None where the file does not say."""

    pitch_deg: float | None = None  # of the image centre above the horizon, [-90, 90]
    roll_deg: float | None = None  # about the view axis, the camera's right side down, [-180, 180]


@dataclass(frozen=True)
class Panorama:
    """A full equirectangular picture, W = 2 H."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    is_valid: NDArray[np.bool_]  # (H, W), False where the picture shows nothing
    gpano: GPano | None = None  # None for a file without such metadata
    warnings: tuple[str, ...] = ()  # what the user should know of the reading


@dataclass(frozen=True)
class ReadOptions:
    """What a picture can't say of itself."""

    fov_deg: float | None = None  # horizontal, of a picture centred on the horizon; goes before metadata
    mask: Path | None = None  # picture, white where the panorama is to be ignored, or a folder of such
    mask_nadir_deg: float = 0.0  # the cap of this half angle about the camera's down axis is ignored
    cube_order: str | None = None  # the picture is six cube faces in this order, such as rludfb
    labels: Labels | None = None  # the picture holds labels, not colours
    use_gps: bool = True  # a GPS position in the file narrows the search, where the scan's system is known

    def __post_init__(self) -> None:
        """Refuse values that mean nothing, naming the option."""
        if self.fov_deg is not None and not (math.isfinite(self.fov_deg) and 0.0 < self.fov_deg <= 360.0):
            raise InputError(f"--fov: found {self.fov_deg}, wanted above 0 and at most 360")
        if not (math.isfinite(self.mask_nadir_deg) and 0.0 <= self.mask_nadir_deg <= 90.0):
            raise InputError(f"--mask-nadir: found {self.mask_nadir_deg}, wanted 0 to 90")
        if self.labels and (self.fov_deg is not None or self.cube_order is not None):
            raise InputError("--labels: found --fov or --cube-order too, wanted a picture of the full sphere")
        if self.cube_order is not None and sorted(self.cube_order) != sorted(FACE_LETTERS):
            wanted = f"wanted each of the letters {FACE_LETTERS} once (right, left, up, down, front, back)"
            raise InputError(f"--cube-order: found {self.cube_order}, {wanted}")


def shrink(panorama: Panorama, width: int) -> Panorama:
    """The panorama area-averaged to `width` x width / 2, or itself if it is no larger."""
    return panorama if panorama.rgb.shape[1] <= width else resize(panorama, width)


def resize(panorama: Panorama, width: int) -> Panorama:
    """The panorama at `width` x width / 2: area-averaged where that is smaller, interpolated where larger.

    Pixels that do not count stay out of the averages; a pixel counts if half of its area does.
    """
    if panorama.rgb.shape[1] == width:
        return panorama
    size = (width, width // 2)
    if panorama.is_valid.all():
        rgb = np.asarray(cv2.resize(panorama.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        return Panorama(rgb, np.ones(rgb.shape[:2], np.bool_))
    # in bytes, as floating-point copies of a large picture would take gigabytes
    counts = panorama.is_valid.view(np.uint8) * np.uint8(255)
    weight = cv2.resize(counts, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    masked = cv2.bitwise_and(panorama.rgb, panorama.rgb, mask=counts)
    total = cv2.resize(masked, size, interpolation=cv2.INTER_AREA)
    rgb = np.round(total / np.maximum(weight, 1e-6)[..., None]).clip(0, 255).astype(np.uint8)
    return Panorama(rgb, weight >= 0.5)
