"""Pictures of any cameras resampled to a sphere, W = 2 H, and a mask of what they show.

A pixel of the sphere is the mean of samples that are at most a pixel of the picture apart, so that nothing
aliases. It is valid if all of these are in the picture and valid there.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ...geometry.sphere import compute_rays
from ...system.arrays import Array, Bytes, Floats, Mask
from .calibration import Mount
from .model import PARTIAL_SPHERE, SPHERE

MAX_RESAMPLED_WIDTH = 4096  # [px] of the sphere; nothing needs more
MIN_SPHERE_WIDTH = 256  # [px]
ROWS = 64  # [px] height of the sphere's blocks, which are resampled one by one; divides the sphere's
COLUMNS = 128  # [px] width of these blocks; divides the sphere's
# [px] of the sphere: in a block, positions in the picture are computed so far apart and interpolated linearly
# between, with errors below 0.05 px
BLOCK_CELL = 4
LOOK = 8  # [px] of the sphere between the pixels by which it is found which blocks a camera shows
MAX_SAMPLES_A_PIXEL = 8  # across and down
AS_FINE = 0.8  # a picture is shrunk only by a smaller factor: one nearer to 1 would blur it
MAX_REMAP_SIDE = 32_000  # [px] of a picture that cv2.remap can read

Pixels = tuple[Bytes, Mask]  # rgb (H, W, 3), is_valid (H, W)


class CameraView(NamedTuple):
    """One camera with its picture."""

    mount: Mount
    pixels: Bytes  # (H, W, 4): RGB and 255 where valid, at any size of the camera's shape


def sphere_width(mounts: Sequence[Mount]) -> int:
    """Return the width [px] of the sphere that keeps the cameras' resolution at their axes, within limits."""
    finest = max(mount.camera.resolution for mount in mounts) * 2.0 * math.pi
    width = MIN_SPHERE_WIDTH * math.ceil(finest / MIN_SPHERE_WIDTH - 1e-6)
    return min(max(width, MIN_SPHERE_WIDTH), MAX_RESAMPLED_WIDTH)


