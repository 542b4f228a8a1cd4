"""PLY files: the vertices' positions and colours.

plyfile reads the header: the names, types and byte order. It would reserve whatever size the header
promises, and read ASCII and lists line by line in Python, so the numbers are read here.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ...errors import InputError
from . import reader as raw
from .intensity import INTENSITY_NAMES, OPTION, in_gray
from .labels import LABEL_NAMES, in_palette
from .lines import LineReader, quoted
from .mesh import open_ply_mesh
from .reader import PLAIN, Format, Measured, PointSource, RawCloud, ReadOptions
from .records import read_records
from .rows import NOT_A_NUMBER, TOO_FEW, TOO_MANY

MAX_HEADER_SIZE = 1 << 20  # [byte]
LINE_ENDS = (b"\r\n", b"\n", b"\r")
ELEMENT_LINE = re.compile(rb"^(\s*element[ \t]+\S+[ \t]+)(\S+)[ \t]*$", re.MULTILINE)
COLOR_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
# The value that means full brightness, by the type that the header declares: a range is never guessed.
BRIGHTEST = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
WANTED = "wanted a PLY file whose vertices have x y z and red green blue"
MAX_COUNT_DIGITS = 15


@dataclass(frozen=True)
class Header:
    """What a PLY file says of itself."""

    path: Path
    elements: tuple[PlyElement, ...]
    counts: tuple[int, ...]  # of each element
    byte_order: str  # '<' or '>', '=' in ASCII
    is_ascii: bool
    size: int  # [byte], the data begin here


@dataclass(frozen=True)
class Vertices:
    """The vertices of a PLY file, and the properties that are wanted of them."""

    header: Header
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


def open_ply(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The vertices of a PLY file, binary or ASCII; points on its faces if it has any.

    Colours are uchar 0-255, ushort 0-65535, or float and double 0-1. Other properties and elements are left
    out. The file's size is held against the header's counts before memory is reserved.
    """
    header = read_header(path)
    index = vertex_index(header)
    if _has_faces(header):
        if options.labels:
            raise InputError(f"{path}: found a mesh, wanted points with labels")
        return open_ply_mesh(path, options)
    vertices = Vertices(header, index, _property_names(header, index, options))
    count = header.counts[index]
    if not header.is_ascii:
        _rows_of(vertices)
    if options.labels:
        return PointSource(path, in_palette(path, lambda: _read_measured(vertices), options.labels), count)
    if len(vertices.names) > 4:
        return PointSource(path, lambda: _read_colored(vertices), count)
    return PointSource(path, in_gray(path, lambda: _read_measured(vertices)), count)


def _has_faces(header: Header) -> bool:
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


def read_columns(vertices: Vertices) -> Iterator[list[NDArray[np.generic]]]:
    """Yield the columns of up to CHUNK vertices; those of an ASCII file are float64, whatever their type."""
    return (_read_ascii if vertices.header.is_ascii else _read_binary)(vertices)


def _read_colored(vertices: Vertices) -> Iterator[RawCloud]:
    for columns in read_columns(vertices):
        points = np.stack(columns[:3], axis=1, dtype=np.float64)
        is_finite: NDArray[np.bool_] = np.all(np.isfinite(points), axis=1)
        colors = [
            _color(vertices.header.path, column, type_, is_finite)
            for column, type_ in zip(columns[3:], vertices.types[3:], strict=True)
        ]
        yield RawCloud(points, np.stack(colors, axis=1))


def _read_measured(vertices: Vertices) -> Iterator[Measured]:
    for columns in read_columns(vertices):
        yield np.stack(columns[:3], axis=1, dtype=np.float64), columns[3].astype(np.float64)


def read_header(path: Path) -> Header:
    """What a PLY file says of itself; InputError if that can't be made out."""
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
    return Header(path, ply.elements, tuple(int(count) for count in counts), ply.byte_order, ply.text, size)


def vertex_index(header: Header) -> int:
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


def _property_names(header: Header, index: int, options: ReadOptions) -> tuple[str, ...]:
    """The vertices' properties for x, y, z, red, green, blue, or for x, y, z, intensity."""
    found = {prop.name: prop.val_dtype for prop in header.elements[index].properties}
    names = next((names for names in COLOR_NAMES if all(name in found for name in names)), ())
    if options.labels:
        return _labelled_names(header, found)
    intensity = next((name for name in found if name.lower() in INTENSITY_NAMES), None)
    if not all(axis in found for axis in "xyz") or not (names or intensity):
        kind = "Gaussian splats without red green blue, " if "f_dc_0" in found else ""
        raise InputError(
            f"{header.path}: {kind}the vertices have {' '.join(list(found)[:9]) or 'no properties'}, {WANTED}"
        )
    if intensity and not names:
        if not options.intensity_as_gray:
            raise InputError(
                f"{header.path}: the vertices have {intensity} and no colours, {WANTED}; {OPTION}"
            )
        return (*"xyz", intensity)
    for name in names:
        if found[name] not in BRIGHTEST:
            raise InputError(
                f"{header.path}: '{name}' is of type {found[name]}, "
                "wanted uchar 0-255, ushort 0-65535 or float 0-1"
            )
    return (*"xyz", *names)


