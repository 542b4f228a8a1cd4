"""Text files of lines x y z r g b."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .intensity import INTENSITY_NAMES, OPTION, in_gray
from .lines import LineReader
from .raw import CHUNK, PLAIN, Format, Measured, PointSource, RawCloud, ReadOptions
from .rows import NOT_A_NUMBER, PARSED, SPACE, TOO_FEW

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


def _read_rows(path: Path, layout: Layout) -> Iterator[NDArray[np.float64]]:
    """Yield the wanted columns (N, C)."""
    targets = np.full(max(layout.columns) + 1, -1)
    targets[list(layout.columns)] = np.arange(len(layout.columns))
    reader = LineReader(path, layout.start)
    num_rows = CHUNK
    while num_rows == CHUNK:
        rows = np.empty((CHUNK, len(layout.columns)))
        num_rows, status = reader.read(layout.separator, targets, False, rows)
        if status != PARSED:
            line_number = layout.num_lines + reader.num_lines
            raise InputError(f"{path}: {_complaint(line_number, reader.line(), status, len(targets))}")
        yield rows[:num_rows]


def _read_colored(path: Path, layout: Layout) -> Iterator[RawCloud]:
    num_before = 0
    for rows in _read_rows(path, layout):
        _check_colors(path, layout, rows, num_before)
        num_before += len(rows)
        yield RawCloud(np.ascontiguousarray(rows[:, :3]), np.rint(rows[:, 3:]).astype(np.uint8))


def _read_measured(path: Path, layout: Layout) -> Iterator[Measured]:
    for rows in _read_rows(path, layout):
        yield np.ascontiguousarray(rows[:, :3]), rows[:, 3]


def quoted(line: bytes) -> str:
    """The first line of `line`, short and printable, control characters as escapes."""
    text = line.splitlines()[0] if line else b""
    return ascii(text[:60].decode("latin-1")) + ("..." if len(text) > 60 else "")


def _complaint(line_number: int, line: bytes, status: int, num_wanted: int) -> str:
    what = {
        NOT_A_NUMBER: "is not all numbers",
        TOO_FEW: f"has fewer than {num_wanted} columns",
    }[status]
    return f"line {line_number} {what}: {quoted(line)}, {WANTED}"


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


def _check_colors(path: Path, layout: Layout, rows: NDArray[np.float64], num_before: int) -> None:
    """Refuse a colour outside 0-255 in `rows` (N, 6), naming its line; black out those without a position."""
    rows[~np.isfinite(rows[:, :3]).all(axis=1), 3:] = 0.0
    colors = rows[:, 3:]
    is_wrong = ~((colors >= 0.0) & (colors <= 255.0)).all(axis=1)
    if not is_wrong.any():
        return
    first = int(np.argmax(is_wrong))
    reader = LineReader(path, layout.start)
    reader.read(layout.separator, np.empty(0, np.int64), False, np.empty((num_before + first + 1, 0)))
    found = " ".join(f"{value:g}" for value in colors[first])
    raise InputError(f"{path}: line {layout.num_lines + reader.num_lines} has the colour {found}, {WANTED}")


TEXT = Format("text x y z r g b", TEXT_SUFFIXES, lambda head: False, open_text)
