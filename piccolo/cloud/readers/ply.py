"""PLY files: the vertices' positions and colours.

plyfile reads the header: the names, types and byte order. It would reserve whatever size the header
promises, and read ASCII and lists line by line in Python, so the numbers are read here.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ...errors import InputError
from .colors import COLOR_NAMES, brightest_of, color_names
from .columns import Columns, read_colored, read_scalar
from .fixed_records import read_records
from .intensity import INTENSITY_NAMES, check_option, intensity_reader
from .labels import LABEL_NAMES, label_reader
from .mesh import open_ply_mesh
from .number_lines import LineLayout, NumberLines
from .reader import PLAIN, CloudFormat, CloudReadOptions, PointSource, quoted

MAX_HEADER_SIZE = 1 << 20  # [byte]
LINE_ENDS = (b"\r\n", b"\n", b"\r")
ELEMENT_LINE = re.compile(rb"^(\s*element[ \t]+\S+[ \t]+)(\S+)[ \t]*$", re.MULTILINE)
WANTED = "wanted a PLY file whose vertices have x y z and red green blue"
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


@dataclass(frozen=True)
class Vertices:
    """The vertices of a PLY file, and the properties that are wanted of them."""

    header: PlyHeader
    index: int  # of the element
    names: tuple[str, ...]  # x y z and three colours, or x y z and intensity or label

    @property
    def element(self) -> PlyElement:
        """The element in the header."""
        return self.header.elements[self.index]

    @property
    def types(self) -> list[str]:
        """The properties' types."""
        return [self.element.ply_property(name).val_dtype for name in self.names]


