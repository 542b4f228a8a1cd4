"""PLY files: the vertices' positions and colours.

plyfile reads the header: the names, types and byte order. The numbers are read here, as plyfile would
allocate any size that the header promises, and read ASCII and lists line by line in Python.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import takewhile
from pathlib import Path
from typing import Literal

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ...system.errors import InputError
from ..cloud_settings import BY_FILE, Channel, CloudSettings
from . import reader
from .mesh import open_ply_mesh
from .reader import MissingChannelError, PointSource, quote_line
from .text import LineLayout, NumberLines

MAGIC = (b"ply\n", b"ply\r")
MAX_PLY_HEADER_SIZE = 1 << 20  # [byte]
LINE_ENDS = (b"\r\n", b"\n", b"\r")
ELEMENT_LINE = re.compile(rb"^(\s*element[ \t]+\S+[ \t]+)(\S+)[ \t]*$", re.MULTILINE)
WANTED = "wanted a PLY file whose vertices have x y z and red green blue"
MAX_PLY_COUNT_DIGITS = 15
MAX_VERTEX_SIZE = 1 << 24  # [byte] of a vertex with its lists
OPACITY = "opacity"
MOST_STRAY = 20  # a file with more vertices per face is a cloud with a few stray faces, not a mesh


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    path: Path
    elements: tuple[PlyElement, ...]
    counts: tuple[int, ...]  # number of rows of each element
    byte_order: str  # '<' or '>', '=' in ASCII
    is_ascii: bool
    size: int  # [byte] of the header: the data begin there
    index: int  # of the vertices among the elements

    @property
    def pairs(self) -> list[tuple[PlyElement, int]]:
        """The elements with their numbers of rows."""
        return list(zip(self.elements, self.counts, strict=True))

    @property
    def vertices(self) -> PlyElement:
        """The element of the vertices."""
        return self.elements[self.index]


def open_ply(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the vertices of a PLY file, binary or ASCII; if it is a mesh, points on its faces.

    Other properties and elements are left out. The file's size is compared with the header's counts before
    memory is allocated.
    """
    header = read_ply_header(path)
    num_faces = sum(count for element, count in header.pairs if element.name == "face")
    if num_faces * MOST_STRAY > header.counts[header.index]:  # a mesh
        return open_ply_mesh(path, options, channel)
    names = _property_names(header, options, channel)
    if not header.is_ascii and not _lists_before(header):
        place_of_vertices(header)
    types = [header.vertices.ply_property(name).val_dtype for name in names]
    read = partial(read_columns, header, names)
    source = reader.Table(path, read, names, types, header.counts[header.index]).source(channel, options)
    notes = [f"{path}: {num_faces} faces left out"] if num_faces else []
    return source._replace(warnings=(*notes, *source.warnings))


def read_columns(header: PlyHeader, names: Sequence[str]) -> Iterator[reader.Columns]:
    """Yield the named columns of up to POINTS_A_CHUNK vertices at once; those of ASCII are float64."""
    if not header.is_ascii:
        if _lists_before(header):
            yield from _read_among_lists(header, names)
            return
        for rows in reader.read_records(header.path, *place_of_vertices(header)):
            yield [rows[name] for name in names]
        return
    properties = [prop.name for prop in header.vertices.properties]
    columns = tuple(properties.index(name) for name in names)
    num_columns = None if any(map(_is_list, header.vertices.properties)) else len(properties)
    lines = NumberLines(header.path, LineLayout(columns, num_columns, header.size), WANTED)
    lines.skip(sum(header.counts[: header.index]))
    for rows in lines.read_rows(header.counts[header.index]):
        yield list(rows.T)


def read_ply_header(path: Path) -> PlyHeader:
    """Return the header of a PLY file. Raise InputError if it is broken."""
    with path.open("rb") as file:
        head = file.read(MAX_PLY_HEADER_SIZE)
    if not head.startswith(MAGIC):
        raise InputError(f"{path}: begins with {head[:4]!r}, wanted 'ply' and a line end")
    line_end = next(end for end in LINE_ENDS if head.startswith(b"ply" + end))
    size = head.find(line_end + b"end_header" + line_end)
    if size < 0:
        raise InputError(f"{path}: the header has no line 'end_header', {WANTED}")
    size += len(b"end_header") + 2 * len(line_end)
    text = head[:size].replace(line_end, b"\n")
    text = bytes(byte if byte < 128 else ord("?") for byte in text)  # comments in any language
    counts = [match.group(2) for match in ELEMENT_LINE.finditer(text)]
    if not all(count.isdigit() and len(count) <= MAX_PLY_COUNT_DIGITS for count in counts):
        raise InputError(f"{path}: the header counts {quote_line(b' '.join(counts))} elements, {WANTED}")
    try:
        # with counts of 0, plyfile stops at the end of the header
        ply = PlyData.read(BytesIO(ELEMENT_LINE.sub(rb"\g<1>0", text)), mmap=False)
    except (PlyParseError, ValueError) as error:
        raise InputError(f"{path}: broken header ({quote_line(str(error).encode())}), {WANTED}") from error
    if len(ply.elements) != len(counts):
        raise InputError(f"{path}: broken header (an element's line), {WANTED}")
    names = [element.name for element in ply.elements]
    if "vertex" not in names:
        raise InputError(f"{path}: the header has no element 'vertex', {WANTED}")
    index = names.index("vertex")
    return PlyHeader(path, ply.elements, tuple(map(int, counts)), ply.byte_order, ply.text, size, index)


