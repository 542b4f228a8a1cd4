"""PCD files of the Point Cloud Library, 0.5 to 0.7: ascii, binary and binary_compressed.

VIEWPOINT, the sensor's pose, is not applied: the points are already in the cloud's frame.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...system.errors import InputError, import_optional
from ..cloud_settings import BY_FILE, Channel, CloudSettings
from . import reader
from .reader import MissingChannelError, PointSource, quote_line
from .text import LineLayout, NumberLines

MAX_PCD_HEADER_SIZE = 1 << 16  # [byte]
MAX_PCD_ROW = 1 << 16  # [byte] a row is one point
MAX_PCD_COUNT_DIGITS = 10
ENCODINGS = ("ascii", "binary", "binary_compressed")
WANTED = "wanted a PCD file with the fields x y z and rgb, rgba or r g b"
MAX_LZF_RATIO = 88  # of LZF: three bytes can stand for 264
FIRST_LINES = re.compile(rb"(?:#[^\n]*\n|[ \t\r\n])*(?:# \.PCD|VERSION[ \t]+0?\.\d)")
PADDING = "_"
BROKEN = "the file is cut off or broken"


@dataclass(frozen=True)
class PcdField:
    """A field of a point."""

    name: str
    type: str  # NumPy's, without byte order: all numbers are little-endian
    count: int  # of numbers in the field
    offset: int  # [byte] of the field in a point
    column: int  # index of its first number among the numbers of a point

    @property
    def size(self) -> int:
        """Size of all its numbers [byte]."""
        return int(self.type[1:]) * self.count


class PcdHeader(NamedTuple):
    """The header of a PCD file."""

    path: Path
    fields: tuple[PcdField, ...]
    num_points: int
    encoding: str  # one of ENCODINGS
    size: int  # [byte] of the header: the data begin there

    @property
    def row_size(self) -> int:
        """Size of a point in binary files [byte]."""
        return sum(field.size for field in self.fields)


def read_pcd_header(path: Path) -> PcdHeader:
    """Return the header of a PCD file; SIZE, TYPE and COUNT are 4, F and 1 if missing, as in old files."""
    with path.open("rb") as file:
        head = file.read(MAX_PCD_HEADER_SIZE)
    entries: dict[str, list[str]] = {}
    size = 0
    for line in head.split(b"\n"):
        size += len(line) + 1
        words = line.decode("latin-1").split()
        if words and not words[0].startswith("#"):
            entries["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
        if "DATA" in entries:
            break
    if not {"FIELDS", "DATA"} <= entries.keys():
        raise InputError(f"{path}: the header has no lines FIELDS and DATA, {WANTED}")
    encoding = " ".join(entries["DATA"])
    if encoding not in ENCODINGS:
        raise InputError(f"{path}: DATA is {quote_line(encoding.encode())}, wanted {', '.join(ENCODINGS)}")
    fields = _fields(path, entries)
    return PcdHeader(path, fields, _num_points(path, entries), encoding, min(size, len(head)))


def _fields(path: Path, entries: dict[str, list[str]]) -> tuple[PcdField, ...]:
    names = entries["FIELDS"]
    usual = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
    sizes, types, counts = (entries.get(key, [value] * len(names)) for key, value in usual.items())
    if not len(names) == len(sizes) == len(types) == len(counts):
        found = f"{len(names)} FIELDS, {len(sizes)} of SIZE, {len(types)} of TYPE and {len(counts)} of COUNT"
        raise InputError(f"{path}: the header has {found}, wanted as many of each")
    fields: list[PcdField] = []
    offset = column = 0
    for name, size, type_, text in zip(names, sizes, types, counts, strict=True):
        count = _count(text)
        if size not in ("1", "2", "4", "8") or type_ not in ("I", "U", "F") or not count:
            found = quote_line(f"{name} {size} {type_} {text}".encode())
            wanted = "wanted SIZE 1 2 4 or 8, TYPE I U or F, COUNT 1 or more"
            raise InputError(f"{path}: a field has the name, SIZE, TYPE and COUNT {found}, {wanted}")
        fields.append(PcdField(name, type_.lower() + size, count, offset, column))
        offset += fields[-1].size
        column += count
    if offset > MAX_PCD_ROW:
        raise InputError(f"{path}: the header promises {offset} bytes a point, wanted {MAX_PCD_ROW} at most")
    return tuple(fields)


def _num_points(path: Path, entries: dict[str, list[str]]) -> int:
    """Return POINTS, or WIDTH x HEIGHT. Raise InputError if both are given and differ."""
    found = {key: entries[key] for key in ("WIDTH", "HEIGHT", "POINTS") if key in entries}
    counts = {key: _count(" ".join(words)) for key, words in found.items()}
    if None in counts.values() or not counts.keys() & {"POINTS", "WIDTH"}:
        words = " ".join(f"{key} {' '.join(words)}" for key, words in found.items())
        raise InputError(f"{path}: the header counts the points by {quote_line(words.encode())}, {WANTED}")
    num_cells = (counts.get("WIDTH") or 0) * (counts.get("HEIGHT", 1) or 0)
    num_points = counts.get("POINTS", num_cells) or 0
    if "WIDTH" in counts and num_cells != num_points:
        raise InputError(f"{path}: the header promises {num_points} points in a grid of {num_cells}")
    return num_points


def _count(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) <= MAX_PCD_COUNT_DIGITS else None


def open_pcd(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of a PCD file.

    Colours are fields r g b (red green blue), or one field `rgb` or `rgba`: three bytes in an integer or, if
    the field is declared a float, in the float's bits, also in ASCII files. Alpha and other fields are left
    out, unless the channel is the intensity. The size of a binary file is compared with the header before
    memory is allocated.
    """
    header = read_pcd_header(path)
    fields = _select_fields(header, options, channel)
    found = path.stat().st_size - header.size
    promised = {"ascii": 0, "binary": header.row_size * header.num_points}.get(header.encoding, 8)
    if promised > found:  # for ASCII and compressed data more is known only when they are read
        counts = f"{header.num_points} points in {promised} bytes or more, found {found} bytes"
        raise InputError(f"{path}: the header promises {counts}; {BROKEN}")
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
    read_columns = partial(read[header.encoding], header, fields)
    names = [field.name for field in fields]
    types = [field.type for field in fields]
    return reader.Table(path, read_columns, names, types, header.num_points).source(channel, options)