def open_ply(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The vertices of a PLY file, binary or ASCII; points on its faces if it has any.

    Colours are uchar 0-255, ushort 0-65535, or float and double 0-1. Other properties and elements are left
    out. The file's size is compared with the header's counts before memory is reserved.
    """
    header = read_header(path)
    index = vertex_index(header)
    if _has_faces(header):
        if options.labels:
            raise InputError(f"{path}: found a mesh, wanted points with labels")
        return open_ply_mesh(path, options)
    vertices = Vertices(header, index, _property_names(header, index, options))
    if not header.is_ascii:
        _rows_of(vertices)
    columns = partial(read_columns, vertices)
    read_chunks = intensity_reader(path, partial(read_scalar, columns))
    if options.labels:
        read_chunks = label_reader(path, partial(read_scalar, columns), options.labels)
    elif len(vertices.names) > 4:
        read_chunks = partial(read_colored, path, columns, brightest_of(path, vertices.types[3:]))
    return PointSource(path, read_chunks, header.counts[index])


def _has_faces(header: PlyHeader) -> bool:
    """True for a mesh; colours whose range trimesh would get wrong are refused."""
    found = dict(zip((element.name for element in header.elements), header.counts, strict=True))
    if not found.get("face"):
        return False
    for element in header.elements:
        for prop in element.properties:
            if prop.name in COLOR_NAMES[0] and prop.val_dtype not in ("u1", "f4", "f8"):
                raise InputError(
                    f"{header.path}: '{prop.name}' is of type {prop.val_dtype}, wanted uchar 0-255 or "
                    "float 0-1 in a mesh"
                )
    return True


def has_ply_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` says it is PLY."""
    return head.startswith((b"ply\n", b"ply\r"))


def read_columns(vertices: Vertices) -> Iterator[Columns]:
    """Yield the columns of up to CHUNK vertices; those of an ASCII file are float64, whatever their type."""
    return (_read_ascii if vertices.header.is_ascii else _read_binary)(vertices)


def read_header(path: Path) -> PlyHeader:
    """The header of a PLY file; InputError if it is broken."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_SIZE)
    if not has_ply_magic(head):
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
        raise InputError(f"{path}: the header counts {quoted(b' '.join(counts))} elements, {WANTED}")
    try:
        # counts of 0 let plyfile stop at the header's end
        ply = PlyData.read(BytesIO(ELEMENT_LINE.sub(rb"\g<1>0", text)), mmap=False)
    except (PlyParseError, ValueError) as error:
        raise InputError(f"{path}: broken header ({quoted(str(error).encode())}), {WANTED}") from error
    if len(ply.elements) != len(counts):
        raise InputError(f"{path}: broken header (an element's line), {WANTED}")
    return PlyHeader(
        path, ply.elements, tuple(int(count) for count in counts), ply.byte_order, ply.text, size
    )


def vertex_index(header: PlyHeader) -> int:
    """Which element the vertices are; it and all before it have rows of a fixed length."""
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise InputError(f"{header.path}: the header has no element 'vertex', {WANTED}")
    index = names.index("vertex")
    for element in header.elements[: index + 1]:
        lists = [prop.name for prop in element.properties if isinstance(prop, PlyListProperty)]
        if lists:
            raise InputError(
                f"{header.path}: the element '{element.name}' has the list property '{lists[0]}', wanted "
                "vertices without lists, before the elements that have them"
            )
    return index


def _property_names(header: PlyHeader, index: int, options: CloudReadOptions) -> tuple[str, ...]:
    """The vertices' properties for x, y, z, red, green, blue, or for x, y, z, intensity."""
    found = {prop.name: prop.val_dtype for prop in header.elements[index].properties}
    names = color_names(found)
    if options.labels:
        return _labelled_names(header, found)
    intensity = next((name for name in found if name.lower() in INTENSITY_NAMES), None)
    if not all(axis in found for axis in "xyz") or not (names or intensity):
        kind = "Gaussian splats without red green blue, " if "f_dc_0" in found else ""
        raise InputError(
            f"{header.path}: {kind}the vertices have {' '.join(list(found)[:9]) or 'no properties'}, {WANTED}"
        )
    if not names:
        check_option(header.path, options, WANTED)
    return (*"xyz", *(names or (str(intensity),)))


def _labelled_names(header: PlyHeader, found: dict[str, str]) -> tuple[str, ...]:
    """The vertices' properties for x, y, z, label."""
    by_lower = {name.lower(): name for name in found}
    label = next((by_lower[name] for name in LABEL_NAMES if name in by_lower), None)
    if not all(axis in found for axis in "xyz") or label is None:
        raise InputError(
            f"{header.path}: the vertices have {' '.join(list(found)[:9]) or 'no properties'}, wanted x y z "
            "and a label (label, class or classification, or these after scalar_)"
        )
    return (*"xyz", label)


def _rows_of(vertices: Vertices) -> tuple[int, int, np.dtype[np.void]]:
    """Where the rows of a binary file begin [byte], how many there are, and what is in one."""
    header, count = vertices.header, vertices.header.counts[vertices.index]
    before = zip(header.elements[: vertices.index], header.counts, strict=False)
    offset = header.size + sum(count * element.dtype().itemsize for element, count in before)
    dtype = vertices.element.dtype(header.byte_order)
    room = max(header.path.stat().st_size - offset, 0)
    if dtype.itemsize * count > room:
        raise InputError(
            f"{header.path}: the header promises {count} vertices of {dtype.itemsize} bytes, found {room} "
            "bytes; the file is cut off or broken"
        )
    return offset, count, dtype


def _read_binary(vertices: Vertices) -> Iterator[Columns]:
    """Yield the columns of up to raw.CHUNK vertices."""
    for rows in read_records(vertices.header.path, *_rows_of(vertices)):
        yield [rows[name] for name in vertices.names]


def _read_ascii(vertices: Vertices) -> Iterator[Columns]:
    """Yield the columns of up to raw.CHUNK vertices."""
    header = vertices.header
    properties = [prop.name for prop in vertices.element.properties]
    columns = tuple(properties.index(name) for name in vertices.names)
    lines = NumberLines(header.path, LineLayout(columns, len(properties), header.size), WANTED)
    lines.skip(sum(header.counts[: vertices.index]))
    for rows in lines.read_rows(header.counts[vertices.index]):
        yield list(rows.T)


PLY = CloudFormat("PLY", frozenset({".ply"}), has_ply_magic, open_ply, has_labels=True)
