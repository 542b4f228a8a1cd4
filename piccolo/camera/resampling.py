"""Pictures of any cameras resampled to the sphere that everything else works on: W = 2 H, and what it shows.

A pixel of the sphere is the mean of as many samples as keep one from the next by a pixel of the picture or
less, so that nothing aliases; it is valid if all of them are in the picture and valid there.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from ..geometry.sphere import pixel_rays
from .rig import Mount

MAX_SPHERE_WIDTH = 4096  # [px] nothing looks at more
MIN_SPHERE_WIDTH = 256  # [px]
ROWS, COLUMNS = 64, 128  # of the sphere, resampled at a time; both divide its size
LOOK = 8  # [px] every so many it is seen first which blocks a camera shows
MAX_SAMPLES = 8  # a pixel, across and down
MAX_SIDE = 32_000  # [px] of what cv2.remap reads

Pixels = tuple[NDArray[np.uint8], NDArray[np.bool_]]  # rgb (H, W, 3), is_valid (H, W)


class View(NamedTuple):
    """One camera with what it has taken."""

    mount: Mount
    pixels: NDArray[np.uint8]  # (H, W, 4): RGB and 255 where valid, at any size of the camera's shape


def sphere_width(mounts: Sequence[Mount]) -> int:
    """Width [px] of the sphere that keeps the cameras' resolution at their axes, bounded."""
    finest = max(mount.camera.resolution for mount in mounts) * 2.0 * math.pi
    width = MIN_SPHERE_WIDTH * math.ceil(finest / MIN_SPHERE_WIDTH - 1e-6)
    return min(max(width, MIN_SPHERE_WIDTH), MAX_SPHERE_WIDTH)


def sphere_of(views: Sequence[View], width: int) -> Pixels:
    """The picture of the sphere, `width` x width / 2, a multiple of MIN_SPHERE_WIDTH.

    Where several cameras show the same, the one is taken whose axis is nearest; how far they are from each
    other is left aside.
    """
    views = [shrunk(view, width) for view in views]
    rgb = np.zeros((width // 2, width, 3), np.uint8)
    nearest = np.full((width // 2, width), -2.0, np.float16)  # cosine of the angle to the axis
    for view in views:
        R = view.mount.rotation
        for top, left in _blocks(view, width):
            block = slice(top, top + ROWS), slice(left, left + COLUMNS)
            pixels, is_valid = _resampled(view, width, *block)
            closeness = (pixel_rays(width, *block) @ R[0]).astype(np.float16)
            is_better = is_valid & (closeness > nearest[block])
            rgb[block][is_better] = pixels[is_better]
            nearest[block][is_better] = closeness[is_better]
    return rgb, nearest > -2.0


def shrunk(view: View, width: int = MAX_SPHERE_WIDTH) -> View:
    """The same area-averaged, if it is finer at the axis than a sphere of this width, or too large."""
    camera = view.mount.camera
    largest = MAX_SIDE / max(camera.width, camera.height)
    factor = min(1.0, width / (2.0 * math.pi * camera.resolution), largest)
    if factor == 1.0:
        return view
    size = max(1, round(factor * camera.width)), max(1, round(factor * camera.height))
    return view._replace(pixels=np.asarray(cv2.resize(view.pixels, size, interpolation=cv2.INTER_AREA)))


def _blocks(view: View, width: int) -> list[tuple[int, int]]:
    """Upper left corners of the sphere's blocks in which the camera may show something."""
    look = slice(LOOK // 2, None, LOOK)
    _, is_in = view.mount.camera.pixels(pixel_rays(width, look, look) @ view.mount.rotation.T)
    around = np.pad(is_in, ((0, 0), (1, 1)), mode="wrap").astype(np.uint8)
    is_near = cv2.dilate(around, np.ones((3, 3), np.uint8))[:, 1:-1]
    rows, columns = ROWS // LOOK, COLUMNS // LOOK
    is_met = is_near.reshape(len(is_near) // rows, rows, -1, columns).any(axis=(1, 3))
    return [(int(i) * ROWS, int(j) * COLUMNS) for i, j in np.argwhere(is_met)]


def _resampled(view: View, width: int, rows: slice, columns: slice) -> Pixels:
    """Colours and validity of a block of the sphere's pixels."""
    places, is_in = _places(view, width, rows, columns)
    num = _num_samples(places, is_in)
    if num > 1:
        finer = [slice(num * part.start, num * part.stop) for part in (rows, columns)]
        places, is_in = _places(view, num * width, *finer)
    u, v = np.moveaxis(places.astype(np.float32) - np.float32(0.5), -1, 0)
    found = cv2.remap(view.pixels, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found[~is_in] = 0
    pixels = cv2.resize(found, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA) if num > 1 else found
    return np.asarray(pixels[..., :3], np.uint8), np.asarray(pixels[..., 3] == 255)


def _places(view: View, width: int, rows: slice, columns: slice) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (h, w, 2) of the picture along a block's rays, and which are in it (h, w)."""
    camera = view.mount.camera
    places, is_in = camera.pixels(pixel_rays(width, rows, columns) @ view.mount.rotation.T)
    height_here, width_here = view.pixels.shape[:2]
    return places * (width_here / camera.width, height_here / camera.height), is_in


def _num_samples(places: Array, is_in: NDArray[np.bool_]) -> int:
    """How many samples a pixel needs across and down: of the block's largest step in the picture."""
    across = np.linalg.norm(np.diff(places, axis=1), axis=2)[is_in[:, 1:] & is_in[:, :-1]]
    down = np.linalg.norm(np.diff(places, axis=0), axis=2)[is_in[1:] & is_in[:-1]]
    largest = max(across.max(initial=1.0), down.max(initial=1.0))
    return int(min(math.ceil(largest - 0.5), MAX_SAMPLES))