def _select_fields(header: PcdHeader, options: CloudSettings, channel: Channel) -> tuple[PcdField, ...]:
    """Return the fields x y z and those of the channel: one or three of colours, the intensity, or none."""
    names = [field.name for field in header.fields]
    found = {field.name: field for field in header.fields if field.count == names.count(field.name) == 1}
    chosen = reader.find_fields(found, channel)
    if not chosen:
        listed = " ".join(names[:12]) or "none"
        error = MissingChannelError if {*"xyz"} <= found.keys() else InputError
        raise error(f"{header.path}: the fields are {quote_line(listed.encode())}, {WANTED}")
    for name in chosen:
        if found[name].type == "f1" or (name in chosen[:3] and found[name].type[0] != "f"):
            wanted = "wanted float32 or float64" if name in chosen[:3] else "wanted numbers"
            raise InputError(f"{header.path}: '{name}' is of type {found[name].type}, {wanted}")
    return tuple(found[name] for name in chosen)


def _read_ascii(header: PcdHeader, fields: tuple[PcdField, ...]) -> Iterator[reader.Columns]:
    last = header.fields[-1]
    columns = tuple(field.column for field in fields)
    layout = LineLayout(columns, last.column + last.count, header.size)
    rows = NumberLines(header.path, layout, WANTED).read_rows(header.num_points)
    return (list(some.T) for some in rows)


def _read_binary(header: PcdHeader, fields: tuple[PcdField, ...]) -> Iterator[reader.Columns]:
    places = [("<" + field.type, field.offset) for field in fields]
    row = np.dtype((np.void, header.row_size))
    for records in reader.read_records(header.path, header.size, header.num_points, row):
        yield [records.getfield(*place) for place in places]


def _read_compressed(header: PcdHeader, fields: tuple[PcdField, ...]) -> Iterator[reader.Columns]:
    kept = [field for field in header.fields if field.name != PADDING]  # PCL does not write padding here
    promised = header.num_points * sum(field.size for field in kept)
    found = header.path.stat().st_size - header.size - 8
    lzf = import_optional(header.path, "lzf")
    with header.path.open("rb") as file:
        file.seek(header.size)
        packed_size, size = reader.take_records(file, header.path, 2, np.dtype("<u4")).tolist()
        if packed_size > found or size > MAX_LZF_RATIO * packed_size or size != promised:
            counts = f"found {found}, wanted {promised} for {header.num_points} points"
            raise InputError(f"{header.path}: {size} bytes packed into {packed_size}, {counts}; {BROKEN}")
        packed = reader.take_records(file, header.path, packed_size, np.dtype(np.uint8))
    try:
        table = lzf.decompress(packed, size)
    except ValueError:
        table = None
    if table is None or len(table) != size:  # None if there are more bytes than promised
        raise InputError(f"{header.path}: the compressed data are broken, {WANTED}")
    # the values of all points for one field follow each other, then those for the next
    ends = np.cumsum([field.size * header.num_points for field in kept])
    parts = dict(zip(kept, np.split(np.frombuffer(table, np.uint8), ends[:-1]), strict=True))
    yield from reader.in_chunks([parts[field].view("<" + field.type) for field in fields])
