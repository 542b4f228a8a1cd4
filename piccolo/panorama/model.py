"""A panorama at any size, with its metadata, and the options with which it is read."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Calibration, Camera, Mount
from ..camera.files import find_calibration
from ..camera.resampling import View, make_sphere
from ..camera.rig import IDENTITY
from ..errors import InputError
from ..geometry.colors import Labels

FACE_LETTERS = "rludfb"  # right, left, up, down, front, back
Projection = Literal["equirectangular", "pinhole", "fisheye"]


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
    view: View  # the photo, what is masked in it left out
    is_hidden: NDArray[np.bool_]  # (H, W) of the sphere, masked beside
    is_measured: bool = False  # by other photos of the camera


@dataclass(frozen=True)
class Panorama:
    """A full equirectangular picture, W = 2 H."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    is_valid: NDArray[np.bool_]  # (H, W), False where the picture shows nothing
    gpano: GPano | None = None  # None for a file without such metadata
    warnings: tuple[str, ...] = ()  # what the user should know of the reading
    cameras: tuple[Mount, ...] = ()  # that took it; none if it came as a sphere or a part of one
    focal_prior: FocalPrior | None = None  # of the photo of one camera

    def resample(self, camera: Camera, width: int) -> "Panorama":
        """Return the panorama, `width` x width / 2, by another calibration of its camera.

        The panorama must have a focal_prior.
        """
        assert self.focal_prior is not None
        mount = self.cameras[0].with_camera(camera)
        rgb, is_valid = make_sphere([self.focal_prior.view._replace(mount=mount)], width)
        hidden = self.focal_prior.is_hidden
        if hidden.any():
            at_width = cv2.resize(hidden.view(np.uint8), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
            is_valid = is_valid & (at_width == 0)
        return replace(self, rgb=rgb, is_valid=is_valid, cameras=(mount,))

    def expect_focal(self, focal_px: float, deviation: float) -> "Panorama":
        """Return the panorama by the focal length of other photos, with the deviation of its logarithm.

        The panorama must have a focal_prior.
        """
        assert self.focal_prior is not None
        camera = self.cameras[0].camera
        taken = self.resample(camera.change(math.log(focal_px / camera.focal[0])), self.rgb.shape[1])
        prior = replace(self.focal_prior, focal=focal_px, deviation=deviation, is_measured=True)
        return replace(taken, focal_prior=prior)


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a picture that its file can't give."""

    fov_deg: float | None = None  # horizontal; goes before metadata
    mask: Path | None = None  # picture, white where the panorama is to be ignored, or a folder of such
    mask_nadir_deg: float = 0.0  # the cap of this half angle about the camera's down axis is ignored
    cube_order: str | None = None  # the picture is six cube faces in this order, such as rludfb
    labels: Labels | None = None  # the picture holds labels, not colours
    use_gps: bool = True  # a GPS position in the file narrows the search, where the scan's system is known
    projection: Projection | None = None  # of a picture; None: of a sphere, if nothing speaks for a photo
    focal_px: float | None = None  # of a pinhole [px], at the picture's own size
    # of the camera, a folder of one for each photo, or of a rig whose pictures are in a folder
    calibration: Calibration | Path | None = None
    refine_focal: bool = False  # the focal length is a first guess

    def __post_init__(self) -> None:
        """Refuse values that mean nothing, naming the option."""
        _check_number("`fov_deg`", self.fov_deg, 360.0)
        _check_number("`focal_px`", self.focal_px, 1e6)
        if not (math.isfinite(self.mask_nadir_deg) and 0.0 <= self.mask_nadir_deg <= 90.0):
            raise InputError(f"`mask_nadir_deg`: found {self.mask_nadir_deg}, wanted 0 to 90")
        if self.cube_order is not None and sorted(self.cube_order) != sorted(FACE_LETTERS):
            wanted = f"wanted each of the letters {FACE_LETTERS} once (right, left, up, down, front, back)"
            raise InputError(f"`cube_order`: found {self.cube_order}, {wanted}")
        if self.projection is not None and self.projection not in get_args(Projection):
            wanted = f"wanted one of {', '.join(get_args(Projection))}"
            raise InputError(f"`projection`: found {self.projection!r}, {wanted}")
        self._check_together()

    @property
    def rig(self) -> Calibration | None:
        """Rig whose pictures make a panorama; None for single pictures."""
        given = self.calibration
        return given if isinstance(given, Calibration) and given.is_rig else None

    def with_refined_camera(self, cameras: tuple[Mount, ...], pano: Path) -> "ReadOptions":
        """Return the options with the refined camera of a photo as calibration of the stored picture."""
        if len(cameras) != 1:
            return self
        given = find_calibration(self.calibration, pano)
        R_lens_from_cam = IDENTITY if given is None or given.is_choice else given.mounts[0].R_lens_from_cam
        mount = replace(cameras[0], R_lens_from_cam=R_lens_from_cam)
        camera = Calibration("the refined camera", (mount,))
        return replace(self, calibration=camera, focal_px=None, fov_deg=None, projection=None)

    def _check_together(self) -> None:
        """Refuse options that give one thing twice, or belong to different pictures."""
        given = {
            "`camera` or `rig`": self.calibration is not None,
            "`focal_px`": self.focal_px is not None,
            "`cube_order`": self.cube_order is not None,
            "`fov_deg` or `projection`": self.fov_deg is not None or self.projection is not None,
        }
        if self.focal_px is not None and self.fov_deg is None and self.projection == "pinhole":
            given["`fov_deg` or `projection`"] = False
        names = [name for name, is_given in given.items() if is_given]
        if self.labels and names:
            raise InputError(f"`labels`: found {names[0]} too, wanted a picture of the full sphere")
        if len(names) > 1:
            raise InputError(f"{', '.join(names)}: wanted only one of them")
        if self.projection == "fisheye" and self.fov_deg is None:
            raise InputError(
                "`projection` fisheye: found no `fov_deg`, wanted the angle that the width shows"
            )


def _check_number(option: str, value: float | None, largest: float) -> None:
    """Refuse a number that is not above 0 and at most the largest."""
    if value is not None and not (math.isfinite(value) and 0.0 < value <= largest):
        raise InputError(f"{option}: found {value}, wanted above 0 and at most {largest:g}")


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
    # in bytes, as floating-point copies of a large picture would take gigabytes
    counts = panorama.is_valid.view(np.uint8) * np.uint8(255)
    weight = cv2.resize(counts, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    masked = cv2.bitwise_and(panorama.rgb, panorama.rgb, mask=counts)
    total = cv2.resize(masked, size, interpolation=cv2.INTER_AREA)
    rgb = np.round(total / np.maximum(weight, 1e-6)[..., None]).clip(0, 255).astype(np.uint8)
    return Panorama(rgb, weight >= 0.5)
