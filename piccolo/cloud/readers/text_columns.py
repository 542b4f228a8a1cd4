"""The columns of lines of numbers: named by the user, by a header line, or else known by their values."""

import codecs
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...system.arrays import Array
from ...system.errors import InputError
from ...system.files.json_file import is_number
from ..cloud_settings import COLUMNS, CloudSettings
from .reader import COLOR_NAMES, CUT, NUM_COLORED, POINT_NAMES

COMMENT_MARKS = (b"#", b"//")
MARKS = b"\"'[](){}"  # around numbers or lines
TEXT_HEAD_SIZE = 1 << 16  # [byte] in which a header is searched
NUM_SAMPLED_PLACES = 16  # places in the file from which lines are sampled
SAMPLE_SIZE = 1 << 13  # [byte] that are read at each
MAX_COLUMNS = 64
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
UNIT = re.compile(r"[\[(].*")  # in brackets after a column's name
HEX_COLOR = re.compile(rb"(?<=[\s;,])[\"']?(?:#|0[xX]ff|0[xX])([0-9a-fA-F]{6})(?![0-9a-fA-F])[\"']?")
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
SKIP = "-"  # name of a column that is not used
POSITION = ("x", "y", "z")
RGB = ("red", "green", "blue")
NORMAL = ("nx", "ny", "nz")
NORMAL_LENGTH_ERROR = 0.01  # by which the length of a normal may differ from 1
FEW_ROWS = 0.1  # a column of numbers has none in a smaller fraction of the rows
MOST_ROWS = 0.95  # fraction of the rows with normals, if columns are normals
FAR_FACTOR = 4.0  # an intensity and two colours differ more than so many times as much as three colours
MAX_BYTE = 255.0
MAX_VALUE = 65535.0
BEFORE = 2  # columns before x y z, at most: an index, or FARO's row and column
BARE = (*POSITION, "intensity")
# columns of which no warning is needed
USUAL = (POSITION, BARE, (*POSITION, *RGB))
USUAL_OF_PTS = ((*BARE, *RGB),)


class Spelling(NamedTuple):
    """The way in which numbers are written in a file's lines."""

    has_decimal_commas: bool = False
    has_hex_colors: bool = False  # #rrggbb or 0xrrggbb
    marks: bytes = b""  # characters of MARKS that are removed

    def plain(self, line: bytes) -> bytes:
        """Return a line without marks, with decimal points, and with hexadecimal colours as whole numbers."""
        line = line.translate(None, self.marks) if self.marks else line
        line = line.replace(b",", b".") if self.has_decimal_commas else line
        return HEX_COLOR.sub(lambda found: b"%d" % int(found[1], 16), line) if self.has_hex_colors else line


class Fields(NamedTuple):
    """The layout of a text file's lines of numbers, as its beginning tells it."""

    start: int  # [byte] of the first line of numbers
    num_lines: int  # before that line
    first: bytes  # that line
    delimiter: str | None  # None: blanks and tabs
    spelling: "Spelling"
    names: tuple[str, ...]  # of all columns, in lower case; empty without a header line
    header: str  # the header line, or empty


def text_blocks(path: Path, size: int, start: int = 0) -> Iterator[bytes]:
    """Yield the bytes of a text file from `start` on, `size` at a time; UTF-16 is converted to UTF-8."""
    with path.open("rb") as file:
        num_bytes = os.fstat(file.fileno()).st_size
        is_wide = file.peek(2)[:2] in UTF_16
        decoder = codecs.getincrementaldecoder("utf-16")("replace")
        if not is_wide:
            file.seek(start)
            start = 0
        while block := file.read(size):
            text = decoder.decode(block).encode() if is_wide else block
            yield text[start:]
            start = max(start - len(text), 0)
        if file.tell() < num_bytes:
            raise InputError(f"{path}: {CUT}")


def split(line: bytes, delimiter: str | None) -> list[str]:
    """Split a line into its fields; an empty last field is dropped."""
    fields = [field.strip() for field in line.decode("latin-1").strip().split(delimiter)]
    return fields[:-1] if fields and fields[-1] == "" else fields


