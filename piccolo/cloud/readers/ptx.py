"""PTX files (Leica): grids of points, one scan after another, each with its place in the world.

A scan begins with ten lines: columns, rows, the scanner's position, its three axes, and a 4 x 4 matrix for
row vectors: [x y z 1]_world = [x y z 1] @ matrix. Then a line x y z intensity r g b for each cell.
"""

import math
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ...geometry.pose import transform_points
from ..settings import IN_METRES, Channel, CloudSettings
from . import reader
from .reader import MissingChannelError, PointSource, quote_line
from .text import NUM_WITH_INTENSITY, LineLayout, NumberLines

NUMBERS_A_LINE = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
MAX_COUNT_DIGITS = 9
COLORED = LineLayout((0, 1, 2, 4, 5, 6))  # x y z r g b
IN_GRAY = LineLayout((0, 1, 2, 3))  # x y z intensity
AFFINE = (0.0, 0.0, 0.0, 1.0)  # the matrix' last column
WANTED = "wanted a PTX file with lines x y z intensity r g b, colours 0-255"


class PtxScan(NamedTuple):
    """A scan's number of points and its transform to the world."""

    num_points: int  # lines in the file, with or without a return
    T_world_from_scanner: Array  # (4, 4)


def open_ptx(path: Path, options: CloudSettings = IN_METRES, channel: Channel = "colors") -> PointSource:
    """Return the points of all scans of a PTX file, in the world.

    0 0 0 means that no beam came back, and is left out. A last scan with fewer lines than its header promises
    is read up to its end, with a warning; a last line without a line end is then left out as cut off.
    """
    lines = NumberLines(path, COLORED, WANTED)
    scans: list[PtxScan] = []
    warnings: list[str] = []
    while (scan := _take_header(lines)) is not None:
        last_of_header = lines.num_taken - 1
        if not scans and len((lines.peek() or b"").split()) == NUM_WITH_INTENSITY and channel == "colors":
            raise MissingChannelError(f"{path}: has intensity and no colours, {WANTED}")
        found = lines.skip(scan.num_points)
        if found < scan.num_points:
            found -= bool(found) and not _ends_with_a_line_end(path)
            promised = f"ends a header that promises {scan.num_points} points, found {found}"
            warnings.append(f"{lines.locate(last_of_header)} {promised}; the file may be cut off")
        scans.append(scan._replace(num_points=found))
    if not scans:
        raise InputError(f"{path}: no line of numbers, {WANTED}")
    read = partial(_read, path, COLORED if channel == "colors" else IN_GRAY, scans)
    source = reader.make_source(path, read, channel, num_points=sum(scan.num_points for scan in scans))
    poses = [scan.T_world_from_scanner for scan in scans]
    axes = [T[:3, 2] for T in poses if not np.array_equal(T, np.eye(4)) and np.linalg.norm(T[:3, 2]) > 0.0]
    station_axes = tuple(z / float(np.linalg.norm(z)) for z in axes)
    return source._replace(warnings=tuple(warnings), station_axes=station_axes)


def has_ptx_magic(head: bytes) -> bool:
    """Return True if the bytes `head` begin with counts of columns and rows and a position."""
    lines = [line.strip() for line in head.splitlines()[:3]]
    return len(lines) == 3 and None not in map(_numbers, lines, NUMBERS_A_LINE)


def _take_header(lines: NumberLines) -> PtxScan | None:
    """Return the next scan by its header; None at the end."""
    numbers: list[list[float]] = []
    for num_wanted in NUMBERS_A_LINE:
        line = lines.take_line()
        if line is None and not numbers:
            return None
        found = _numbers(line or b"", num_wanted)
        if found is None:
            wanted = "a count" if num_wanted == 1 else f"{num_wanted} numbers"
            place = f"{lines.locate(lines.num_taken - 1)} is {quote_line(line or b'')}"
            raise InputError(f"{place}, wanted {wanted} of a scan's header, {WANTED}")
        numbers.append(found)
    matrix = np.array(numbers[-4:])
    if tuple(matrix[:, 3]) != AFFINE:
        column = " ".join(f"{value:g}" for value in matrix[:, 3])
        place = f"{lines.locate(lines.num_taken - 1)} ends a matrix with the last column"
        raise InputError(f"{place} {column}, wanted 0 0 0 1")
    return PtxScan(int(numbers[0][0]) * int(numbers[1][0]), matrix.T)


def _numbers(line: bytes, num_wanted: int) -> list[float] | None:
    """Return the finite numbers of a header's line; None if it has others. A single one is a count."""
    fields = line.split()
    if num_wanted == 1 and not (line.isdigit() and len(line) <= MAX_COUNT_DIGITS):
        return None
    try:
        values = [float(field) for field in fields]
    except ValueError:
        return None
    return values if len(values) == num_wanted and all(map(math.isfinite, values)) else None


def _ends_with_a_line_end(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() in (b"\r", b"\n")


def _read(path: Path, layout: LineLayout, scans: list[PtxScan]) -> Iterator[reader.Part]:
    """Yield points (N, 3) whose beam came back, in the world, and their colours (N, 3) or intensity (N,)."""
    lines = NumberLines(path, layout, WANTED)
    for scan in scans:
        lines.skip(len(NUMBERS_A_LINE))
        for points, values in lines.read_points(scan.num_points):
            is_return = np.any(points != 0.0, axis=1)
            returned: Array = points[is_return].astype(np.float64, copy=False)
            with np.errstate(invalid="ignore", over="ignore"):  # infinite points are left out later
                yield transform_points(returned, scan.T_world_from_scanner), values[is_return]
