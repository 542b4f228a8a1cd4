"""Panoramas, pictures of a full sphere at any size, with their metadata."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...system.arrays import Bytes, Mask
from ..camera import Camera, Mount
from ..camera.resampling import CameraView, make_sphere, shrunk, sphere_width


@dataclass(frozen=True)
class GPano:
    """Attitude of the camera by the file's Photo Sphere XMP; a missing field is None."""

    pitch_deg: float | None = None  # elevation of the image centre, [-90, 90]
    roll_deg: float | None = None  # about the view axis, its right side down, [-180, 180]


@dataclass(frozen=True)
class FocalPrior:
    """The focal length of a photo as it is known before the photo is localized, and the photo's picture."""

    focal: float  # [px] along the width
    deviation: float  # standard deviation of its logarithm
    source: str  # an option, or EXIF
    view: CameraView  # the photo's picture, with its masks
    is_hidden: Mask  # (H, W) pixels of the sphere that are masked besides
    is_measured: bool = False  # it is by other photos of the camera


@dataclass(frozen=True)
class Panorama:
    """A full equirectangular picture, W = 2 H."""

    rgb: Bytes  # (H, W, 3)
    is_valid: Mask  # (H, W), False where the picture shows nothing
    gpano: GPano | None = None  # None without such metadata
    warnings: tuple[str, ...] = ()  # about the reading, for the user, one line each
    cameras: tuple[Mount, ...] = ()  # that took it; empty if the file is a sphere or a part of one
    focal_prior: FocalPrior | None = None  # only for a photo of one camera

    def resample(self, camera: Camera, width: int) -> "Panorama":
        """Return the panorama resampled by another calibration of its camera; it must have a focal_prior."""
        assert self.focal_prior is not None
        mount = self.cameras[0].with_camera(camera)
        rgb, is_valid = make_sphere([self.focal_prior.view._replace(mount=mount)], width)
        hidden = self.focal_prior.is_hidden
        if hidden.any():
            at_width = cv2.resize(hidden.view(np.uint8), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
            is_valid = is_valid & (at_width == 0)
        return replace(self, rgb=rgb, is_valid=is_valid, cameras=(mount,))

    def retake(self, camera: Camera) -> "Panorama":
        """Return a panorama that came as a sphere, resampled as the picture of a camera."""
        mount = Mount(camera)
        pixels = np.dstack([self.rgb, self.is_valid.view(np.uint8) * np.uint8(255)])
        rgb, is_valid = make_sphere([CameraView(mount, pixels)], sphere_width([mount]))
        return replace(self, rgb=rgb, is_valid=is_valid, cameras=(mount,))

    def shrink_picture(self, width: int) -> "Panorama":
        """Return the panorama with the picture in its focal_prior no finer than a sphere of a width.

        Whatever the calibration, it is then resampled from the same pixels.
        """
        assert self.focal_prior is not None
        return replace(self, focal_prior=replace(self.focal_prior, view=shrunk(self.focal_prior.view, width)))

    def expect_focal(self, focal_px: float, deviation: float) -> "Panorama":
        """Return the panorama with the focal length by other photos; it must have a focal_prior."""
        assert self.focal_prior is not None
        camera = self.cameras[0].camera
        taken = self.resample(camera.change(math.log(focal_px / camera.focal[0])), self.rgb.shape[1])
        prior = replace(self.focal_prior, focal=focal_px, deviation=deviation, is_measured=True)
        return replace(taken, focal_prior=prior)


def shrink(panorama: Panorama, width: int) -> Panorama:
    """Return the panorama shrunk to `width` x width / 2 by area averages, or itself if it is not larger."""
    return panorama if panorama.rgb.shape[1] <= width else resize(panorama, width)


def resize(panorama: Panorama, width: int) -> Panorama:
    """Return the panorama at `width` x width / 2: by area averages if that is smaller, else interpolated.

    Pixels that are not valid are left out of the averages; a pixel is valid if half of its area is. Metadata
    are not kept, unless the panorama has this width already.
    """
    if panorama.rgb.shape[1] == width:
        return panorama
    size = (width, width // 2)
    if panorama.is_valid.all():
        rgb = np.asarray(cv2.resize(panorama.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        return Panorama(rgb, np.ones(rgb.shape[:2], np.bool_))
    step, rest = divmod(panorama.rgb.shape[1], width)
    if rest:
        return Panorama(*_resize_masked(panorama.rgb, panorama.is_valid, size))
    rgb = np.zeros((*size[::-1], 3), np.uint8)
    is_valid = np.zeros(size[::-1], np.bool_)
    rows = _extent(np.asarray(panorama.is_valid.any(axis=1)), step)
    columns = _extent(np.asarray(panorama.is_valid.any(axis=0)), step)
    box = rows, columns
    source = slice(rows.start * step, rows.stop * step), slice(columns.start * step, columns.stop * step)
    size = columns.stop - columns.start, rows.stop - rows.start
    rgb[box], is_valid[box] = _resize_masked(panorama.rgb[source], panorama.is_valid[source], size)
    return Panorama(rgb, is_valid)


def _extent(is_met: Mask, step: int) -> slice:
    """Return the range of larger pixels, `step` pixels (N,) wide, from the first to the last that is True."""
    met = np.flatnonzero(is_met) // step
    return slice(int(met[0]), int(met[-1]) + 1) if len(met) else slice(0, 1)


def _resize_masked(rgb: Bytes, is_valid: Mask, size: tuple[int, int]) -> tuple[Bytes, Mask]:
    # in bytes, as floating-point copies of a large picture would take gigabytes
    counts = is_valid.view(np.uint8) * np.uint8(255)
    weight = cv2.resize(counts, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    masked = cv2.bitwise_and(rgb, rgb, mask=counts)
    total = cv2.resize(masked, size, interpolation=cv2.INTER_AREA)
    means = np.round(total / np.maximum(weight, 1e-6)[..., None]).clip(0, 255).astype(np.uint8)
    return means, weight >= 0.5
