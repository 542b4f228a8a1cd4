"""PTS files (Leica and others): lines x y z intensity r g b, with a count of points before each scan."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import raw
from .intensity import OPTION, in_gray
from .raw import PLAIN, Format, Measured, PointSource, RawCloud, ReadOptions
from .scan_lines import TextLines, mapped
from .text import quoted

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
    lines = TextLines(path, mapped(path), WANTED)
    begin = _skip_counts(lines)
    line = lines.take_line()
    if line is None:
        raise InputError(f"{path}: no line of numbers, {WANTED}")
    num_fields = len(line.split())
    if num_fields == NUM_WITH_INTENSITY:
        if not options.intensity_as_gray:
            raise InputError(f"{path}: has intensity and no colours, {WANTED}; {OPTION}")
        return PointSource(path, in_gray(path, lambda: _read_measured(begin.copy())))
    if num_fields < 6:
        raise InputError(
            f"{path}: line {lines.num_lines} has {num_fields} columns, no colours: {quoted(line)}, {WANTED}"
        )
    usual = COLUMNS[min(num_fields, 7)]
    targets = np.array([*usual, *[-1] * (num_fields - len(usual))])
    return PointSource(path, lambda: _read_chunks(begin.copy(), targets))


def _skip_counts(lines: TextLines) -> TextLines:
    """The place behind the counts that stand here; `lines` is there too."""
    ahead = lines.copy()
    while (line := ahead.take_line()) is not None and line.isdigit():
        lines.position, lines.num_lines = ahead.position, ahead.num_lines
    return lines.copy()


def _read_chunks(lines: TextLines, targets: NDArray[np.int64]) -> Iterator[RawCloud]:
    rows = _room(lines, 6)
    while True:
        _skip_counts(lines)
        found = lines.take_points(targets, True, rows)
        if not len(found.colors):
            return
        yield found


def _read_measured(lines: TextLines) -> Iterator[Measured]:
    rows = _room(lines, NUM_WITH_INTENSITY)
    while True:
        _skip_counts(lines)
        count = lines.take_rows(np.arange(NUM_WITH_INTENSITY), True, rows)
        if not count:
            return
        yield rows[:count, :3].copy(), rows[:count, 3].copy()


def _room(lines: TextLines, num_columns: int) -> NDArray[np.float64]:
    """Rows for a chunk, or for all that the file can hold: a field takes two bytes."""
    return np.empty((min(raw.CHUNK, 1 + len(lines.data) // (2 * num_columns)), num_columns))


PTS = Format("PTS", frozenset({".pts"}), lambda head: False, open_pts)
