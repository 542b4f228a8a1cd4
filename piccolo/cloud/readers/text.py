"""Text files of lines x y z r g b."""

from pathlib import Path

from ...errors import InputError
from .colors import color_names
from .intensity import INTENSITY_NAMES
from .number_lines import COMMENT_MARKS, NUM_WITH_INTENSITY, LineLayout, is_number, line_source
from .reader import PLAIN, CloudFormat, CloudReadOptions, PointSource, quoted

TEXT_SUFFIXES = frozenset({".txt", ".xyz", ".asc", ".csv", ".xyzrgb"})
HEAD_SIZE = 1 << 16  # bytes in which the header is looked for
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
WANTED = "wanted lines of numbers x y z r g b, with decimal points, colours 0-255"


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
