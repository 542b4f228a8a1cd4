"""PTX files (Leica): grids of points, one scan after another, each with its place in the world.

A scan begins with ten lines: columns, rows, the scanner's position, its three axes, and a 4 x 4 matrix for
row vectors: [x y z 1]_world = [x y z 1] @ matrix. Then a line x y z intensity r g b for each cell.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from . import reader as raw
from .intensity import OPTION, in_gray
from .lines import quoted
from .point_lines import PointLines
from .reader import CUT, PLAIN, Format, PointSource, RawCloud, ReadOptions

NUMBERS_A_LINE = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
MAX_COUNT_DIGITS = 9
TARGETS = np.array([0, 1, 2, -1, 3, 4, 5])  # x y z intensity r g b
AFFINE = (0.0, 0.0, 0.0, 1.0)  # the matrix' last column
NUM_WITH_INTENSITY = 4  # columns: x y z intensity
WANTED = "wanted a PTX file with lines x y z intensity r g b, colours 0-255"


@dataclass(frozen=True)
class Scan:
    """How many points a scan has, and where they are in the world."""

    num_points: int  # lines that are there, whether the beam came back or not
    matrix: NDArray[np.float64]  # (4, 4), world from scanner, for row vectors


def open_ptx(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of all scans of a PTX file, in the world.

    0 0 0 stands where no beam came back and is left out. A last scan with fewer lines than its header
    promises is read as far as it goes, with a warning; a line without end is then taken for cut off.
    """
    lines = PointLines(path, WANTED)
    scans: list[Scan] = []
    warnings: list[str] = []
    has_colors = True
    while (header := _take_header(lines)) is not None:
        count, matrix = header
        end_of_header = lines.num_lines
        if not scans:
            has_colors = _has_colors(lines, options)
        found = lines.skip(count)
        if found < count:
            found -= bool(found) and not lines.has_line_end
            warnings.append(
                f"{path}: the header that ends at line {end_of_header} promises {count} points, found "
                f"{found}; the file may be cut off"
            )
        scans.append(Scan(found, matrix))
    if not scans:
        raise InputError(f"{path}: no line of numbers, {WANTED}")
    num_points = sum(scan.num_points for scan in scans)
    read_chunks = in_gray(path, partial(_read, path, scans, _take_measured))
    if has_colors:
        read_chunks = partial(_read_colored, path, scans)
    return PointSource(path, read_chunks, num_points, tuple(warnings))


def has_ptx_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` counts columns and rows, then names a position."""
    lines = [line.strip() for line in head.splitlines()[:3]]
    return len(lines) == 3 and None not in map(_numbers, lines, NUMBERS_A_LINE)


def _take_header(lines: PointLines) -> tuple[int, NDArray[np.float64]] | None:
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


def _has_colors(lines: PointLines, options: ReadOptions) -> bool:
    """False if the next line is x y z intensity, and that is welcome."""
    line = lines.next_line() or b""
    if len(line.split()) == NUM_WITH_INTENSITY and not options.intensity_as_gray:
        number = lines.line_number(0)
        raise InputError(
            f"{lines.path}: has intensity and no colours, line {number}: {quoted(line)}, {WANTED}; {OPTION}"
        )
    return len(line.split()) != NUM_WITH_INTENSITY


def _read_colored(path: Path, scans: list[Scan]) -> Iterator[RawCloud]:
    for points_world, colors in _read(path, scans, _take_colored):
        yield RawCloud(points_world, colors)


def _take_colored(lines: PointLines, count: int) -> tuple[NDArray[np.float64], NDArray[Any]]:
    found = lines.take_points(TARGETS, False, np.empty((count, 6)))
    return found.points_world, found.colors


def _take_measured(lines: PointLines, count: int) -> tuple[NDArray[np.float64], NDArray[Any]]:
    rows = np.empty((count, NUM_WITH_INTENSITY))
    rows = rows[: lines.take_rows(np.arange(NUM_WITH_INTENSITY), True, rows)]
    return rows[:, :3], rows[:, 3]


def _read(
    path: Path,
    scans: list[Scan],
    take: Callable[[PointLines, int], tuple[NDArray[np.float64], NDArray[Any]]],
) -> Iterator[tuple[NDArray[np.float64], NDArray[Any]]]:
    """Yield the points in the world that came back, and what else `take` finds in their lines."""
    lines = PointLines(path, WANTED)
    for scan in scans:
        lines.skip(len(NUMBERS_A_LINE))
        num_left = scan.num_points
        while num_left:
            points, values = take(lines, min(num_left, raw.CHUNK))
            if not len(points):
                raise InputError(f"{path}: {CUT}")
            num_left -= len(points)
            is_return: NDArray[np.bool_] = np.any(points != 0.0, axis=1)
            yield _in_world(points[is_return], scan.matrix), values[is_return]


def _in_world(points: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 3) in the world of points in the scanner's frame."""
    # Column by column, not by BLAS: a point's bits must not depend on its neighbours.
    x, y, z = points.T
    with np.errstate(invalid="ignore", over="ignore"):  # infinite points are left out later, for all formats
        columns = [x * a + y * b + z * c + d for a, b, c, d in matrix.T[:3]]
    return np.stack(columns, axis=1)


PTX = Format("PTX", frozenset({".ptx"}), has_ptx_magic, open_ptx)
