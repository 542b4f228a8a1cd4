"""A PLY file with all that it holds, to be written again with other coordinates."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ply_writer import Rows
from .readers.ply import PLY, PlyHeader, place_of_vertices, read_columns, read_header
from .readers.reader import CHUNK, HEAD_SIZE

BLOCK = 1 << 22  # [byte] copied at once


@dataclass(frozen=True)
class PlyCopy:
    """The vertices' rows with all their properties, and what stands around them."""

    dtype: np.dtype[Any]  # little-endian
    read_rows: Callable[[], Iterator[Rows]]  # each call from the start
    num_chunks: int
    comments: tuple[str, ...]
    more: tuple[str, ...]  # the header's lines about the elements that follow the vertices
    read_rest: Callable[[], Iterator[bytes]]  # these elements
    left_out: tuple[str, ...]  # names of elements that can't be copied


def open_copy(path: Path) -> PlyCopy:
    """A PLY file that open_ply reads; InputError as there.

    Elements after the vertices are copied as bytes, so those of ASCII and big-endian files are left out, as
    are elements before the vertices.
    """
    header = read_header(path)
    dtype = header.vertices.dtype("<")
    names = dtype.names or ()
    full = [k for k, count in enumerate(header.counts) if count and k != header.index]
    copied = [k for k in full if k > header.index and header.byte_order == "<"]
    return PlyCopy(
        dtype=dtype,
        read_rows=lambda: (_rows(columns, dtype) for columns in read_columns(header, names)),
        num_chunks=math.ceil(header.counts[header.index] / CHUNK),
        comments=_comments(header),
        more=tuple(line for k in copied for line in _lines(header, k)),
        read_rest=lambda: _blocks(header) if copied else iter(()),
        left_out=tuple(header.elements[k].name for k in full if k not in copied),
    )


def is_ply(path: Path) -> bool:
    """True if a file's first bytes say that it is PLY."""
    with path.open("rb") as file:
        return PLY.has_magic(file.read(HEAD_SIZE))


def _rows(columns: list[NDArray[np.generic]], dtype: np.dtype[Any]) -> Rows:
    rows = np.empty(len(columns[0]), dtype)
    for name, column in zip(dtype.names or (), columns, strict=True):
        if dtype[name].kind in "iu" and column.dtype.kind == "f":  # of an ASCII file
            limits = np.iinfo(dtype[name])
            rows[name] = np.clip(np.nan_to_num(np.rint(column)), limits.min, limits.max)
        else:
            rows[name] = column
    return rows


def _comments(header: PlyHeader) -> tuple[str, ...]:
    with header.path.open("rb") as file:
        lines = file.read(header.size).decode("ascii", "replace").splitlines()
    return tuple(line.removeprefix("comment ") for line in lines if line.startswith("comment "))


def _lines(header: PlyHeader, k: int) -> list[str]:
    """The header's lines of an element, with its count, which plyfile was not given."""
    element = header.elements[k]
    return [f"element {element.name} {header.counts[k]}", *map(str, element.properties)]


def _blocks(header: PlyHeader) -> Iterator[bytes]:
    """Yield all that follows the vertices."""
    offset, count, dtype = place_of_vertices(header)
    with header.path.open("rb") as file:
        file.seek(offset + count * dtype.itemsize)
        while block := file.read(BLOCK):
            yield block
