"""A panorama at any size, with its metadata."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...system.arrays import Bytes, Mask
from ..camera import Camera, Mount
from ..camera.resampling import CameraView, make_sphere, shrunk, sphere_width


@dataclass(frozen=True)
class GPano:
    """Attitude of the camera by the file's Photo Sphere XMP; None for a missing field."""

    pitch_deg: float | None = None  # of the image centre above the horizon, [-90, 90]
    roll_deg: float | None = None  # about the view axis, the camera's right side down, [-180, 180]


@dataclass(frozen=True)
class FocalPrior:
    """A focal length with its deviation, known before a photo is localized, and the photo itself."""

    focal: float  # [px] across
    deviation: float  # standard deviation of its logarithm
    source: str  # the option that gives it, or EXIF
    view: CameraView  # the photo, what is masked in it left out
    is_hidden: Mask  # (H, W) of the sphere, masked beside
    is_measured: bool = False  # by other photos of the camera


@dataclass(frozen=True)
class Panorama:
    """A full equirectangular picture, W = 2 H."""

    rgb: Bytes  # (H, W, 3)
    is_valid: Mask  # (H, W), False where the picture shows nothing
    gpano: GPano | None = None  # None for a file without such metadata
    warnings: tuple[str, ...] = ()  # what the user should know of the reading
    cameras: tuple[Mount, ...] = ()  # that took it; none if it came as a sphere or a part of one
    focal_prior: FocalPrior | None = None  # of the photo of one camera

    def resample(self, camera: Camera, width: int) -> "Panorama":
        """Return the panorama at a width by another calibration of its camera, which has a focal_prior."""
        assert self.focal_prior is not None
        mount = self.cameras[0].with_camera(camera)
        rgb, is_valid = make_sphere([self.focal_prior.view._replace(mount=mount)], width)
        hidden = self.focal_prior.is_hidden
        if hidden.any():
            at_width = cv2.resize(hidden.view(np.uint8), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
            is_valid = is_valid & (at_width == 0)
        return replace(self, rgb=rgb, is_valid=is_valid, cameras=(mount,))

    def retake(self, camera: Camera) -> "Panorama":
        """Return the sphere of a picture that came as one, by the camera that shows what it shows of it."""
        mount = Mount(camera)
        pixels = np.dstack([self.rgb, self.is_valid.view(np.uint8) * np.uint8(255)])
        rgb, is_valid = make_sphere([CameraView(mount, pixels)], sphere_width([mount]))
        return replace(self, rgb=rgb, is_valid=is_valid, cameras=(mount,))

    def shrink_picture(self, width: int) -> "Panorama":
        """Return the panorama, which has a focal_prior, with its picture no finer than a sphere of a width.

        By several calibrations it is then resampled from the same pixels.
        """
        assert self.focal_prior is not None
        return replace(self, focal_prior=replace(self.focal_prior, view=shrunk(self.focal_prior.view, width)))

    def expect_focal(self, focal_px: float, deviation: float) -> "Panorama":
        """Return the panorama, which has a focal_prior, by the focal length of other photos."""
        assert self.focal_prior is not None
        camera = self.cameras[0].camera
        taken = self.resample(camera.change(math.log(focal_px / camera.focal[0])), self.rgb.shape[1])
        prior = replace(self.focal_prior, focal=focal_px, deviation=deviation, is_measured=True)
        return replace(taken, focal_prior=prior)


def shrink(panorama: Panorama, width: int) -> Panorama:
    """Return the panorama area-averaged to `width` x width / 2, or itself if it is no larger."""
    return panorama if panorama.rgb.shape[1] <= width else resize(panorama, width)


def resize(panorama: Panorama, width: int) -> Panorama:
    """Return the panorama at `width` x width / 2: area-averaged if that is smaller, else interpolated.

    Pixels that do not count stay out of the averages; a pixel counts if half of its area does.
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
    shown = slice(rows.start * step, rows.stop * step), slice(columns.start * step, columns.stop * step)
    size = columns.stop - columns.start, rows.stop - rows.start
    rgb[box], is_valid[box] = _resize_masked(panorama.rgb[shown], panorama.is_valid[shown], size)
    return Panorama(rgb, is_valid)


def _extent(is_met: Mask, step: int) -> slice:
    """Return the range of the larger pixels, of `step` pixels (N,) each, from the first met to the last."""
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
