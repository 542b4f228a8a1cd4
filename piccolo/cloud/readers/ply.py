"""PLY files: the vertices' positions and colours.

plyfile reads the header: the names, types and byte order. It would reserve any size that the header
promises, and read ASCII and lists line by line in Python, so the numbers are read here.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ...errors import InputError
from ..settings import IN_METRES, Channel, CloudSettings
from . import reader
from .mesh import open_ply_mesh
from .reader import MissingChannelError, PointSource, quote_line
from .text import LineLayout, NumberLines

MAGIC = (b"ply\n", b"ply\r")
MAX_HEADER_SIZE = 1 << 20  # [byte]
LINE_ENDS = (b"\r\n", b"\n", b"\r")
ELEMENT_LINE = re.compile(rb"^(\s*element[ \t]+\S+[ \t]+)(\S+)[ \t]*$", re.MULTILINE)
WANTED = "wanted a PLY file whose vertices have x y z and red green blue"
LABELS_WANTED = "wanted x y z and a label (label, class or classification, or these after scalar_)"
MAX_COUNT_DIGITS = 15


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    path: Path
    elements: tuple[PlyElement, ...]
    counts: tuple[int, ...]  # of each element
    byte_order: str  # '<' or '>', '=' in ASCII
    is_ascii: bool
    size: int  # [byte], the data begin here
    index: int  # of the element of the vertices

    @property
    def vertices(self) -> PlyElement:
        """The element of the vertices."""
        return self.elements[self.index]


def open_ply(path: Path, options: CloudSettings = IN_METRES, channel: Channel = "colors") -> PointSource:
    """Return the vertices of a PLY file, binary or ASCII; points on its faces if it has any.

    Colours are uchar 0-255, ushort 0-65535, or float and double 0-1. Other properties and elements are left
    out. The file's size is compared with the header's counts before memory is reserved.
    """
    header = read_header(path)
    if _has_faces(header):
        if options.labels:
            raise InputError(f"{path}: found a mesh, wanted points with labels")
        return open_ply_mesh(path, options, channel)
    names = _property_names(header, options, channel)
    if not header.is_ascii:
        place_of_vertices(header)
    types = [header.vertices.ply_property(name).val_dtype for name in names[3:]]
    read = partial(reader.join_columns, partial(read_columns, header, names))
    return reader.make_source(path, read, channel, options.labels, header.counts[header.index], types)


def _has_faces(header: PlyHeader) -> bool:
    """Return True for a mesh; InputError if trimesh would get the range of its colours wrong."""
    found = dict(zip((element.name for element in header.elements), header.counts, strict=True))
    if not found.get("face"):
        return False
    for element in header.elements:
        for prop in element.properties:
            if prop.name in reader.COLOR_NAMES[0] and prop.val_dtype not in ("u1", "f4", "f8"):
                wrong = f"'{prop.name}' is of type {prop.val_dtype}"
                raise InputError(f"{header.path}: {wrong}, wanted uchar 0-255 or float 0-1 in a mesh")
    return True


def read_columns(header: PlyHeader, names: Sequence[str]) -> Iterator[reader.Columns]:
    """Yield the named columns of up to raw.CHUNK vertices; those of an ASCII file are float64."""
    if not header.is_ascii:
        for rows in reader.read_records(header.path, *place_of_vertices(header)):
            yield [rows[name] for name in names]
        return
    properties = [prop.name for prop in header.vertices.properties]
    columns = tuple(properties.index(name) for name in names)
    lines = NumberLines(header.path, LineLayout(columns, len(properties), header.size), WANTED)
    lines.skip(sum(header.counts[: header.index]))
    for rows in lines.read_rows(header.counts[header.index]):
        yield list(rows.T)


def read_header(path: Path) -> PlyHeader:
    """Return the header of a PLY file; InputError if it is broken."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_SIZE)
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
    if not all(count.isdigit() and len(count) <= MAX_COUNT_DIGITS for count in counts):
        raise InputError(f"{path}: the header counts {quote_line(b' '.join(counts))} elements, {WANTED}")
    try:
        # counts of 0 let plyfile stop at the header's end
        ply = PlyData.read(BytesIO(ELEMENT_LINE.sub(rb"\g<1>0", text)), mmap=False)
    except (PlyParseError, ValueError) as error:
        raise InputError(f"{path}: broken header ({quote_line(str(error).encode())}), {WANTED}") from error
    if len(ply.elements) != len(counts):
        raise InputError(f"{path}: broken header (an element's line), {WANTED}")
    index = _vertex_index(path, ply.elements)
    return PlyHeader(path, ply.elements, tuple(map(int, counts)), ply.byte_order, ply.text, size, index)


def _vertex_index(path: Path, elements: Sequence[PlyElement]) -> int:
    """Return the index of the vertices' element; InputError if it or one before it has lists."""
    for index, element in enumerate(elements):
        lists = [prop.name for prop in element.properties if isinstance(prop, PlyListProperty)]
        if lists:
            found = f"the element '{element.name}' has the list property '{lists[0]}'"
            raise InputError(f"{path}: {found}, wanted vertices without lists, before those that have them")
        if element.name == "vertex":
            return index
    raise InputError(f"{path}: the header has no element 'vertex', {WANTED}")


def _property_names(header: PlyHeader, options: CloudSettings, channel: Channel) -> tuple[str, ...]:
    """Return the vertices' properties for x, y, z and red, green, blue, or intensity, or label, or none."""
    found = [prop.name for prop in header.vertices.properties]
    names = reader.find_fields(found, channel, options.labels)
    if not names:
        kind = "Gaussian splats without red green blue, " if "f_dc_0" in found else ""
        listed = " ".join(found[:9]) or "no properties"
        wanted = LABELS_WANTED if options.labels else WANTED
        error = MissingChannelError if {*"xyz"} <= {*found} else InputError
        raise error(f"{header.path}: {kind}the vertices have {listed}, {wanted}")
    return names


def place_of_vertices(header: PlyHeader) -> tuple[int, int, np.dtype[np.void]]:
    """Return the start [byte] of a binary file's vertices, their number and their dtype."""
    count = header.counts[header.index]
    before = zip(header.elements[: header.index], header.counts, strict=False)
    offset = header.size + sum(count * element.dtype().itemsize for element, count in before)
    dtype = header.vertices.dtype(header.byte_order)
    room = max(header.path.stat().st_size - offset, 0)
    if dtype.itemsize * count > room:
        promised = f"promises {count} vertices of {dtype.itemsize} bytes, found {room} bytes"
        raise InputError(f"{header.path}: the header {promised}; the file is cut off or broken")
    return offset, count, dtype
