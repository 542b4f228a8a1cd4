"""Writing PLY: binary vertices, a chunk at a time."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
    fields: list[tuple[str, np.dtype[Any]]] = [(name, points.dtype) for name in "xyz"]
    fields += [(name, np.dtype("u1")) for name in COLOR_NAMES]
    fields += [] if labels is None else [("label", np.dtype("i4"))]
    rows = np.empty(len(points), dtype=fields)
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    for k, name in enumerate(COLOR_NAMES):
        rows[name] = colors[:, k]
    if labels is not None:
        rows["label"] = labels
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


class PlyWriter:
    """Writes vertices as they come; the number in the header is set at the end."""

    def __init__(
        self, file: IO[bytes], dtype: np.dtype[Any], comments: Sequence[str] = (), more: Sequence[str] = ()
    ) -> None:
        self._file, self._dtype, self._comments, self._more = file, dtype.newbyteorder("<"), comments, more
        self.num_vertices = 0
        file.write(header(self._dtype, 0, comments, more))

    def add(self, rows: Rows) -> None:
        """Write vertices of the dtype that the file was begun with."""
        self._file.write(np.ascontiguousarray(rows.astype(self._dtype, copy=False)).data)
        self.num_vertices += len(rows)

    def add_rest(self, content: bytes) -> None:
        """Write some of the elements that follow the vertices, in little-endian order."""
        self._file.write(content)

    def finish(self) -> None:
        """Set the number of vertices."""
        self._file.seek(0)
        self._file.write(header(self._dtype, self.num_vertices, self._comments, self._more))


@contextmanager
def writing_ply(
    path: Path, dtype: np.dtype[Any], comments: Sequence[str] = (), more: Sequence[str] = ()
) -> Iterator[PlyWriter]:
    """A writer of `path`, which is there when all is written, and not after an error."""
    with replacing(path) as file:
        writer = PlyWriter(file, dtype, comments, more)
        yield writer
        writer.finish()


def write_ply(path: Path, rows: Rows) -> None:
    """Write vertices, whole or not at all."""
    with writing_ply(path, rows.dtype) as writer:
        writer.add(rows)
