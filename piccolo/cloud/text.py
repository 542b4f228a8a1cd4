"""Text files of lines x y z r g b."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .raw import Format, PointSource, RawCloud
from .rows import NOT_A_NUMBER, SPACE, TOO_FEW, parse_rows

TEXT_SUFFIXES = frozenset({".txt", ".xyz", ".asc", ".csv", ".xyzrgb"})
COLUMN_NAMES = ("xyzrgb", ("x", "y", "z", "red", "green", "blue"))
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
    columns: tuple[int, ...]  # the fields of x, y, z, r, g, b


def read_text(path: Path) -> RawCloud:
    """The points of a text file: whitespace, comma or semicolon between numbers, colours 0-255.

    A header line is passed over, or obeyed if it names x y z and r g b (or red green blue), or refused if it
    names a line's columns, x y z among them, but no colours. Without one the first six columns count.
    """
    data = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
    layout = _layout(path, bytes(data[:HEAD_SIZE]))
    targets = np.full(max(layout.columns) + 1, -1)
    targets[list(layout.columns)] = np.arange(6)
    rows = np.empty((_max_rows(data, layout), 6))
    num_rows, num_lines, position, status = parse_rows(
        data, layout.start, layout.separator, targets, False, rows
    )
    if status < 0:
        line = bytes(data[position : position + 400])
        raise InputError(f"{path}: {_complaint(layout.num_lines + num_lines, line, status, len(targets))}")
    rows = rows[:num_rows]
    _check_colors(path, data, layout, rows)
    return RawCloud(np.ascontiguousarray(rows[:, :3]), np.rint(np.nan_to_num(rows[:, 3:])).astype(np.uint8))


def open_text(path: Path) -> PointSource:
    """The points of a text file; see read_text."""
    return PointSource(path, lambda: iter([read_text(path)]))


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


def _max_rows(data: NDArray[np.uint8], layout: Layout) -> int:
    """No fewer rows than there are: a line end closes each but the last, and six fields take 12 bytes."""
    num_ends = sum(
        int(np.count_nonzero((block == ord("\n")) | (block == ord("\r"))))
        for block in np.array_split(data[layout.start :], 1 + len(data) // (1 << 24))
    )
    return min(num_ends, len(data) // 12) + 1


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
    columns = named or USUAL_COLUMNS
    if len(fields) <= max(columns):
        raise InputError(
            f"{path}: line {num_lines + 1} has {len(fields)} columns (no colours?): {quoted(line)}, {WANTED}"
        )
    return Layout(start, num_lines, _separator(text), columns)


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
    """The fields of x, y, z, r, g, b in a header line that names them all, else None."""
    names = _names(header)
    for wanted in COLUMN_NAMES:
        if all(names.count(name) == 1 for name in wanted):
            return tuple(names.index(name) for name in wanted)
    return None


def _check_colors(path: Path, data: NDArray[np.uint8], layout: Layout, rows: NDArray[np.float64]) -> None:
    """Refuse a colour outside 0-255 in `rows` (N, 6), naming its line; black out those without a position."""
    rows[~np.isfinite(rows[:, :3]).all(axis=1), 3:] = 0.0
    colors = rows[:, 3:]
    is_wrong = ~((colors >= 0.0) & (colors <= 255.0)).all(axis=1)
    if not is_wrong.any():
        return
    first = int(np.argmax(is_wrong))
    targets = np.empty(0, dtype=np.int64)
    _, num_lines, _, _ = parse_rows(
        data, layout.start, layout.separator, targets, False, np.empty((first + 1, 0))
    )
    found = " ".join(f"{value:g}" for value in colors[first])
    raise InputError(f"{path}: line {layout.num_lines + num_lines} has the colour {found}, {WANTED}")


TEXT = Format("text x y z r g b", TEXT_SUFFIXES, lambda head: False, open_text)
