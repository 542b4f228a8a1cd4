"""Records of a fixed length, read as they are needed."""

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from . import reader as raw
from .reader import CUT

MAX_BLOCK_SIZE = 1 << 28  # [byte] read at once, in which raw.CHUNK records of 256 bytes have room


def read_records(path: Path, offset: int, count: int, dtype: np.dtype[Any]) -> Iterator[NDArray[Any]]:
    """Yield `count` records from byte `offset` on, raw.CHUNK or fewer at once."""
    most = max(1, min(raw.CHUNK, MAX_BLOCK_SIZE // dtype.itemsize))
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
