"""The columns of lines of numbers: by the user, by a header, or else by the values of all columns."""

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
MARKS = b"\"'[](){}"
TEXT_HEAD_SIZE = 1 << 16  # [byte] in which the header is looked for
NUM_SAMPLED_PLACES = 16  # places in the file whose lines are looked at
SAMPLE_SIZE = 1 << 13  # [byte]
MAX_COLUMNS = 64
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
UNIT = re.compile(r"[\[(].*")  # behind a name
HEX_COLOR = re.compile(
    rb"(?<=[\s;,])[\"']?(?:#|0[xX]ff|0[xX])([0-9a-fA-F]{6})(?![0-9a-fA-F])[\"']?"
)  # behind a number
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
SKIP = "-"
POSITION = ("x", "y", "z")
RGB = ("red", "green", "blue")
NORMAL = ("nx", "ny", "nz")
NORMAL_LENGTH_ERROR = 0.01  # by which the length of a normal may differ from 1
FEW_ROWS = 0.1  # of the rows have no number in a column of numbers
MOST_ROWS = 0.95  # of them are normals
FAR_FACTOR = 4.0  # times as far from each other are an intensity and two colours as three colours
MAX_BYTE = 255.0
MAX_VALUE = 65535.0
BEFORE = 2  # columns that may be in front: an index, or FARO's row and column
BARE = (*POSITION, "intensity")
USUAL = (POSITION, BARE, (*POSITION, *RGB))
USUAL_OF_PTS = ((*BARE, *RGB),)


class Spelling(NamedTuple):
    """The way in which a file's lines write numbers."""

    has_decimal_commas: bool = False
    has_hex_colors: bool = False  # #rrggbb or 0xrrggbb
    marks: bytes = b""  # around numbers or lines

    def plain(self, line: bytes) -> bytes:
        """Return a line with decimal points, and colours as whole numbers."""
        line = line.translate(None, self.marks) if self.marks else line
        line = line.replace(b",", b".") if self.has_decimal_commas else line
        return HEX_COLOR.sub(lambda found: b"%d" % int(found[1], 16), line) if self.has_hex_colors else line


class Fields(NamedTuple):
    """The fields of the lines of numbers, and what is known of them."""

    start: int  # [byte] of the first line of numbers
    num_lines: int  # before it
    first: bytes  # that line
    delimiter: str | None  # None: blanks and tabs
    spelling: "Spelling"
    names: tuple[str, ...]  # of all, in lower case; empty without a header
    header: str


def text_blocks(path: Path, size: int, start: int = 0) -> Iterator[bytes]:
    """Yield the bytes of a text from `start` on, `size` read at once; those of UTF-16 as UTF-8."""
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
    """Split a line into its fields; an empty one at its end counts for none."""
    fields = [field.strip() for field in line.decode("latin-1").strip().split(delimiter)]
    return fields[:-1] if fields and fields[-1] == "" else fields


def read_fields(path: Path, wanted: str) -> Fields:
    """Return the fields of a file of lines, from its first lines."""
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
        found = tuple(UNIT.sub("", word).strip(' "').lower() for word in words)
        if any({*some} <= {*found} for some in POINT_NAMES):
            names = found
            header = line.decode("latin-1").strip()
        start += len(line)
    raise InputError(f"{path}: no line of numbers at its beginning, {wanted}")


def _has_decimal_commas(text: str, delimiter: str | None) -> bool:
    """Return True if a line's fields are divided by semicolons or blanks, and some have a decimal comma."""
    fields = text.split(";" if delimiter == ";" else None)
    is_decimal = [DECIMAL_COMMA.fullmatch(field.strip()) is not None for field in fields]
    others = [field for field, is_right in zip(fields, is_decimal, strict=True) if not is_right]
    return len(fields) >= len(POSITION) and any(is_decimal) and all("," not in field for field in others)


def read_samples(path: Path, fields: Fields, num_columns: int) -> Array:
    """Return the numbers (R, C) of lines at places all over a file; NaN for what is no number."""
    blocks = []
    with path.open("rb") as file:
        size = file.seek(0, 2)
        is_plain = file.seek(0) == 0 and file.peek(2)[:2] not in UTF_16
        for begin in (
            np.linspace(fields.start, size, NUM_SAMPLED_PLACES, endpoint=False).astype(np.int64).tolist()
        ):
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
    found = np.array(rows, np.float64).reshape(-1, min(num_columns, MAX_COLUMNS))
    return drop_broken(found)


