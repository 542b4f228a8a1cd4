"""Point clouds: one reader a format, then the same checks and the same order for all."""

import math
from pathlib import Path

import numpy as np

from ..errors import InputError
from .clean import clean
from .e57 import E57
from .las import LAS
from .model import Cloud
from .ply import PLY
from .raw import HEAD_SIZE, Format, PointSource, RawCloud
from .text import TEXT

__all__ = ["Cloud", "read_cloud"]

FORMATS = (PLY, TEXT, LAS, E57)
WANTED = f"wanted a coloured point cloud: {', '.join(f.name for f in FORMATS)}"


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
        source = open_source(path)
        chunks = [RawCloud(np.empty((0, 3)), np.empty((0, 3), np.uint8)), *source.read_chunks()]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}), {WANTED}") from error
    points_world = np.concatenate([chunk.points_world for chunk in chunks])
    raw = RawCloud(points_world, np.concatenate([chunk.colors for chunk in chunks]))
    return clean(path, raw, scale)


def open_source(path: Path) -> PointSource:
    """The points of a file in any format that is read here."""
    return _format_of(path).open_source(path)


def _format_of(path: Path) -> Format:
    """The format of a file: by its first bytes, then by its name's end."""
    if not path.exists():
        raise InputError(f"{path}: no such file, {WANTED}")
    if not path.is_file():
        raise InputError(f"{path}: not a file but a folder or a device, {WANTED}")
    with path.open("rb") as file:
        head = file.read(HEAD_SIZE)
    if not head:
        raise InputError(f"{path}: the file is empty, {WANTED}")
    suffix = path.suffix.lower()
    by_content = [f for f in FORMATS if f.has_magic(head)]
    by_name = [f for f in FORMATS if suffix in f.suffixes]
    if not by_content and not by_name:
        raise InputError(f"{path}: unknown format '{path.suffix}', {WANTED}")
    return (by_content or by_name)[0]