def read_fields(path: Path, wanted: str) -> Fields:
    """Read the beginning of a text file, up to its first line of numbers, and return what it tells."""
    head = next(text_blocks(path, TEXT_HEAD_SIZE), b"")
    if b"\0" in head:
        raise InputError(f"{path}: holds bytes that are no text, {wanted}")
    start = len(BYTE_ORDER_MARK) if head.startswith(BYTE_ORDER_MARK) else 0
    names: tuple[str, ...] = ()
    header = ""
    for num_lines, line in enumerate(head[start:].splitlines(keepends=True)):
        marks = bytes({*line} & {*MARKS})
        text = line.translate(None, marks).decode("latin-1").strip()
        delimiter = next((mark for mark in ";," if mark in text), None)
        has_commas = _has_decimal_commas(text, delimiter)
        delimiter = None if has_commas and delimiter == "," else delimiter
        spelling = Spelling(has_commas, HEX_COLOR.search(line) is not None, marks)
        fields = split(spelling.plain(line), delimiter)
        is_count = len(fields) == 1 and text.isdecimal()
        if not line.strip().startswith(COMMENT_MARKS) and not is_count and any(map(is_number, fields)):
            return Fields(start, num_lines, line, delimiter, spelling, names, header)
        words = split(line.strip().lstrip(b"#/ "), delimiter)
        candidates = tuple(UNIT.sub("", word).strip(' "').lower() for word in words)
        if any({*some} <= {*candidates} for some in POINT_NAMES):
            names = candidates
            header = line.decode("latin-1").strip()
        start += len(line)
    raise InputError(f"{path}: no line of numbers at its beginning, {wanted}")


def _has_decimal_commas(text: str, delimiter: str | None) -> bool:
    """Return True if a line's fields are separated by semicolons or blanks, and some have a decimal comma."""
    fields = text.split(";" if delimiter == ";" else None)
    is_decimal = [DECIMAL_COMMA.fullmatch(field.strip()) is not None for field in fields]
    others = [field for field, is_right in zip(fields, is_decimal, strict=True) if not is_right]
    return len(fields) >= len(POSITION) and any(is_decimal) and all("," not in field for field in others)


def read_samples(path: Path, fields: Fields, num_columns: int) -> Array:
    """Return the numbers (R, C) in a sample of lines from all over a file; NaN where a field is no number."""
    blocks = []
    with path.open("rb") as file:
        size = file.seek(0, 2)
        is_plain = file.seek(0) == 0 and file.peek(2)[:2] not in UTF_16
        begins = np.linspace(fields.start, size, NUM_SAMPLED_PLACES, endpoint=False)
        for begin in begins.astype(np.int64).tolist():
            file.seek(begin)
            lines = file.read(SAMPLE_SIZE).splitlines()
            blocks.append(lines[begin > fields.start : -1] or lines[:1])
    if not is_plain:
        blocks = [next(text_blocks(path, TEXT_HEAD_SIZE), b"")[fields.start :].splitlines()[:-1]]
    rows = []
    for line in (line for block in blocks for line in block):
        numbers = split(fields.spelling.plain(line), fields.delimiter)
        if len(numbers) == num_columns and not line.strip().startswith(COMMENT_MARKS):
            rows.append([float(field) if is_number(field) else np.nan for field in numbers[:MAX_COLUMNS]])
    numbers_of_rows = np.array(rows, np.float64).reshape(-1, min(num_columns, MAX_COLUMNS))
    return drop_broken(numbers_of_rows)


def drop_broken(rows: Array) -> Array:
    """Return rows (R, C) without those that lack a number in a column where nearly all have one."""
    is_broken = ~np.isfinite(rows)
    return rows[~is_broken[:, np.mean(is_broken, axis=0) < FEW_ROWS].any(axis=1)] if len(rows) else rows


def names_of_user(path: Path, settings: CloudSettings, num_columns: int) -> tuple[str, ...]:
    """Return the full names that the user gave to the columns; empty if there are none."""
    names = tuple(COLUMNS.get(name.lower(), name.lower()) for name in settings.columns)
    if len(names) > num_columns:
        found = f"{len(names)} names, but {num_columns} columns"
        raise InputError(f"{path}: `columns`: found {found}, wanted one name for each, {SKIP} for others")
    return names


