"""Six faces of a cube resampled to an equirectangular picture.

Every face is a pinhole picture of 90 x 90 degrees seen from inside. Up hangs over front: its lower edge is
front's upper edge. Down's upper edge is front's lower edge. This is OpenGL's cube (px right, nx left, py up,
ny down, pz front, nz back), Matterport's skybox and FFmpeg's v360 alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere import pixel_rays
from .crop import Pixels

CHUNK = 16384  # directions at a time: cv2.remap takes fewer than 32767 rows
BAND = 32  # rows at a time


@dataclass(frozen=True)
class Frame:
    """Axes of a face's picture in the camera (+x the panorama's centre, +y left, +z up)."""

    forward: tuple[float, float, float]
    right: tuple[float, float, float]
    up: tuple[float, float, float]

    def directions(
        self, columns: NDArray[np.int64], rows: NDArray[np.int64], size: int
    ) -> NDArray[np.float32]:
        """Directions (N, 3) through pixels (N,), whole numbers at their centres, of a face of `size`."""
        a, b = 2.0 * (columns + 0.5) / size - 1.0, 1.0 - 2.0 * (rows + 0.5) / size
        directions = (
            np.array(self.forward) + a[:, None] * np.array(self.right) + b[:, None] * np.array(self.up)
        )
        return np.asarray(directions, dtype=np.float32)


FRAMES = {
    "r": Frame((0, -1, 0), (-1, 0, 0), (0, 0, 1)),
    "l": Frame((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    "u": Frame((0, 0, 1), (0, -1, 0), (-1, 0, 0)),
    "d": Frame((0, 0, -1), (0, -1, 0), (1, 0, 0)),
    "f": Frame((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "b": Frame((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
}
Faces = dict[str, NDArray[np.uint8]]  # by letter, (size, size, 4): RGB and 255 where valid


def face_pixels(rgb: NDArray[np.uint8], is_valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A face (size, size, 4) as it is resampled."""
    return np.dstack([rgb, is_valid.astype(np.uint8) * 255])


def equirectangular(faces: Faces) -> Pixels:
    """The picture of the full sphere, four times as wide as a face; bilinear, also across the cube's edges.

    A pixel is valid if all four that go into it are.
    """
    width = 4 * len(faces["f"])
    padded = {letter: _padded(faces, letter) for letter in faces}
    rgb = np.empty((width // 2, width, 3), dtype=np.uint8)
    is_valid = np.empty((width // 2, width), dtype=np.bool_)
    for begin in range(0, width // 2, BAND):
        rows = slice(begin, begin + BAND)
        rays = pixel_rays(width, rows)
        pixels = _sampled(padded, rays.reshape(-1, 3).astype(np.float32), border=1).reshape(
            *rays.shape[:2], 4
        )
        rgb[rows], is_valid[rows] = pixels[..., :3], pixels[..., 3] == 255
    return rgb, is_valid


def _padded(faces: Faces, letter: str) -> NDArray[np.uint8]:
    """A face with a rim of one pixel from the faces around it, for interpolation across the edge."""
    size = len(faces[letter])
    padded = cv2.copyMakeBorder(faces[letter], 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    is_rim = np.ones((size + 2, size + 2), dtype=np.bool_)
    is_rim[1:-1, 1:-1] = False
    rows, columns = np.nonzero(is_rim)
    padded[is_rim] = _sampled(faces, FRAMES[letter].directions(columns - 1, rows - 1, size), border=0)
    return np.asarray(padded)


def _sampled(faces: Faces, directions: NDArray[np.float32], border: int) -> NDArray[np.uint8]:
    """Pixels (N, 4) along directions (N, 3), each from the face it meets; faces have a rim of `border`."""
    chunks = [
        _sampled_chunk(faces, directions[begin : begin + CHUNK], border)
        for begin in range(0, len(directions), CHUNK)
    ]
    return np.concatenate(chunks)


def _sampled_chunk(faces: Faces, directions: NDArray[np.float32], border: int) -> NDArray[np.uint8]:
    pixels = np.empty((len(directions), 4), dtype=np.uint8)
    largest = np.abs(directions).max(axis=1)
    for letter, frame in FRAMES.items():
        depth = directions @ np.array(frame.forward, np.float32)
        meets = depth == largest  # on an edge two faces do, and either will do
        if not meets.any():
            continue
        size = len(faces[letter]) - 2 * border
        met = directions[meets] / depth[meets, None]
        columns = (met @ np.array(frame.right, np.float32) + 1.0) * (size / 2.0) - 0.5 + border
        rows = (1.0 - met @ np.array(frame.up, np.float32)) * (size / 2.0) - 0.5 + border
        maps = columns.astype(np.float32)[:, None], rows.astype(np.float32)[:, None]
        found = cv2.remap(faces[letter], *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        pixels[meets] = found[:, 0]
    return pixels
