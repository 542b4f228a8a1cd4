"""Points from columns: chunks of arrays (N,) of x, y, z and red, green, blue, or of x, y, z and a scalar."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .colors import colored_chunks
from .reader import PointsWithScalar, RawCloud, point_label

Columns = list[NDArray[Any]]
ColumnReader = Callable[[], Iterator[Columns]]  # each call from the start


def points_of(columns: Columns) -> NDArray[np.float64]:
    """Points (N, 3) of the first three columns."""
    with np.errstate(invalid="ignore"):  # a NaN of the kind that signals
        return np.stack(columns[:3], axis=1, dtype=np.float64)


def read_colored(path: Path, read_columns: ColumnReader, brightest: float) -> Iterator[RawCloud]:
    """Yield points with colours from 0 to `brightest`; InputError where one is out of range."""
    parts = ((np.stack(c[:3], axis=1), np.stack(c[3:], axis=1)) for c in read_columns())
    return colored_chunks(parts, brightest, partial(point_label, path))


def read_scalar(read_columns: ColumnReader) -> Iterator[PointsWithScalar]:
    """Yield points with the scalar."""
    for columns in read_columns():
        yield points_of(columns), columns[3].astype(np.float64)
