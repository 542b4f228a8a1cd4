"""The cameras of a picture, by options or, for a plain photo, by EXIF; and the part of each."""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...system.arrays import Array, Mask
from ...system.errors import InputError
from ..camera import Calibration, Mount
from ..camera.calibration import compute_extent
from ..camera.model import SPHERE, Camera, camera_of_fov, pinhole
from ..camera.photo_cameras import find_calibration
from ..camera.resampling import CameraView, shrunk
from ..photo import Photo
from .cube import face_pixels
from .facts import read_focal_length
from .gpano import ASPECT_TOLERANCE
from .masks import black_borders
from .picture import Picture

# By EXIF's orientation: the rotation from the axes of the upright picture to those of the stored one, and the
# number of quarter turns to the left that turn the upright picture into the stored one.
TURNED: dict[object, tuple[Array, int]] = {
    6: (np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), 1),
    8: (np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), -1),
}
HOW = "; `camera`, `focal_px`, or `fov_deg` with `projection` pinhole set it exactly"
LONGEST = 2.5  # a picture that is longer, relative to its height, is not a photo but a phone's sweep panorama
LONG = "no photo is that long: `projection` cylindrical and `fov_deg` tell of a phone's sweep panorama"
AS_SPHERE = "read as a full sphere, as it is 2:1; if it is a photo, add `projection` pinhole: it has "
GUESS = "`refine_focal` needs EXIF, `focal_px`, `camera`, or `projection` pinhole and `fov_deg`"
MIN_REPORTED_BORDER = 0.01  # of a picture: smaller black borders are masked without a warning
# standard deviations of a focal length's logarithm: of a guess, in pixels, by calibration, by field of view
OF_GUESS = 0.2
OF_PIXELS = 0.01
OF_CALIBRATION = 0.003
OF_FIELD = 0.03


class Cameras(NamedTuple):
    """The cameras of a picture."""

    mounts: tuple[Mount, ...] = ()  # empty if it is a sphere or a part of one
    deviation: float = 0.0  # of one camera: standard deviation of its focal length's logarithm
    source: str = ""  # of the focal length: an option, or EXIF
    notes: tuple[str, ...] = ()  # for the user, one line each


def cameras_of(photo: Photo, picture: Picture, has_gpano: bool) -> Cameras:
    """Return the cameras of a picture, by the options or by EXIF.

    Raise InputError if a calibration does not fit the picture, or if the option `projection` is pinhole and
    the focal length is unknown.
    """
    cameras = _cameras_of(photo, picture, has_gpano)
    if not photo.refine_focal:
        return cameras
    if len(cameras.mounts) != 1:
        what = f"{len(cameras.mounts)} cameras" if cameras.mounts else "a sphere or a part of one"
        raise InputError(f"{photo.path}: found {what}, wanted the photo of one camera: {GUESS}")
    return cameras._replace(deviation=OF_GUESS)