def drop_broken(rows: Array) -> Array:
    """Return rows (R, C) without those in which a number is missing that few others miss."""
    is_broken = ~np.isfinite(rows)
    return rows[~is_broken[:, np.mean(is_broken, axis=0) < FEW_ROWS].any(axis=1)] if len(rows) else rows


def names_of_user(path: Path, settings: CloudSettings, num_columns: int) -> tuple[str, ...]:
    """Return the names that the user gave to columns, in full; empty if there are none."""
    names = tuple(COLUMNS.get(name.lower(), name.lower()) for name in settings.columns)
    if len(names) > num_columns:
        found = f"{len(names)} names, but {num_columns} columns"
        raise InputError(f"{path}: `columns`: found {found}, wanted one name for each, {SKIP} for others")
    return names


def name_columns(rows: Array) -> tuple[str, ...]:
    """Return the names of columns by their values (R, C): x y z, colours, intensity, normals; - of others."""
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
    """Return how many of the first columns are indices: whole numbers, and the three behind them are not."""
    is_whole = np.all((rows % 1.0 == 0.0) & (rows >= 0.0), axis=0)
    for count in range(1, BEFORE + 1):
        is_right = is_whole[:count].all() and (rows[:, count : count + 3] % 1.0 != 0.0).any(axis=0).all()
        if len(rows) and rows.shape[1] >= count + NUM_COLORED and is_right:
            return count
    return 0


def _are_normals(rows: Array, num_free: int) -> bool:
    """Return True if vectors (R, 3) are normals: of length 1, and no saturated colours."""
    lengths = np.linalg.norm(rows, axis=1)
    is_right = (np.abs(lengths - 1.0) < NORMAL_LENGTH_ERROR) | (lengths == 0.0)
    can_be = num_free > len(NORMAL) or bool((rows < 0.0).any()) or bool((rows % 1.0 != 0.0).any())
    return can_be and bool(lengths.any()) and float(np.mean(is_right)) >= MOST_ROWS


def _find_colors(rows: Array) -> int | None:
    """Return the first of three columns of colours among the free ones (R, C); None if there are none.

    Of four columns the first is usually an intensity. Three colours are nearer to each other than an
    intensity or a class is to two of them, and none is the same in all points.
    """
    found = [k for k in range(rows.shape[1] - 2) if _are_colors(rows[:, k : k + 3])]
    is_constant = np.ptp(rows, axis=0) == 0.0 if len(rows) else np.zeros(rows.shape[1], np.bool_)
    found = [k for k in found if not is_constant[k : k + 3].any()] or found
    if not found:
        return None
    spreads = {k: float(np.mean(np.ptp(rows[:, k : k + 3], axis=1))) if len(rows) else 0.0 for k in found}
    if rows.shape[1] == len(BARE) and 1 in found:
        return 0 if spreads.get(0, np.inf) * FAR_FACTOR < spreads[1] else 1
    return min(found, key=lambda k: spreads[k])


def _are_colors(rows: Array) -> bool:
    """Return True if columns (R, 3) can be colours of one range."""
    if not bool(np.all((rows >= 0.0) & (rows <= MAX_VALUE))):
        return False
    is_whole = np.all(rows % 1.0 == 0.0, axis=0)
    largest = float(np.max(rows, initial=0.0))
    return largest <= 1.0 or bool(is_whole.all()) or (not is_whole.any() and largest <= MAX_BYTE)


def note_names(path: Path, names: tuple[str, ...], line: str, is_pts: bool = False) -> str:
    """Return a warning of the columns that a file without a header is taken to have, unless it is usual."""
    if names in (*USUAL, *USUAL_OF_PTS[:is_pts]) or not any({*some} <= {*names} for some in COLOR_NAMES):
        return ""
    guess = f"no header, columns read as {','.join(names)} by their values"
    return f"{path}: {guess}{line and f' ({line})'}; `columns` overrules it"
