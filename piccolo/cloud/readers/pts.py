"""PTS files (Leica and others): lines x y z intensity r g b, with a count of points before each scan."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from . import reader as raw
from .intensity import OPTION, in_gray
from .lines import quoted
from .point_lines import PointLines
from .reader import PLAIN, Format, Measured, PointSource, RawCloud, ReadOptions

# What the columns are, by their number; those behind the seventh are left out.
COLUMNS = {6: (0, 1, 2, 3, 4, 5), 7: (0, 1, 2, -1, 3, 4, 5)}
NUM_WITH_INTENSITY = 4  # columns: x y z intensity
WANTED = "wanted lines x y z intensity r g b or x y z r g b, colours 0-255"


def open_pts(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of all scans of a PTS file.

    The first line of numbers tells the columns, and all others must have as many: x y z r g b if there are
    six, x y z intensity r g b and what else there is if there are more. The intensity may have any range. A
    lone count may stand before any line and is not held against the lines, as many programs write a wrong
    one.
    """
    lines = PointLines(path, WANTED)
    _skip_counts(lines)
    line = lines.take_line()
    if line is None:
        raise InputError(f"{path}: no line of numbers, {WANTED}")
    num_fields = len(line.split())
    if num_fields == NUM_WITH_INTENSITY:
        if not options.intensity_as_gray:
            raise InputError(f"{path}: has intensity and no colours, {WANTED}; {OPTION}")
        return PointSource(path, in_gray(path, lambda: _read_measured(path)))
    if num_fields < 6:
        raise InputError(
            f"{path}: line {lines.num_lines} has {num_fields} columns, no colours: {quoted(line)}, {WANTED}"
        )
    usual = COLUMNS[min(num_fields, 7)]
    targets = np.array([*usual, *[-1] * (num_fields - len(usual))])
    return PointSource(path, lambda: _read_chunks(path, targets))


def _skip_counts(lines: PointLines) -> None:
    while (lines.next_line() or b"").isdigit():
        lines.skip(1)


def _read_chunks(path: Path, targets: NDArray[np.int64]) -> Iterator[RawCloud]:
    lines, rows = PointLines(path, WANTED), np.empty((raw.CHUNK, 6))
    while True:
        _skip_counts(lines)
        found = lines.take_points(targets, True, rows)
        if not len(found.colors):
            return
        yield found


def _read_measured(path: Path) -> Iterator[Measured]:
    lines, rows = PointLines(path, WANTED), np.empty((raw.CHUNK, NUM_WITH_INTENSITY))
    while True:
        _skip_counts(lines)
        count = lines.take_rows(np.arange(NUM_WITH_INTENSITY), True, rows)
        if not count:
            return
        yield rows[:count, :3].copy(), rows[:count, 3].copy()


PTS = Format("PTS", frozenset({".pts"}), lambda head: False, open_pts)
