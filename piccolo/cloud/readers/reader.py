"""Types shared by the readers: chunks of points as they stand in a file."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..settings import CloudSettings, UpAxis

HEAD_SIZE = 512  # [byte] by which a format is known
CHUNK = 1 << 20  # points of a chunk, at most
MAX_BLOCK_SIZE = 1 << 28  # [byte] read at once, in which CHUNK records of 256 bytes have room
CUT = "the file was cut while it was read, wanted a whole file"

# points (N, 3) in the file's unit, and a number (N,) of each: intensity or label
PointsWithScalar = tuple[NDArray[np.float64], NDArray[np.float64]]
ScalarReader = Callable[[], Iterator[PointsWithScalar]]  # each call from the start


class RawCloud(NamedTuple):
    """Points in the file's order and unit, not yet checked."""

    points_world: NDArray[np.float64]  # (N, 3) in the file's unit, maybe NaN or infinite
    colors: NDArray[np.uint8]  # (N, 3) RGB


ChunkReader = Callable[[], Iterator[RawCloud]]  # each call from the start; InputError where the data break


class PointSource(NamedTuple):
    """A file whose header has been checked, and the way to its points."""

    path: Path
    read_chunks: ChunkReader
    num_points: int | None = None  # for the progress; None if only reading can tell
    warnings: tuple[str, ...] = ()  # one line each, for the user: what was decided about this file
    station_axes: tuple[
        NDArray[np.float64], ...
    ] = ()  # (3,) unit, in the file's axes: z of scanners with poses
    up: UpAxis = "z"  # the axis that points up by the format's specification or by convention


class CloudFormat(NamedTuple):
    """A format and its reader."""

    name: str
    suffixes: frozenset[str]  # lower case, with the dot
    has_magic: Callable[[bytes], bool]  # of a file's first HEAD_SIZE bytes; content goes before names
    open_source: Callable[[Path, CloudSettings], PointSource]
    has_labels: bool = False  # the reader knows them


def quoted(line: bytes) -> str:
    """The first line of `line`, short and printable, control characters as escapes."""
    text = line.splitlines()[0] if line else b""
    return ascii(text[:60].decode("latin-1")) + ("..." if len(text) > 60 else "")


def point_label(path: Path, index: int) -> str:
    """What messages call the point of that index in a file."""
    return f"{path}: point {index + 1}"