def _labelled_names(header: Header, found: dict[str, str]) -> tuple[str, ...]:
    """The vertices' properties for x, y, z, label."""
    by_lower = {name.lower(): name for name in found}
    label = next((by_lower[name] for name in LABEL_NAMES if name in by_lower), None)
    if not all(axis in found for axis in "xyz") or label is None:
        raise InputError(
            f"{header.path}: the vertices have {' '.join(list(found)[:9]) or 'no properties'}, wanted x y z "
            "and a label (label, class or classification, or these after scalar_)"
        )
    return (*"xyz", label)


def _check_size(header: Header, index: int, offset: int, row_size: int) -> int:
    """The number of vertices, if their rows of `row_size` [byte] from `offset` on fit in the file."""
    count, size = header.counts[index], header.path.stat().st_size
    if row_size * count > size - offset:
        raise InputError(
            f"{header.path}: the header promises {count} vertices of {row_size} bytes or more, found "
            f"{max(size - offset, 0)} bytes; the file is cut off or broken"
        )
    return count


def _rows_of(vertices: Vertices) -> tuple[int, int, np.dtype[np.void]]:
    """Where the rows of a binary file begin [byte], how many there are, and what is in one."""
    header, index = vertices.header, vertices.index
    before = zip(header.elements[:index], header.counts, strict=False)
    offset = header.size + sum(count * element.dtype().itemsize for element, count in before)
    dtype = vertices.element.dtype(header.byte_order)
    return offset, _check_size(header, index, offset, dtype.itemsize), dtype


def _read_binary(vertices: Vertices) -> Iterator[list[NDArray[np.generic]]]:
    """Yield the columns of up to raw.CHUNK vertices."""
    for rows in read_records(vertices.header.path, *_rows_of(vertices)):
        yield [rows[name] for name in vertices.names]


def _read_ascii(vertices: Vertices) -> Iterator[list[NDArray[np.generic]]]:
    """Yield the columns of up to raw.CHUNK vertices."""
    header, index = vertices.header, vertices.index
    reader = LineReader(header.path, header.size)
    for element, count in zip(header.elements[:index], header.counts, strict=False):
        passed_over = np.full(len(element.properties), -1)
        reader.read(passed_over, True, np.empty((count, 0)))
    properties = [prop.name for prop in vertices.element.properties]
    # a digit and a separator a number; the last line may have no end
    count = _check_size(header, index, reader.offset - 1, 2 * len(properties))
    names = vertices.names
    targets = np.array([names.index(name) if name in names else -1 for name in properties])
    for begin in range(0, count, raw.CHUNK):
        rows = np.empty((min(raw.CHUNK, count - begin), len(names)))
        num_rows, status = reader.read(targets, True, rows)
        if num_rows < len(rows):
            raise InputError(f"{header.path}: {_complaint(reader, status, len(properties), count)}")
        yield list(rows.T)


def _complaint(reader: LineReader, status: int, num_wanted: int, count: int) -> str:
    what = {
        NOT_A_NUMBER: "is not all numbers",
        TOO_FEW: f"has fewer than {num_wanted} numbers",
        TOO_MANY: f"has more than {num_wanted} numbers",
    }.get(status)
    if what is None:
        return f"the header promises {count} vertices, found fewer; the file is cut off"
    return f"line {reader.num_lines} after the header {what}: {quoted(reader.line())}, {WANTED}"


def _color(
    path: Path, column: NDArray[np.generic], type_: str, is_finite: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Channel (N,) uint8 of a column whose range follows from its declared type; 0 where not `is_finite`."""
    if type_ == "u1" and column.dtype == np.uint8:
        return column.astype(np.uint8)
    values = np.where(is_finite, column, 0).astype(np.float64)
    is_wrong = ~((values >= 0.0) & (values <= BRIGHTEST[type_]))
    if is_wrong.any():
        raise InputError(
            f"{path}: a colour of {values[np.argmax(is_wrong)]:g}, wanted 0 to {BRIGHTEST[type_]:g} as the "
            f"header declares the type {type_}"
        )
    return np.rint(values * (255.0 / BRIGHTEST[type_])).astype(np.uint8)


PLY = Format("PLY", frozenset({".ply"}), has_ply_magic, open_ply, has_labels=True)
