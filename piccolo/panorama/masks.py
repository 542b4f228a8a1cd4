"""Masks of the user: a picture, or the cap around a pole."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .crop import ASPECT_TOLERANCE
from .cube import SUFFIXES
from .picture import read_picture

MIN_MASK = (16, 8)  # [px]
WHITE = 128  # and above is to be ignored


def find_mask(mask: Path, pano: Path) -> Path | None:
    """The mask's file: `mask` itself, or in the folder `mask` the one named as the panorama, or None."""
    if not mask.is_dir():
        return mask
    return next((file for suffix in SUFFIXES if (file := mask / (pano.stem + suffix)).is_file()), None)


def read_mask(path: Path, sizes: list[tuple[int, int]]) -> tuple[int, NDArray[np.bool_]]:
    """Which of the sizes (width, height) a mask has the shape of, and where it counts at this size.

    A larger mask masks a pixel if any of its own pixels there is white, a smaller one is enlarged.

    Raises
    ------
    InputError
        The mask can't be read, or has the shape of none of the sizes, within 1 %.
    """
    rgb = read_picture(path, MIN_MASK).rgb
    height, width = rgb.shape[:2]
    for k, size in enumerate(sizes):
        if abs(width * size[1] - height * size[0]) <= ASPECT_TOLERANCE * height * size[0]:
            is_white = (rgb.max(axis=2) >= WHITE).astype(np.float32)
            # averages of a larger mask are above 0 where any pixel is white
            method = cv2.INTER_AREA if width > size[0] else cv2.INTER_NEAREST
            return k, np.asarray(cv2.resize(is_white, size, interpolation=method) == 0)
    wanted = " or ".join(f"{size[0]} x {size[1]}" for size in sizes)
    raise InputError(f"{path}: found a mask of {width} x {height}, wanted the shape of {wanted}")


def mask_pole(is_valid: NDArray[np.bool_], pole: str, half_angle_deg: float) -> NDArray[np.bool_]:
    """Validity (H, W) without the rows whose centre is nearer than that to the `pole`, zenith or nadir."""
    height = len(is_valid)
    from_zenith = (np.arange(height) + 0.5) * 180.0 / height
    from_pole = from_zenith if pole == "zenith" else from_zenith[::-1]
    return np.asarray(is_valid & (from_pole >= half_angle_deg)[:, None])
