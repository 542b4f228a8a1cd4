"""A picture of a part of the sphere, or of all of it, as a full equirectangular one."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .gpano import CropRegion
from .picture import MAX_WIDTH

ASPECT_TOLERANCE = 0.01
MIN_REGION = 0.02  # of the sphere's picture: less would take much memory to show nearly nothing

Pixels = tuple[NDArray[np.uint8], NDArray[np.bool_]]  # rgb (H, W, 3), is_valid (H, W)


def region_of_fov(fov_deg: float, width: int, height: int) -> CropRegion:
    """A picture with as many pixels a degree in both directions, centred on the horizon."""
    wide, high = fov_deg / 360.0, fov_deg / 180.0 * height / width  # fractions of the sphere's picture
    return CropRegion((1.0 - wide) / 2.0, (1.0 - high) / 2.0, wide, high)


def full_size(path: Path, region: CropRegion, size: tuple[int, int]) -> tuple[int, int]:
    """Width and height [px], 2:1, of the sphere's picture in which one of `size` keeps its pixels.

    Within 1 % of 2:1 the direction that has more pixels a degree is shrunk.

    Raises
    ------
    InputError
        The region does not fit the picture, or the sphere's picture would be too large.
    """
    width, height = size[0] / region.width, size[1] / region.height
    found = f"{path}: found {size[0]} x {size[1]}"
    if abs(width - 2.0 * height) > ASPECT_TOLERANCE * 2.0 * height:
        raise InputError(f"{found} of a sphere of {width:.0f} x {height:.0f}, wanted that width = 2 x height")
    if region.height > 1.0 + ASPECT_TOLERANCE:
        raise InputError(f"{found}, higher than the sphere at this field of view, wanted a smaller --fov")
    if width > MAX_WIDTH:
        raise InputError(f"{found} of a sphere {width:.0f} wide, wanted at most {MAX_WIDTH}")
    if region.width * region.height < MIN_REGION:
        percent = 100.0 * region.width * region.height
        raise InputError(f"{found}, {percent:.2g} % of the sphere, wanted at least {100.0 * MIN_REGION:g} %")
    full_height = int(min(height, width / 2.0) + 1e-6)  # a quotient may be a hair below a whole number
    return 2 * full_height, full_height


def embed_crop(path: Path, rgb: NDArray[np.uint8], is_valid: NDArray[np.bool_], region: CropRegion) -> Pixels:
    """The picture at its place in the full sphere, the rest not valid; itself if it is the full sphere.

    Its edges come to whole pixels: it is moved by half a pixel at most. Over the seam it is continued.
    """
    height, width = is_valid.shape
    full_width, full_height = full_size(path, region, (width, height))
    left, top = round(region.left * full_width), max(round(region.top * full_height), 0)
    right = left + max(round(region.width * full_width), 1)
    bottom = min(top + max(round(region.height * full_height), 1), full_height)
    rgb, is_valid = _resized(rgb, is_valid, (right - left, bottom - top))
    if is_valid.shape == (full_height, full_width) and left % full_width == 0:
        return rgb, is_valid
    full_rgb = np.zeros((full_height, full_width, 3), dtype=np.uint8)
    full_valid = np.zeros((full_height, full_width), dtype=np.bool_)
    columns = np.arange(left, right) % full_width
    full_rgb[top:bottom, columns], full_valid[top:bottom, columns] = rgb, is_valid
    return full_rgb, full_valid


def _resized(rgb: NDArray[np.uint8], is_valid: NDArray[np.bool_], size: tuple[int, int]) -> Pixels:
    """Both area-averaged to `size`; a pixel is valid if all that went into it is."""
    if is_valid.shape == (size[1], size[0]):
        return rgb, is_valid
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    mask = cv2.resize(is_valid.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8), np.asarray(mask == 255)
