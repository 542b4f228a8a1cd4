"""Writing PLY: binary vertices, a chunk at a time."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.atomic import replacing

TYPE_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip
COLOR_NAMES = ("red", "green", "blue")
MAX_DIGITS = 20  # of the number of vertices, for which the header keeps room

Rows = NDArray[np.void]  # structured, a field a property


def vertex_rows(
    points: NDArray[np.floating[Any]], colors: NDArray[np.uint8], labels: NDArray[np.int32] | None = None
) -> Rows:
    """Vertices of points (N, 3), float32 or float64 as they are, colours (N, 3) RGB and labels (N,)."""
    columns = dict(zip(("x", "y", "z", *COLOR_NAMES), [*points.T, *colors.T], strict=True))
    if labels is not None:
        columns["label"] = labels
    rows = np.empty(len(points), dtype=[(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def header(
    dtype: np.dtype[Any], num_vertices: int, comments: Sequence[str] = (), more: Sequence[str] = ()
) -> bytes:
    """The header of binary vertices; its size does not depend on their number.

    `more` are the lines of the elements that follow the vertices.
    """
    # The room that the number doesn't need stands in a comment: a padded number is not read everywhere.
    room = "comment " + "." * (MAX_DIGITS - len(str(num_vertices)))
    properties = [f"property {TYPE_NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", room, *(f"comment {text}" for text in comments)]
    lines += [f"element vertex {num_vertices}", *properties, *more, "end_header", ""]
    return "\n".join(lines).encode("ascii", "replace")


@dataclass
class PlyWriter:
    """Writes vertices as they come."""

    file: IO[bytes]  # after the vertices the caller may write more elements, in little-endian order
    dtype: np.dtype[Any]  # little-endian
    num_vertices: int = 0

    def add(self, rows: Rows) -> None:
        """Write vertices of the dtype that the file was begun with."""
        self.file.write(np.ascontiguousarray(rows.astype(self.dtype, copy=False)).data)
        self.num_vertices += len(rows)


@contextmanager
def writing_ply(
    path: Path, dtype: np.dtype[Any], comments: Sequence[str] = (), more: Sequence[str] = ()
) -> Iterator[PlyWriter]:
    """A writer of `path`, which is there when all is written and counted, and not after an error."""
    with replacing(path) as file:
        writer = PlyWriter(file, dtype.newbyteorder("<"))
        file.write(header(writer.dtype, 0, comments, more))
        yield writer
        file.seek(0)
        file.write(header(writer.dtype, writer.num_vertices, comments, more))


def write_ply(path: Path, rows: Rows) -> None:
    """Write vertices, whole or not at all."""
    with writing_ply(path, rows.dtype) as writer:
        writer.add(rows)
