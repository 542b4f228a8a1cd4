"""Text files of lines x y z r g b, and PTS files: x y z intensity r g b after a count of points."""

from pathlib import Path

from ...errors import InputError
from .columns import color_names
from .number_lines import COMMENT_MARKS, NUM_WITH_INTENSITY, LineLayout, NumberLines, is_number, line_source
from .reader import PLAIN, CloudFormat, CloudReadOptions, PointSource, quoted
from .scalars import INTENSITY_NAMES

TEXT_SUFFIXES = frozenset({".txt", ".xyz", ".asc", ".csv", ".xyzrgb"})
HEAD_SIZE = 1 << 16  # bytes in which the header is looked for
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
WANTED = "wanted lines of numbers x y z r g b, with decimal points, colours 0-255"
# What is read of a line, by the number of its columns; those behind the seventh are left out.
COLUMNS = {NUM_WITH_INTENSITY: (0, 1, 2, 3), 6: (0, 1, 2, 3, 4, 5), 7: (0, 1, 2, 4, 5, 6)}
PTS_WANTED = "wanted lines x y z intensity r g b or x y z r g b, colours 0-255"


def open_text(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The points of a text file: whitespace, comma or semicolon between numbers, colours 0-255.

    A header line is passed over, or obeyed if it names x y z and r g b (or red green blue), or x y z and an
    intensity, or refused if it names a line's columns, x y z among them, but neither. Without one the first
    six columns count; four are x y z and intensity.
    """
    with path.open("rb") as file:
        layout = _layout(path, file.read(HEAD_SIZE))
    return line_source(path, layout, options, WANTED)


def _layout(path: Path, head: bytes) -> LineLayout:
    """How the file is laid out, judged by its first lines."""
    if b"\0" in head:
        raise InputError(f"{path}: holds bytes that are no text, {WANTED}")
    start = len(BYTE_ORDER_MARK) if head.startswith(BYTE_ORDER_MARK) else 0
    named: tuple[int, ...] = ()
    header = ""
    num_lines = 0
    for line in head[start:].splitlines(keepends=True):
        text = line.decode("latin-1").strip()
        fields = text.split(_delimiter(text))
        if _begins_numbers(line.strip(), fields):
            break
        named = _named_columns(text) or named
        if {*"xyz"} <= {*_names(text)}:
            header = text
        start += len(line)
        num_lines += 1
    else:
        raise InputError(f"{path}: no line of numbers at its beginning, {WANTED}")
    if not named and len(_names(header)) == len(fields):
        raise InputError(f"{path}: the columns are {quoted(header.encode())}, {WANTED}")
    has_intensity = len(fields) == NUM_WITH_INTENSITY and all(map(is_number, fields))
    columns = named or tuple(range(NUM_WITH_INTENSITY if has_intensity else 6))
    if len(fields) <= max(columns):
        found = f"line {num_lines + 1} has {len(fields)} columns (no colours?): {quoted(line)}"
        raise InputError(f"{path}: {found}, {WANTED}")
    return LineLayout(columns, start=start, delimiter=_delimiter(text))


def _delimiter(line: str) -> str | None:
    return next((mark for mark in ";," if mark in line), None)


def _begins_numbers(line: bytes, fields: list[str]) -> bool:
    """False for blank lines, comments, a header, and the count of points that .pts and CloudCompare write."""
    is_count = len(fields) == 1 and line.isdigit()
    return not line.startswith(COMMENT_MARKS) and not is_count and any(map(is_number, fields))


def _names(header: str) -> list[str]:
    """The names of columns in a header line, in lower case."""
    names = header.lstrip("#/ ")
    return [name.strip(' "').lower() for name in names.split(_delimiter(names))]


def _named_columns(header: str) -> tuple[int, ...]:
    """The fields of x, y, z and r, g, b, or of x, y, z and intensity, if a header line names them."""
    names = _names(header)
    once = [name for name in names if names.count(name) == 1]
    more = color_names(once) or tuple(name for name in once if name in INTENSITY_NAMES)[:1]
    wanted = (*"xyz", *more)
    return tuple(names.index(name) for name in wanted) if more and set(wanted) <= set(once) else ()


TEXT = CloudFormat("text x y z r g b", TEXT_SUFFIXES, lambda head: False, open_text)


def open_pts(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The points of all scans of a PTS file.

    All lines must have as many columns as the first one: x y z r g b if there are
    six, x y z intensity r g b and what else there is if there are more. The intensity may have any range. A
    lone count may stand before any line and is not compared with the lines, as many programs write a wrong
    one.
    """
    lines = NumberLines(path, LineLayout(has_counts=True), PTS_WANTED)
    line = lines.peek()
    if line is None:
        raise InputError(f"{path}: no line of numbers, {PTS_WANTED}")
    num_columns = len(line.split())
    if min(num_columns, 7) not in COLUMNS:
        found = f"{num_columns} columns, no colours: {quoted(line)}"
        raise InputError(f"{lines.locate(0)} has {found}, {PTS_WANTED}")
    layout = LineLayout(COLUMNS[min(num_columns, 7)], num_columns, has_counts=True)
    return line_source(path, layout, options, PTS_WANTED)


PTS = CloudFormat("PTS", frozenset({".pts"}), lambda head: False, open_pts)