def _cameras_of(photo: Photo, picture: Picture, has_gpano: bool) -> Cameras:
    width, height = picture.size
    if (calibration := find_calibration(photo.calibration, photo.path)) is not None:
        mounts = _calibrate(photo.path, picture, calibration)
        # a single camera whose picture is a whole sphere needs no resampling
        is_sphere = mounts == (Mount(mounts[0].camera),) and mounts[0].camera.lens == SPHERE
        return Cameras() if is_sphere else Cameras(mounts, OF_CALIBRATION, "`camera`")
    if photo.focal_px is not None:
        return Cameras((Mount(pinhole(width, height, photo.focal_px)),), OF_PIXELS, "`focal_px`")
    lens = photo.projection
    if lens in ("pinhole", "fisheye") and photo.fov_deg is not None:
        return Cameras((Mount(camera_of_fov(lens, photo.fov_deg, width, height)),), OF_FIELD, "`fov_deg`")
    is_two_to_one = abs(width - 2 * height) <= ASPECT_TOLERANCE * 2 * height
    if photo.calibration is not None and not (is_two_to_one or has_gpano):
        wanted = f"wanted {photo.path.stem}.camera.json or {photo.path.stem}.json"
        raise InputError(f"{photo.path}: found no calibration of it in {photo.calibration}, {wanted}")
    is_photo = lens is None and photo.fov_deg is None and not has_gpano
    if not (is_photo or lens == "pinhole"):
        return Cameras()
    by_exif = read_focal_length(picture.exif, picture.size)
    if by_exif is None and lens == "pinhole":
        raise InputError(
            f"{photo.path}: found no focal length in EXIF, wanted `focal_px`, `fov_deg` or `camera`"
        )
    if by_exif is None or (is_two_to_one and lens is None):
        return Cameras(notes=(f"{AS_SPHERE}{by_exif.source}",) if by_exif else ())
    fov = 2.0 * math.degrees(math.atan(width / 2.0 / by_exif.focal))
    focal = f"focal length {by_exif.focal:.0f} px from {by_exif.source}"
    note = f"read as a pinhole photo {fov:.1f} deg wide, {focal}"
    notes = (note + HOW, LONG) if max(picture.size) > LONGEST * min(picture.size) else (note + HOW,)
    return Cameras((Mount(pinhole(width, height, by_exif.focal)),), by_exif.deviation, "EXIF", notes)


def _calibrate(path: Path, picture: Picture, calibration: Calibration) -> tuple[Mount, ...]:
    """Return the calibration at the picture's size; turn it by EXIF if it fits the picture as stored."""
    width, height = picture.size
    try:
        return calibration.for_picture(width, height)
    except InputError as error:
        if picture.orientation not in TURNED:
            raise InputError(f"{path}: {error}") from error
    try:
        mounts = calibration.for_picture(height, width)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    R_stored_from_shown, _ = TURNED[picture.orientation]
    return tuple(mount.turn(R_stored_from_shown) for mount in mounts)


def read_views(
    path: Path, picture: Picture, mounts: tuple[Mount, ...], is_valid: Mask
) -> tuple[list[CameraView], tuple[str, ...]]:
    """Return each camera with its part of a picture, with black borders masked, and notes for the user.

    `is_valid` (H, W) is the mask of the pixels that are valid so far.
    """
    pixels = face_pixels(picture.rgb, is_valid)
    whole = compute_extent(mounts)
    if picture.size[0] != picture.size[1] and picture.orientation in TURNED and whole == picture.size[::-1]:
        pixels = np.rot90(pixels, TURNED[picture.orientation][1])
    views = []
    notes = []
    for mount in mounts:
        left, top = mount.offset
        camera = mount.camera
        own = np.ascontiguousarray(pixels[top : top + camera.height, left : left + camera.width])
        is_bounded = camera.max_angle_deg is not None  # black within a fisheye's circle is no border
        borders = None if is_bounded else black_borders(own[..., :3], own[..., 3] > 0, is_full=False)
        if borders is not None:
            own[borders] = 0
            if borders.mean() >= MIN_REPORTED_BORDER:
                notes.append(f"masked black borders: {100 * borders.mean():.0f} % of the picture")
        views.append(shrunk(CameraView(mount, own)))
    return views, tuple(notes)


def rig_cameras(path: Path, pictures: list[Picture], rig: Calibration) -> list[tuple[Mount, ...]]:
    """Return the cameras of each picture of a rig, at the picture's size. InputError for another shape."""
    cameras = []
    for picture, mount in zip(pictures, rig.mounts, strict=True):
        width, height = picture.size
        if rig.has_sizes:
            one = Calibration(rig.path, (replace(mount, image=None),))
            mounts = tuple(replace(m, image=mount.image) for m in _calibrate(path, picture, one))
        else:
            camera = mount.camera
            mounts = (mount.with_camera(Camera(camera.model, width, height, camera.params)),)
        cameras.append(mounts)
    return cameras