def _property_names(header: PlyHeader, options: CloudSettings, channel: Channel) -> tuple[str, ...]:
    """Return the names of the vertices' properties that hold x, y, z and the channel."""
    properties = header.vertices.properties
    if header.is_ascii:  # in a line with lists only the numbers before these have a fixed column
        properties = tuple(takewhile(lambda prop: not _is_list(prop), properties))
    found = [prop.name for prop in properties if not _is_list(prop)]
    names = reader.find_fields(found, channel)
    if not names:
        listed = " ".join(found[:9]) or "no properties before a list"
        error = MissingChannelError if reader.find_fields(found, "shape") else InputError
        raise error(f"{header.path}: the vertices have {listed}, {WANTED}")
    is_splat = names[3:6] == reader.SPLAT_NAMES and OPACITY in found
    return (*names, OPACITY) if is_splat else names


def place_of_vertices(header: PlyHeader) -> tuple[int, int, np.dtype[np.void]]:
    """Return the first byte of a binary file's vertices, their number and their dtype."""
    count = header.counts[header.index]
    before = zip(header.elements[: header.index], header.counts, strict=False)
    offset = header.size + sum(count * element.dtype().itemsize for element, count in before)
    dtype = header.vertices.dtype(header.byte_order)
    room = max(header.path.stat().st_size - offset, 0)
    if dtype.itemsize * count > room:
        promised = f"promises {count} vertices of {dtype.itemsize} bytes, found {room} bytes"
        raise InputError(f"{header.path}: the header {promised}; the file is cut off or broken")
    return offset, count, dtype


def _is_list(prop: object) -> bool:
    return isinstance(prop, PlyListProperty)


def _lists_before(header: PlyHeader) -> bool:
    """Return True if the vertices, or elements before them, have lists: their rows differ in length."""
    return any(_is_list(prop) for some in header.elements[: header.index + 1] for prop in some.properties)


def _read_among_lists(header: PlyHeader, names: Sequence[str]) -> Iterator[reader.Columns]:
    """Yield the named columns of the vertices of a binary file with lists in them or before them."""
    with header.path.open("rb") as file:
        file.seek(header.size)
        rest = b""
        for element, num_rows in header.pairs[: header.index + 1]:
            count = num_rows
            types = {p.name: np.dtype(header.byte_order + p.val_dtype) for p in element.properties}
            while count > 0:
                block = file.read(MAX_VERTEX_SIZE)
                rest += block
                starts, end = _walk(rest, min(count, reader.POINTS_A_CHUNK), element, header.byte_order)
                if not starts and (not block or len(rest) > MAX_VERTEX_SIZE):
                    raise InputError(f"{header.path}: {count} rows of '{element.name}' are missing or broken")
                if element is header.vertices and starts:
                    data = np.frombuffer(rest, np.uint8)
                    places = dict(zip(types, np.array(starts).T[:, :, None], strict=True))
                    bits = {name: data[places[name] + np.arange(types[name].itemsize)] for name in names}
                    yield [bits[name].view(types[name])[:, 0] for name in names]
                rest = rest[end:]
                count -= len(starts)


def _walk(data: bytes, count: int, element: PlyElement, byte_order: str) -> tuple[list[list[int]], int]:
    """Return where [byte] the properties of up to `count` whole rows begin, and where the last row ends."""
    order: Literal["little", "big"] = "big" if byte_order == ">" else "little"
    sizes = [
        (np.dtype(prop.val_dtype).itemsize, np.dtype(prop.len_dtype).itemsize if _is_list(prop) else 0)
        for prop in element.properties
    ]
    starts: list[list[int]] = []
    end = 0
    while len(starts) < count:
        at = end
        row = []
        for size, count_size in sizes:
            row.append(at)
            num_items = int.from_bytes(data[at : at + count_size], order) if count_size else 1
            at += count_size + size * num_items
        if at > len(data) or at == end:
            break
        starts.append(row)
        end = at
    return starts, end
