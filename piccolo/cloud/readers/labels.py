"""Labels of points as colours, in place of the file's own."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..label_colors import Labels, colors_of
from .reader import ChunkReader, RawCloud, ScalarReader

# as they stand in PLY files, in lower case; the first that is there counts. CloudCompare prefixes `scalar_`
LABEL_NAMES = tuple(
    f"{prefix}{name}" for name in ("label", "class", "classification") for prefix in ("", "scalar_")
)
MOST = 2.0**32  # labels are below it, and above its negative


def label_reader(path: Path, read_scalar: ScalarReader, labels: Labels) -> ChunkReader:
    """What a PointSource wants as `read_chunks`, of a reader of points and their labels."""

    def read_chunks() -> Iterator[RawCloud]:
        for points, values in read_scalar():
            numbers = as_integers(path, points, values)
            is_kept = labels.are_kept(numbers)
            yield RawCloud(points[is_kept], colors_of(numbers[is_kept]))

    return read_chunks


def as_integers(path: Path, points: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Labels (N,) of points (N, 3), as integers; 0 for points without a position, left out later."""
    values = np.where(np.isfinite(points).all(axis=1), values, 0.0)
    is_whole = (np.abs(values) < MOST) & (values == np.floor(values))
    if not is_whole.all():
        raise InputError(f"{path}: found the label {values[np.argmin(is_whole)]:g}, wanted whole numbers")
    return values.astype(np.int64)
