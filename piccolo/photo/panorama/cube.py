"""Six faces of a cube, in files of a folder or cells of one picture, resampled to an equirectangular picture.

Every face is a pinhole picture of 90 x 90 degrees seen from inside. The lower edge of "up" is the upper edge
of "front", and the upper edge of "down" is the lower edge of "front", as in OpenGL's cube (px right, nx left,
py up, ny down, pz front, nz back), Matterport's skybox and FFmpeg's v360.

py360convert 1.0.4 is not used: it samples half a pixel off, leaves pixels of the rim at a face's corners
uninitialised, and takes four times the memory.
"""

import re
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

from ...geometry.sphere import pixel_rays
from ...system.arguments import PICTURES
from ...system.arrays import Array32, Bytes, Mask
from ...system.errors import InputError
from .gpano import Pixels
from .masks import ROWS_AT_ONCE
from .picture import MAX_PICTURE_WIDTH, Picture, read_picture

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
Faces = dict[str, Bytes]  # by letter, (size, size, 4): RGB and 255 where valid
MIN_FACE = 32  # [px] side of a face
MAX_FACE = MAX_PICTURE_WIDTH // 4  # [px]
MAX_CUBE_FILES = 64  # a folder with more pictures is a folder of panoramas
MAX_EMPTY_RANGE = 8  # [levels] in an empty cell of a cross: JPEG changes colours by a few
# names that programs give to the faces r, l, u, d, f, b
SCHEMES = (
    ("skybox2", "skybox4", "skybox0", "skybox5", "skybox1", "skybox3"),  # Matterport
    ("px", "nx", "py", "ny", "pz", "nz"),
    ("posx", "negx", "posy", "negy", "posz", "negz"),
    ("right", "left", "up", "down", "front", "back"),
    ("right", "left", "top", "bottom", "front", "back"),
    ("r", "l", "u", "d", "f", "b"),
)
# letters of the cells of a cross; B is the back face upside down
CROSSES = (("-u--", "lfrb", "-d--"), ("-u-", "lfr", "-d-", "-B-"))
WANTED = "wanted six faces of a cube named as skybox0..5, px nx py ny pz nz or right left up down front back"


def face_pixels(rgb: Bytes, is_valid: Mask) -> Bytes:
    """Return a picture (H, W, 4) with its validity as alpha, ready to be resampled."""
    return np.dstack([rgb, is_valid.astype(np.uint8) * 255])


