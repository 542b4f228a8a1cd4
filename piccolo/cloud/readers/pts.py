"""PTS files (Leica and others): lines x y z intensity r g b, with a count of points before each scan."""

from pathlib import Path

from ...errors import InputError
from .number_lines import NUM_WITH_INTENSITY, LineLayout, NumberLines, line_source
from .reader import PLAIN, CloudFormat, CloudReadOptions, PointSource, quoted

# What is read of a line, by the number of its columns; those behind the seventh are left out.
COLUMNS = {NUM_WITH_INTENSITY: (0, 1, 2, 3), 6: (0, 1, 2, 3, 4, 5), 7: (0, 1, 2, 4, 5, 6)}
WANTED = "wanted lines x y z intensity r g b or x y z r g b, colours 0-255"


def open_pts(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The points of all scans of a PTS file.

    All lines must have as many columns as the first one: x y z r g b if there are
    six, x y z intensity r g b and what else there is if there are more. The intensity may have any range. A
    lone count may stand before any line and is not compared with the lines, as many programs write a wrong
    one.
    """
    lines = NumberLines(path, LineLayout(has_counts=True), WANTED)
    line = lines.peek()
    if line is None:
        raise InputError(f"{path}: no line of numbers, {WANTED}")
    num_columns = len(line.split())
    if min(num_columns, 7) not in COLUMNS:
        raise InputError(f"{lines.locate(0)} has {num_columns} columns, no colours: {quoted(line)}, {WANTED}")
    layout = LineLayout(COLUMNS[min(num_columns, 7)], num_columns, has_counts=True)
    return line_source(path, layout, options, WANTED)


PTS = CloudFormat("PTS", frozenset({".pts"}), lambda head: False, open_pts)
