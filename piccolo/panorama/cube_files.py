"""Where the six faces of a cube are: six files of a folder, or the cells of one picture."""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .cube import Faces, equirectangular, face_pixels
from .model import FACE_LETTERS
from .picture import MAX_WIDTH, Picture, read_picture

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
MIN_FACE = 32  # [px]
MAX_FACE = MAX_WIDTH // 4
MAX_CUBE_FILES = 64  # a folder with more pictures is a folder of panoramas
MAX_EMPTY_RANGE = 8  # levels within an empty cell of a cross: JPEG leaves a few
# names that programs give to the faces r, l, u, d, f, b
SCHEMES = (
    ("skybox2", "skybox4", "skybox0", "skybox5", "skybox1", "skybox3"),  # Matterport
    ("px", "nx", "py", "ny", "pz", "nz"),
    ("posx", "negx", "posy", "negy", "posz", "negz"),
    ("right", "left", "up", "down", "front", "back"),
    ("right", "left", "top", "bottom", "front", "back"),
    ("r", "l", "u", "d", "f", "b"),
)
# letters of the cells of a cross; B is back turned by half a turn
CROSSES = (("-u--", "lfrb", "-d--"), ("-u-", "lfr", "-d-", "-B-"))
WANTED = "wanted six faces of a cube named as skybox0..5, px nx py ny pz nz or right left up down front back"


def read_cube_folder(folder: Path) -> Picture:
    """The panorama of the six square pictures in a folder, one cube's faces.

    Raises
    ------
    InputError
        The folder holds no complete cube or several, or the faces are not squares of one size.
    """
    paths = face_paths(folder).items()
    pictures = {letter: read_picture(path, (MIN_FACE, MIN_FACE)) for letter, path in paths}
    faces = {letter: face_pixels(picture.rgb, picture.is_valid) for letter, picture in pictures.items()}
    warnings = dict.fromkeys(warning for picture in pictures.values() for warning in picture.warnings)
    return _from_faces(folder, faces, tuple(warnings))


def is_cube(folder: Path) -> bool:
    """True for a folder of few pictures among which are the six faces of one cube."""
    if sum(path.suffix.lower() in SUFFIXES for path in folder.iterdir()) > MAX_CUBE_FILES:
        return False
    try:
        return len(face_paths(folder)) == len(FACE_LETTERS)
    except InputError:
        return False


def face_paths(folder: Path) -> dict[str, Path]:
    """The files of a folder's one complete cube, by the letters of their faces.

    Each scheme's files are told apart by the rest of their names.
    """
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
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
    """The panorama of a picture that is a cross, or by `order` a grid of six faces; None if it is neither.

    A cross, 4:3 or 3:4, is known by its empty cells. A grid, 6:1, 1:6, 3:2 or 2:3, is known by `order` alone,
    the letters of its faces from left to right, then downwards.

    Raises
    ------
    InputError
        An order is given, and the picture is no grid of six squares.
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
            return {order[k]: _cell(picture, size, *divmod(k, num_columns)) for k in range(6)}
    raise InputError(f"{path}: found {width} x {height}, wanted six equal squares as --cube-order says")


def _cross(picture: Picture, layout: tuple[str, ...]) -> Faces | None:
    """Faces of a cross; None for another shape, or if the cells around it are not empty."""
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


def _cell(picture: Picture, size: int, row: int, column: int) -> NDArray[np.uint8]:
    """The square (size, size, 4) in a row and column of such."""
    place = slice(row * size, (row + 1) * size), slice(column * size, (column + 1) * size)
    return face_pixels(picture.rgb[place], picture.is_valid[place])


def _is_empty(pixels: NDArray[np.uint8]) -> bool:
    """True for a cell of one colour or of alpha 0 only; its rim may have a little of the neighbours."""
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