def make_sphere(views: Sequence[CameraView], width: int) -> Pixels:
    """Return the picture of the sphere, `width` x width / 2; `width` is a multiple of MIN_SPHERE_WIDTH.

    Where several cameras show the same, the pixel is from the camera whose axis is nearest. Distances between
    the cameras are neglected.
    """
    rgb = np.zeros((width // 2, width, 3), np.uint8)  # memory that is never written is mostly not allocated
    is_shown = np.zeros((width // 2, width), np.bool_)
    nearest = np.full((width // 2, width), -2.0, np.float32)  # cosine of the angle to the axis
    for view in (shrunk(view, width) for view in views):
        axis = view.mount.rotation[0]
        for top, left in _blocks(view, width):
            block = slice(top, top + ROWS), slice(left, left + COLUMNS)
            pixels, is_valid = _resample_block(view, width, top, left)
            closeness = np.float32(1.0)
            if len(views) > 1:
                centers = np.arange(left, left + COLUMNS) + 0.5, np.arange(top, top + ROWS) + 0.5
                closeness = (compute_rays(centers[0], centers[1][:, None], width) @ axis).astype(np.float32)
            is_better = is_valid & (closeness > nearest[block])
            np.copyto(rgb[block], pixels, where=is_better[..., None])
            np.copyto(nearest[block], closeness, where=is_better)
            is_shown[block] |= is_better
    return rgb, is_shown


def shrunk(view: CameraView, width: int = MAX_RESAMPLED_WIDTH) -> CameraView:
    """Return a view, its picture shrunk if it is clearly finer than a sphere of a width, or too large."""
    camera = view.mount.camera
    largest = MAX_REMAP_SIDE / max(camera.width, camera.height)
    factor = min(1.0, width / (2.0 * math.pi * camera.resolution), largest)
    size = max(1, round(factor * camera.width)), max(1, round(factor * camera.height))
    if size[0] >= AS_FINE * view.pixels.shape[1] and max(view.pixels.shape) <= MAX_REMAP_SIDE:
        return view
    return view._replace(pixels=np.asarray(cv2.resize(view.pixels, size, interpolation=cv2.INTER_AREA)))


def _blocks(view: CameraView, width: int) -> list[tuple[int, int]]:
    """Return the upper left corners (row, column) of the sphere's blocks that the camera may show."""
    u = np.arange(LOOK // 2, width, LOOK) + 0.5
    v = np.arange(LOOK // 2, width // 2, LOOK) + 0.5
    _, is_in = view.mount.camera.pixels(compute_rays(u, v[:, None], width) @ view.mount.rotation.T)
    around = np.pad(is_in, ((0, 0), (1, 1)), mode="wrap").astype(np.uint8)
    is_near = cv2.dilate(around, np.ones((3, 3), np.uint8))[:, 1:-1]
    rows = ROWS // LOOK
    columns = COLUMNS // LOOK
    is_met = is_near.reshape(len(is_near) // rows, rows, -1, columns).any(axis=(1, 3))
    return [(int(i) * ROWS, int(j) * COLUMNS) for i, j in np.argwhere(is_met)]


def _resample_block(view: CameraView, width: int, top: int, left: int) -> Pixels:
    """Return colours and validity of a block of the sphere's pixels."""
    u = left + np.arange(0.0, COLUMNS + 1, BLOCK_CELL)
    v = top + np.arange(0.0, ROWS + 1, BLOCK_CELL)
    places, is_in = _places(view, width, u, v)
    num = _num_samples(places, is_in)
    if is_in.all() and view.mount.camera.lens not in (SPHERE, PARTIAL_SPHERE):  # their seams can't be crossed
        places = _interpolate_between(
            _interpolate_between(places, num * BLOCK_CELL).swapaxes(0, 1), num * BLOCK_CELL
        ).swapaxes(0, 1)
    else:
        u, v = (b + (np.arange(num * size) + 0.5) / num for b, size in ((left, COLUMNS), (top, ROWS)))
        places, is_in = _places(view, width, u, v)
    x, y = np.moveaxis(places.astype(np.float32) - np.float32(0.5), -1, 0)
    found = cv2.remap(view.pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if not is_in.all():
        found[~is_in] = 0
    pixels = cv2.resize(found, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA) if num > 1 else found
    return np.asarray(pixels[..., :3], np.uint8), np.asarray(pixels[..., 3] == 255)


def _interpolate_between(values: Array, count: int) -> Array:
    """Interpolate between consecutive rows of values (rows + 1, ...): return (rows * count, ...).

    The results are in the middles of `count` equal steps from each row to the next.
    """
    step = ((np.arange(count) + 0.5) / count).reshape(-1, *[1] * (values.ndim - 1))
    between = values[:-1, None] + step * (values[1:] - values[:-1])[:, None]
    return np.asarray(between.reshape(-1, *values.shape[1:]))


def _places(view: CameraView, width: int, u: Floats, v: Floats) -> tuple[Array, Mask]:
    """Return the picture's pixels (h, w, 2) at columns (w,) and rows (h,) of the sphere, and which exist."""
    camera = view.mount.camera
    places, is_in = camera.pixels(compute_rays(u, v[:, None], width) @ view.mount.rotation.T)
    height_here, width_here = view.pixels.shape[:2]
    return places * (width_here / camera.width, height_here / camera.height), is_in


def _num_samples(places: Array, is_in: Mask) -> int:
    """Return how many samples a pixel needs in each direction, by the largest step between cells."""
    across = np.linalg.norm(np.diff(places, axis=1), axis=2)[is_in[:, 1:] & is_in[:, :-1]]
    down = np.linalg.norm(np.diff(places, axis=0), axis=2)[is_in[1:] & is_in[:-1]]
    largest = max(across.max(initial=1.0), down.max(initial=1.0)) / BLOCK_CELL
    return int(min(max(math.ceil(largest - 0.5), 1), MAX_SAMPLES_A_PIXEL))
