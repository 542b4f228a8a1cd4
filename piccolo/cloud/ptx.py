"""PTX files (Leica): grids of points, one scan after another, each with its place in the world.

A scan begins with ten lines: columns, rows, the scanner's position, its three axes, and a 4 x 4 matrix for
row vectors: [x y z 1]_world = [x y z 1] @ matrix. Then a line x y z intensity r g b for each cell.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import raw
from .intensity import OPTION, in_gray
from .raw import PLAIN, Format, Measured, PointSource, RawCloud, ReadOptions
from .scan_lines import TextLines, mapped
from .text import quoted

NUMBERS_A_LINE = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
MAX_COUNT_DIGITS = 9
TARGETS = np.array([0, 1, 2, -1, 3, 4, 5])  # x y z intensity r g b
AFFINE = (0.0, 0.0, 0.0, 1.0)  # the matrix' last column
NUM_WITH_INTENSITY = 4  # columns: x y z intensity
WANTED = "wanted a PTX file with lines x y z intensity r g b, colours 0-255"


@dataclass(frozen=True)
class Scan:
    """Where a scan's points are in the file and in the world."""

    lines: TextLines  # before the first point
    num_points: int  # lines that are there, whether the beam came back or not
    matrix: NDArray[np.float64]  # (4, 4), world from scanner, for row vectors


def open_ptx(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of all scans of a PTX file, in the world.

    0 0 0 stands where no beam came back and is left out. A last scan with fewer lines than its header
    promises is read as far as it goes, with a warning; a line without end is then taken for cut off.
    """
    lines = TextLines(path, mapped(path), WANTED)
    scans: list[Scan] = []
    warnings: list[str] = []
    has_colors = True
    while (header := _take_header(lines)) is not None:
        count, matrix = header
        begin = lines.copy()
        if not scans:
            has_colors = _has_colors(begin.copy(), options)
        found = lines.skip_points(count)
        if found < count:
            found -= bool(found) and lines.data[-1] not in b"\r\n"
            warnings.append(
                f"{path}: the header that ends at line {begin.num_lines} promises {count} points, found "
                f"{found}; the file may be cut off"
            )
        scans.append(Scan(begin, found, matrix))
    num_points = sum(scan.num_points for scan in scans)
    read_chunks = in_gray(path, lambda: _read_measured(scans))
    if has_colors:
        read_chunks = partial(_read_chunks, scans)
    return PointSource(path, read_chunks, num_points, tuple(warnings))


def has_ptx_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` counts columns and rows, then names a position."""
    lines = [line.strip() for line in head.splitlines()[:3]]
    return len(lines) == 3 and None not in map(_numbers, lines, NUMBERS_A_LINE)


def _take_header(lines: TextLines) -> tuple[int, NDArray[np.float64]] | None:
    """How many points the next scan's header promises, and its matrix; None at the file's end."""
    numbers: list[list[float]] = []
    for num_wanted in NUMBERS_A_LINE:
        line = lines.take_line()
        if line is None and not numbers:
            return None
        found = _numbers(line or b"", num_wanted)
        if found is None:
            raise InputError(
                f"{lines.path}: line {lines.num_lines} is {quoted(line or b'')}, wanted "
                f"{'a count' if num_wanted == 1 else f'{num_wanted} numbers'} of a scan's header, {WANTED}"
            )
        numbers.append(found)
    matrix = np.array(numbers[-4:])
    if tuple(matrix[:, 3]) != AFFINE:
        raise InputError(
            f"{lines.path}: the matrix that ends at line {lines.num_lines} has the last column "
            f"{' '.join(f'{value:g}' for value in matrix[:, 3])}, wanted 0 0 0 1"
        )
    return int(numbers[0][0]) * int(numbers[1][0]), matrix


def _numbers(line: bytes, num_wanted: int) -> list[float] | None:
    """The finite numbers of a header's line, one of them a count; None if the line has anything else."""
    fields = line.split()
    if num_wanted == 1 and not (line.isdigit() and len(line) <= MAX_COUNT_DIGITS):
        return None
    try:
        values = [float(field) for field in fields]
    except ValueError:
        return None
    return values if len(values) == num_wanted and all(map(math.isfinite, values)) else None


def _has_colors(lines: TextLines, options: ReadOptions) -> bool:
    """False if the next line is x y z intensity, and that is welcome."""
    line = lines.take_line() or b""
    if len(line.split()) == NUM_WITH_INTENSITY and not options.intensity_as_gray:
        raise InputError(
            f"{lines.path}: has intensity and no colours, line {lines.num_lines}: {quoted(line)}, {WANTED}; "
            f"{OPTION}"
        )
    return len(line.split()) != NUM_WITH_INTENSITY


def _read_measured(scans: list[Scan]) -> Iterator[Measured]:
    for scan in scans:
        lines = scan.lines.copy()
        num_left = scan.num_points
        while num_left:
            rows = np.empty((min(num_left, raw.CHUNK), NUM_WITH_INTENSITY))
            rows = rows[: lines.take_rows(np.arange(NUM_WITH_INTENSITY), True, rows)]
            num_left -= len(rows)
            rows = rows[np.any(rows[:, :3] != 0.0, axis=1)]
            yield _in_world(rows[:, :3], scan.matrix), rows[:, 3].copy()


def _read_chunks(scans: list[Scan]) -> Iterator[RawCloud]:
    for scan in scans:
        lines = scan.lines.copy()
        num_left = scan.num_points
        while num_left:
            found = lines.take_points(TARGETS, False, np.empty((min(num_left, raw.CHUNK), 6)))
            num_left -= len(found.colors)
            is_return: NDArray[np.bool_] = np.any(found.points_world != 0.0, axis=1)
            yield RawCloud(_in_world(found.points_world[is_return], scan.matrix), found.colors[is_return])


def _in_world(points: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 3) in the world of points in the scanner's frame."""
    # Column by column, not by BLAS: a point's bits must not depend on its neighbours.
    x, y, z = points.T
    with np.errstate(invalid="ignore", over="ignore"):  # infinite points are left out later, for all formats
        columns = [x * a + y * b + z * c + d for a, b, c, d in matrix.T[:3]]
    return np.stack(columns, axis=1)


PTX = Format("PTX", frozenset({".ptx"}), has_ptx_magic, open_ptx)
