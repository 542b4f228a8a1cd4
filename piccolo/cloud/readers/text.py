"""Text files of lines x y z r g b."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from . import reader as raw
from .intensity import INTENSITY_NAMES, OPTION, in_gray
from .lines import quoted
from .point_lines import PointLines
from .reader import PLAIN, Format, Measured, PointSource, RawCloud, ReadOptions
from .rows import SPACE

TEXT_SUFFIXES = frozenset({".txt", ".xyz", ".asc", ".csv", ".xyzrgb"})
COLUMN_NAMES = ("xyzrgb", ("x", "y", "z", "red", "green", "blue"))
NUM_WITH_INTENSITY = 4  # columns: x y z intensity
USUAL_COLUMNS = (0, 1, 2, 3, 4, 5)
HEAD_SIZE = 1 << 16  # bytes in which the header is looked for
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
WANTED = "wanted lines of numbers x y z r g b, with decimal points, colours 0-255"


@dataclass(frozen=True)
class Layout:
    """Where the numbers begin and which are wanted."""

    start: int  # [byte] of the first line of numbers
    num_lines: int  # lines before it
    separator: int  # byte between fields
    columns: tuple[int, ...]  # the fields of x, y, z and r, g, b, or x, y, z and intensity


def open_text(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of a text file: whitespace, comma or semicolon between numbers, colours 0-255.

    A header line is passed over, or obeyed if it names x y z and r g b (or red green blue), or x y z and an
    intensity, or refused if it names a line's columns, x y z among them, but neither. Without one the first
    six columns count; four are x y z and intensity.
    """
    with path.open("rb") as file:
        layout = _layout(path, file.read(HEAD_SIZE))
    if len(layout.columns) > NUM_WITH_INTENSITY:
        return PointSource(path, lambda: _read_colored(path, layout))
    if not options.intensity_as_gray:
        raise InputError(f"{path}: has intensity and no colours, {WANTED}; {OPTION}")
    return PointSource(path, in_gray(path, lambda: _read_measured(path, layout)))


def _lines(path: Path, layout: Layout) -> tuple[PointLines, NDArray[np.int64], NDArray[np.float64]]:
    """The lines of numbers, what their columns are, and room for a chunk."""
    targets = np.full(max(layout.columns) + 1, -1)
    targets[list(layout.columns)] = np.arange(len(layout.columns))
    lines = PointLines(path, WANTED, layout.start, layout.num_lines, layout.separator)
    return lines, targets, np.empty((raw.CHUNK, len(layout.columns)))


def _read_colored(path: Path, layout: Layout) -> Iterator[RawCloud]:
    lines, targets, rows = _lines(path, layout)
    while len((found := lines.take_points(targets, False, rows)).colors):
        yield found


def _read_measured(path: Path, layout: Layout) -> Iterator[Measured]:
    lines, targets, rows = _lines(path, layout)
    while count := lines.take_rows(targets, False, rows):
        yield rows[:count, :3].copy(), rows[:count, 3].copy()


def _layout(path: Path, head: bytes) -> Layout:
    """How the file is laid out, judged by its first lines."""
    if b"\0" in head:
        raise InputError(f"{path}: holds bytes that are no text, {WANTED}")
    start = len(BYTE_ORDER_MARK) if head.startswith(BYTE_ORDER_MARK) else 0
    named: tuple[int, ...] | None = None
    header = ""
    num_lines = 0
    for line in head[start:].splitlines(keepends=True):
        text = line.decode("latin-1").strip()
        fields = _fields(text)
        if _begins_numbers(text, fields):
            break
        named = _named_columns(text) or named
        if {*"xyz"} <= {*_names(text)}:
            header = text
        start += len(line)
        num_lines += 1
    else:
        raise InputError(f"{path}: no line of numbers at its beginning, {WANTED}")
    if named is None and len(_names(header)) == len(fields):
        raise InputError(f"{path}: the columns are {quoted(header.encode())}, {WANTED}")
    columns = named or _usual_columns(fields)
    if len(fields) <= max(columns):
        raise InputError(
            f"{path}: line {num_lines + 1} has {len(fields)} columns (no colours?): {quoted(line)}, {WANTED}"
        )
    return Layout(start, num_lines, _separator(text), columns)


def _usual_columns(fields: list[str]) -> tuple[int, ...]:
    has_intensity = len(fields) == NUM_WITH_INTENSITY and all(map(_is_number, fields))
    return USUAL_COLUMNS[:NUM_WITH_INTENSITY] if has_intensity else USUAL_COLUMNS


def _separator(line: str) -> int:
    return next((ord(mark) for mark in ";," if mark in line), SPACE)


def _fields(line: str) -> list[str]:
    separator = chr(_separator(line))
    return line.split(None if separator == " " else separator)


def _begins_numbers(line: str, fields: list[str]) -> bool:
    """False for blank lines, comments, a header, and the count of points that .pts and CloudCompare write."""
    is_count = len(fields) == 1 and fields[0].isdigit()
    return not line.startswith(("#", "//")) and not is_count and any(map(_is_number, fields))


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _names(header: str) -> list[str]:
    """The names of columns in a header line, in lower case."""
    return [name.strip(' "').lower() for name in _fields(header.lstrip("#/ "))]


def _named_columns(header: str) -> tuple[int, ...] | None:
    """The fields of x, y, z and r, g, b, or of x, y, z and intensity, if a header line names them."""
    names = _names(header)
    with_intensity = (("x", "y", "z", name) for name in sorted(INTENSITY_NAMES))
    for wanted in (*COLUMN_NAMES, *with_intensity):
        if all(names.count(name) == 1 for name in wanted):
            return tuple(names.index(name) for name in wanted)
    return None


TEXT = Format("text x y z r g b", TEXT_SUFFIXES, lambda head: False, open_text)
