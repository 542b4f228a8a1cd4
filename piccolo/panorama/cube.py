"""Six faces of a cube resampled to an equirectangular picture.

Every face is a pinhole picture of 90 x 90 degrees seen from inside. Up hangs over front: its lower edge is
front's upper edge. Down's upper edge is front's lower edge. This is OpenGL's cube (px right, nx left, py up,
ny down, pz front, nz back), Matterport's skybox and FFmpeg's v360 alike.

Not by py360convert 1.0.4: it samples half a pixel off, leaves the pixels of its rim in a face's corners
uninitialised, and takes four times the memory.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere import pixel_rays
from .crop import Pixels

BAND = 64  # rows at a time
# Rows: a face's right, down and forward in the camera (+x the panorama's centre, +y left, +z up).
R_FACE_FROM_CAM = {
    letter: np.array(axes, dtype=np.float32)
    for letter, axes in {
        "r": ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
        "l": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
        "u": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        "d": ((0, -1, 0), (-1, 0, 0), (0, 0, -1)),
        "f": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),
        "b": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    }.items()
}
Faces = dict[str, NDArray[np.uint8]]  # by letter, (size, size, 4): RGB and 255 where valid


def face_pixels(rgb: NDArray[np.uint8], is_valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A face (size, size, 4) as it is resampled."""
    return np.dstack([rgb, is_valid.astype(np.uint8) * 255])


def equirectangular(faces: Faces) -> Pixels:
    """The picture of the full sphere, four times as wide as a face; bilinear, also across the cube's edges.

    A pixel is valid if all four that go into it are.
    """
    size = len(faces["f"])
    padded = {letter: _padded(faces, letter) for letter in faces}
    rgb = np.empty((2 * size, 4 * size, 3), dtype=np.uint8)
    is_valid = np.empty((2 * size, 4 * size), dtype=np.bool_)
    for top in range(0, 2 * size, BAND):
        rows = slice(top, top + BAND)
        rays = pixel_rays(4 * size, rows).astype(np.float32)
        for left in range(0, 4 * size, size // 2):  # half a face: one face around, and up or down
            columns = slice(left, left + size // 2)
            pixels = _sampled(padded, rays[:, columns], rim=1)
            rgb[rows, columns], is_valid[rows, columns] = pixels[..., :3], pixels[..., 3] == 255
    return rgb, is_valid


def _padded(faces: Faces, letter: str) -> NDArray[np.uint8]:
    """A face with a rim of one pixel from the faces around it, for interpolation across the edge."""
    size = len(faces[letter])
    padded = cv2.copyMakeBorder(faces[letter], 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    ends, along = np.array([0, size + 1]), np.arange(size + 2)
    for rows, columns in ((ends[:, None], along[None]), (along[:, None], ends[None])):
        right, down = (2.0 * columns - 1.0) / size - 1.0, (2.0 * rows - 1.0) / size - 1.0
        in_face = np.stack(np.broadcast_arrays(right, down, 1.0), axis=-1).astype(np.float32)
        padded[rows, columns] = _sampled(faces, in_face @ R_FACE_FROM_CAM[letter], rim=0)
    return np.asarray(padded)


def _sampled(faces: Faces, directions: NDArray[np.float32], rim: int) -> NDArray[np.uint8]:
    """Pixels (H, W, 4) along directions (H, W, 3), each from the face it meets; faces have a rim of `rim`."""
    pixels = np.empty((*directions.shape[:2], 4), dtype=np.uint8)
    largest = np.abs(directions).max(axis=2)
    for letter, R in R_FACE_FROM_CAM.items():
        right, down, depth = np.moveaxis(directions @ R.T, 2, 0)
        is_met = depth == largest  # on an edge two faces are, and either will do
        if is_met.any():
            half = len(faces[letter]) / 2.0 - rim
            u, v = ((x / largest + 1.0) * half - 0.5 + rim for x in (right, down))
            found = cv2.remap(faces[letter], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            pixels[is_met] = found[is_met]
    return pixels