def equirectangular(faces: Faces) -> Pixels:
    """Return the picture of the full sphere, four times as wide as a face.

    Interpolation is bilinear, also across the cube's edges. A pixel is valid if all four source pixels are.
    """
    size = len(faces["f"])
    padded = {letter: _pad_face(faces, letter) for letter in faces}
    rgb = np.empty((2 * size, 4 * size, 3), dtype=np.uint8)
    is_valid = np.empty((2 * size, 4 * size), dtype=np.bool_)
    for top in range(0, 2 * size, ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        rays = pixel_rays(4 * size, rows).astype(np.float32)
        for left in range(0, 4 * size, size // 2):  # half a face: it meets one face to the side
            columns = slice(left, left + size // 2)
            pixels = _sample_faces(padded, rays[:, columns], rim=1)
            rgb[rows, columns] = pixels[..., :3]
            is_valid[rows, columns] = pixels[..., 3] == 255
    return rgb, is_valid


def _pad_face(faces: Faces, letter: str) -> Bytes:
    """Return a face with a rim of one pixel of its neighbours around it, to interpolate across its edges."""
    size = len(faces[letter])
    padded = cv2.copyMakeBorder(faces[letter], 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    ends = np.array([0, size + 1])
    along = np.arange(size + 2)
    for rows, columns in ((ends[:, None], along[None]), (along[:, None], ends[None])):
        right = (2.0 * columns - 1.0) / size - 1.0
        down = (2.0 * rows - 1.0) / size - 1.0
        in_face = np.stack(np.broadcast_arrays(right, down, 1.0), axis=-1).astype(np.float32)
        padded[rows, columns] = _sample_faces(faces, in_face @ R_FACE_FROM_CAM[letter], rim=0)
    return np.asarray(padded)


def _sample_faces(faces: Faces, directions: Array32, rim: int) -> Bytes:
    """Sample the pixels (H, W, 4) in directions (H, W, 3); faces have a rim of `rim` pixels around them."""
    pixels = np.empty((*directions.shape[:2], 4), dtype=np.uint8)
    largest = np.abs(directions).max(axis=2)
    for letter, R in R_FACE_FROM_CAM.items():
        right, down, depth = np.moveaxis(directions @ R.T, 2, 0)
        is_met = depth == largest  # on an edge two faces are met: either is right
        if is_met.any():
            half = len(faces[letter]) / 2.0 - rim
            u, v = ((x / largest + 1.0) * half - 0.5 + rim for x in (right, down))
            in_face = cv2.remap(faces[letter], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            pixels[is_met] = in_face[is_met]
    return pixels


def read_cube_folder(folder: Path) -> Picture:
    """Return the panorama of the one cube in a folder. Raise InputError without six equal squares."""
    paths = face_paths(folder).items()
    pictures = {letter: read_picture(path, (MIN_FACE, MIN_FACE)) for letter, path in paths}
    faces = {letter: face_pixels(picture.rgb, picture.is_valid) for letter, picture in pictures.items()}
    warnings = dict.fromkeys(warning for picture in pictures.values() for warning in picture.warnings)
    return _from_faces(folder, faces, tuple(warnings))


def is_cube(folder: Path) -> bool:
    """Return True if a folder has few pictures, among them the six faces of exactly one cube."""
    if sum(path.suffix.lower() in PICTURES for path in folder.iterdir()) > MAX_CUBE_FILES:
        return False
    try:
        return len(face_paths(folder)) == len(R_FACE_FROM_CAM)
    except InputError:
        return False


def face_paths(folder: Path) -> dict[str, Path]:
    """Return the files of the one complete cube in a folder, by the letters of the faces.

    Apart from the faces' names, the names of these files are equal. Raise InputError for none or several.
    """
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error}), {WANTED}") from error
    cubes = []
    for names in SCHEMES:
        parts: dict[tuple[str, ...], dict[str, Path]] = defaultdict(dict)
        for letter, name in zip("rludfb", names, strict=True):
            token = re.compile(rf"(?<![a-z0-9]){name}(?![a-z0-9])")
            for path in files:
                rest = tuple(token.split(path.name.lower()))
                if len(rest) == 2:
                    parts[rest][letter] = path
        cubes += [part for part in parts.values() if len(part) == len(names)]
    if len(cubes) != 1:
        raise InputError(f"{folder}: not a file but a folder with {len(cubes)} complete cubes, {WANTED}")
    return cubes[0]


def cube_of_cells(path: Path, picture: Picture, order: str | None) -> Picture | None:
    """Return the panorama of a picture that is a cross or a grid of six faces; else None.

    A cross, 4:3 or 3:4, is recognised by its empty cells. A grid, 6:1, 1:6, 3:2 or 2:3, needs `order`: the
    letters of its faces from left to right, then downwards.

    Raise InputError if an order is given, but the picture is not a grid of six squares.
    """
    if order is not None:
        return _from_faces(path, _grid(path, picture, order), picture.warnings)
    for layout in CROSSES:
        faces = _cross(picture, layout)
        if faces is not None:
            return _from_faces(path, faces, picture.warnings)
    return None


def _grid(path: Path, picture: Picture, order: str) -> Faces:
    width, height = picture.size
    for num_columns, num_rows in ((6, 1), (1, 6), (3, 2), (2, 3)):
        if width * num_rows == height * num_columns and width % num_columns == 0:
            size = width // num_columns
            return {order[k]: _cell(picture, size, k // num_columns, k % num_columns) for k in range(6)}
    raise InputError(f"{path}: found {width} x {height}, wanted six equal squares as cube_order says")


def _cross(picture: Picture, layout: tuple[str, ...]) -> Faces | None:
    """Return the faces of a cross; None for another shape, or if its other cells are not empty."""
    width, height = picture.size
    size = width // len(layout[0])
    if width != size * len(layout[0]) or height != size * len(layout):
        return None
    faces: Faces = {}
    for i, letters in enumerate(layout):
        for j, letter in enumerate(letters):
            pixels = _cell(picture, size, i, j)
            if letter == "-" and not _is_empty(pixels):
                return None
            faces[letter.lower()] = np.ascontiguousarray(pixels[::-1, ::-1]) if letter == "B" else pixels
    del faces["-"]
    return faces


def _cell(picture: Picture, size: int, row: int, column: int) -> Bytes:
    """Return the square cell (size, size, 4) in a row and column of a picture."""
    place = slice(row * size, (row + 1) * size), slice(column * size, (column + 1) * size)
    return face_pixels(picture.rgb[place], picture.is_valid[place])


def _is_empty(pixels: Bytes) -> bool:
    """Return True if a cell has one colour or alpha 0, except in a thin rim, where neighbours may show."""
    rim = max(len(pixels) // 32, 1)
    inner = pixels[rim:-rim, rim:-rim].reshape(-1, 4)
    is_constant = (inner.max(axis=0).astype(int) - inner.min(axis=0)).max() <= MAX_EMPTY_RANGE
    return bool(is_constant or not inner[:, 3].any())


def _from_faces(path: Path, faces: Faces, warnings: tuple[str, ...]) -> Picture:
    shapes = {face.shape[:2] for face in faces.values()}
    size = len(faces["f"])
    if shapes != {(size, size)} or not MIN_FACE <= size <= MAX_FACE:
        found = ", ".join(sorted(f"{width} x {height}" for height, width in shapes))
        wanted = f"wanted six squares of one size, {MIN_FACE} to {MAX_FACE}"
        raise InputError(f"{path}: found cube faces of {found}, {wanted}")
    rgb, is_valid = equirectangular(faces)
    return Picture(rgb, is_valid, warnings=warnings)
