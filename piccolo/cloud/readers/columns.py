"""Points from columns: chunks of arrays (N,) of x, y, z and red, green, blue, or of x, y, z and a scalar."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..label_colors import Labels
from . import reader as raw
from .colors import brightest_of, colored_chunks
from .reader import CUT, ChunkReader, PointSource, PointsWithScalar, RawCloud, point_label
from .scalars import intensity_reader, label_reader

Columns = list[NDArray[Any]]
ColumnReader = Callable[[], Iterator[Columns]]  # each call from the start


def read_records(path: Path, offset: int, count: int, dtype: np.dtype[Any]) -> Iterator[NDArray[Any]]:
    """Yield `count` records from byte `offset` on, raw.CHUNK or fewer at once."""
    most = max(1, min(raw.CHUNK, raw.MAX_BLOCK_SIZE // dtype.itemsize))
    with path.open("rb") as file:
        file.seek(offset)
        for begin in range(0, count, most):
            yield take_records(file, path, min(most, count - begin), dtype)


def take_records(file: BufferedReader, path: Path, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The next `count` records of a file; InputError if there are fewer."""
    records = np.empty(count, dtype)
    if file.readinto(records.view(np.uint8).data) < records.nbytes:
        raise InputError(f"{path}: {CUT}")
    return records


def in_chunks(columns: list[NDArray[Any]]) -> Iterator[list[NDArray[Any]]]:
    """Yield arrays of the same length, raw.CHUNK or fewer rows at once."""
    for begin in range(0, len(columns[0]), raw.CHUNK):
        yield [column[begin : begin + raw.CHUNK] for column in columns]


def points_of(columns: Columns) -> NDArray[np.float64]:
    """Points (N, 3) of the first three columns."""
    with np.errstate(invalid="ignore"):  # a NaN of the kind that signals
        return np.stack(columns[:3], axis=1, dtype=np.float64)


def column_source(
    path: Path, read_columns: ColumnReader, types: Sequence[str], num_points: int, labels: Labels | None
) -> PointSource:
    """Points with three colours of these types, as "u1", or with one scalar: a label, else the intensity."""
    if len(types) == 3:
        read_chunks: ChunkReader = partial(_colored, path, read_columns, brightest_of(path, types))
    elif labels:
        read_chunks = label_reader(path, partial(_with_scalar, read_columns), labels)
    else:
        read_chunks = intensity_reader(path, partial(_with_scalar, read_columns))
    return PointSource(path, read_chunks, num_points)


def _colored(path: Path, read_columns: ColumnReader, brightest: float) -> Iterator[RawCloud]:
    parts = ((np.stack(c[:3], axis=1), np.stack(c[3:], axis=1)) for c in read_columns())
    return colored_chunks(parts, brightest, partial(point_label, path))


def _with_scalar(read_columns: ColumnReader) -> Iterator[PointsWithScalar]:
    return ((points_of(columns), columns[3].astype(np.float64)) for columns in read_columns())
