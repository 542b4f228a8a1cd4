"""Point clouds: one reader a format, then the same checks and the same order for all."""

import math
from collections.abc import Callable
from pathlib import Path

from ..errors import InputError
from .clean import clean
from .model import Cloud
from .ply import has_ply_magic, read_ply
from .raw import RawCloud
from .text import TEXT_SUFFIXES, read_text

__all__ = ["Cloud", "read_cloud"]

WANTED = f"wanted a coloured point cloud: .ply, or text x y z r g b ({' '.join(sorted(TEXT_SUFFIXES))})"


def read_cloud(path: Path, scale: float = 1.0) -> Cloud:
    """The coloured cloud in a file, checked, in metres, in canonical order.

    The file's coordinates are multiplied by `scale`; the middle of their bounding box, rounded to whole
    metres, becomes `origin_world` and is subtracted in float64. This is done for every cloud, so that UTM
    coordinates and a room at the origin take the same path.

    Raises
    ------
    InputError
        The file is missing, damaged, has no colours or fewer than 1,000 finite points, or is no format
        that is read here.
    """
    path = Path(path)
    if not (math.isfinite(scale) and scale > 0.0):
        raise InputError(f"--scale: found {scale}, wanted a number above 0 (metres a unit of the file)")
    try:
        raw = _reader(path)(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}), {WANTED}") from error
    return clean(path, raw, scale)


def _reader(path: Path) -> Callable[[Path], RawCloud]:
    """The reader for a file: by its first bytes, then by its name's end."""
    if not path.exists():
        raise InputError(f"{path}: no such file, {WANTED}")
    if not path.is_file():
        raise InputError(f"{path}: not a file but a folder or a device, {WANTED}")
    with path.open("rb") as file:
        head = file.read(4)
    if not head:
        raise InputError(f"{path}: the file is empty, {WANTED}")
    if has_ply_magic(head):
        return read_ply
    if path.suffix.lower() in TEXT_SUFFIXES:
        return read_text
    if path.suffix.lower() == ".ply":
        raise InputError(f"{path}: begins with {head!r}, wanted 'ply' and a line end")
    raise InputError(f"{path}: unknown format '{path.suffix}', {WANTED}")