def name_columns(rows: Array) -> tuple[str, ...]:
    """Return names of columns by their values (R, C): x y z, colours, intensity, normals, or - for others."""
    num_columns = rows.shape[1]
    names = [SKIP] * num_columns
    with np.errstate(invalid="ignore", over="ignore"):
        first = _count_indices(rows)
        names[first : first + 3] = POSITION
        free = [*range(first + 3, num_columns)]
        normals = next((k for k in free[:-2] if _are_normals(rows[:, k : k + 3], len(free))), None)
        if normals is not None:
            names[normals : normals + 3] = NORMAL
            free = [k for k in free if not normals <= k < normals + 3]
        offset = _find_colors(rows[:, free])
    if offset is not None:
        for name, column in zip(RGB, free[offset : offset + 3], strict=True):
            names[column] = name
        free = free[:offset] + free[offset + 3 :]
    if free and (offset is not None or len(free) == 1):
        is_packed = offset is None and bool(np.all(rows[:, free[0]] % 1.0 == 0.0))
        is_packed = is_packed and float(np.max(rows[:, free[0]], initial=0.0)) > MAX_VALUE
        names[free[0]] = "rgb" if is_packed else "intensity"
    return tuple(names)


def _count_indices(rows: Array) -> int:
    """Return how many of the first columns are indices: whole numbers, unlike the next three columns."""
    is_whole = np.all((rows % 1.0 == 0.0) & (rows >= 0.0), axis=0)
    for count in range(1, BEFORE + 1):
        is_right = is_whole[:count].all() and (rows[:, count : count + 3] % 1.0 != 0.0).any(axis=0).all()
        if len(rows) and rows.shape[1] >= count + NUM_COLORED and is_right:
            return count
    return 0


def _are_normals(rows: Array, num_free: int) -> bool:
    """Return True if vectors (R, 3) are normals: of length 1, and not colours, which may be saturated."""
    lengths = np.linalg.norm(rows, axis=1)
    is_right = (np.abs(lengths - 1.0) < NORMAL_LENGTH_ERROR) | (lengths == 0.0)
    can_be = num_free > len(NORMAL) or bool((rows < 0.0).any()) or bool((rows % 1.0 != 0.0).any())
    return can_be and bool(lengths.any()) and float(np.mean(is_right)) >= MOST_ROWS


def _find_colors(rows: Array) -> int | None:
    """Return the index of the first of three columns of colours (R, C), or None if there are none.

    If there are four columns the first is usually an intensity. Three colours differ less from each other
    than an intensity or a class differs from two of them, and none of them is constant.
    """
    firsts = [k for k in range(rows.shape[1] - 2) if _are_colors(rows[:, k : k + 3])]
    is_constant = np.ptp(rows, axis=0) == 0.0 if len(rows) else np.zeros(rows.shape[1], np.bool_)
    firsts = [k for k in firsts if not is_constant[k : k + 3].any()] or firsts
    if not firsts:
        return None
    spreads = {k: float(np.mean(np.ptp(rows[:, k : k + 3], axis=1))) if len(rows) else 0.0 for k in firsts}
    if rows.shape[1] == len(BARE) and 1 in firsts:
        return 0 if spreads.get(0, np.inf) * FAR_FACTOR < spreads[1] else 1
    return min(firsts, key=lambda k: spreads[k])


def _are_colors(rows: Array) -> bool:
    """Return True if three columns (R, 3) can be colours of the same range."""
    if not bool(np.all((rows >= 0.0) & (rows <= MAX_VALUE))):
        return False
    is_whole = np.all(rows % 1.0 == 0.0, axis=0)
    largest = float(np.max(rows, initial=0.0))
    return largest <= 1.0 or bool(is_whole.all()) or (not is_whole.any() and largest <= MAX_BYTE)


def note_names(path: Path, names: tuple[str, ...], line: str, is_pts: bool = False) -> str:
    """Return a warning that names the columns assumed in a file without a header, or "" if they are usual."""
    if names in (*USUAL, *USUAL_OF_PTS[:is_pts]) or not any({*some} <= {*names} for some in COLOR_NAMES):
        return ""
    guess = f"no header, columns read as {','.join(names)} by their values"
    return f"{path}: {guess}{line and f' ({line})'}; `columns` overrules it"
