"""PLY files: the vertices' positions and colours.

plyfile reads the header: the names, types and byte order. It would reserve whatever size the header
promises, and read ASCII and lists line by line in Python, so the numbers are read here.
"""

import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..errors import InputError
from .raw import Format, PointSource, RawCloud
from .rows import NOT_A_NUMBER, PARSED, SPACE, TOO_FEW, TOO_MANY, parse_rows
from .text import quoted

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


def open_ply(path: Path) -> PointSource:
    """The vertices of a PLY file; see read_ply."""
    return PointSource(path, lambda: iter([read_ply(path)]))


def has_ply_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` says it is PLY."""
    return head.startswith((b"ply\n", b"ply\r"))


def read_ply(path: Path) -> RawCloud:
    """The vertices of a PLY file, binary or ASCII.

    Colours are uchar 0-255, ushort 0-65535, or float and double 0-1. Other properties and elements are left
    out. The file's size is held against the header's counts before memory is reserved.
    """
    header = _read_header(path)
    index = _vertex_index(header)
    names = _property_names(header, header.elements[index])
    columns = (_ascii_columns if header.is_ascii else _binary_columns)(header, index, names)
    types = [header.elements[index].ply_property(name).val_dtype for name in names]
    points = np.stack(columns[:3], axis=1, dtype=np.float64)
    is_finite: NDArray[np.bool_] = np.all(np.isfinite(points), axis=1)
    colors = [
        _color(path, column, type_, is_finite) for column, type_ in zip(columns[3:], types[3:], strict=True)
    ]
    return RawCloud(points, np.stack(colors, axis=1))


def _read_header(path: Path) -> Header:
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


def _vertex_index(header: Header) -> int:
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


def _property_names(header: Header, vertex: PlyElement) -> list[str]:
    """The vertices' properties for x, y, z, red, green, blue."""
    found = {prop.name: prop.val_dtype for prop in vertex.properties}
    names = next((names for names in COLOR_NAMES if all(name in found for name in names)), None)
    if not all(axis in found for axis in "xyz") or names is None:
        kind = "Gaussian splats without red green blue, " if "f_dc_0" in found else ""
        raise InputError(
            f"{header.path}: {kind}the vertices have {' '.join(list(found)[:9]) or 'no properties'}, {WANTED}"
        )
    for name in names:
        if found[name] not in BRIGHTEST:
            raise InputError(
                f"{header.path}: '{name}' is of type {found[name]}, "
                "wanted uchar 0-255, ushort 0-65535 or float 0-1"
            )
    return [*"xyz", *names]


def _check_size(header: Header, index: int, offset: int, row_size: int) -> int:
    """The number of vertices, if their rows of `row_size` [byte] from `offset` on fit in the file."""
    count, size = header.counts[index], header.path.stat().st_size
    if row_size * count > size - offset:
        raise InputError(
            f"{header.path}: the header promises {count} vertices of {row_size} bytes or more, found "
            f"{max(size - offset, 0)} bytes; the file is cut off or broken"
        )
    return count


def _binary_columns(header: Header, index: int, names: list[str]) -> list[NDArray[np.generic]]:
    before = zip(header.elements[:index], header.counts, strict=False)
    offset = header.size + sum(count * element.dtype().itemsize for element, count in before)
    dtype = header.elements[index].dtype(header.byte_order)
    count = _check_size(header, index, offset, dtype.itemsize)
    if count == 0:
        return [np.empty(0, dtype=dtype[name]) for name in names]
    vertices = np.memmap(header.path, dtype=dtype, mode="r", offset=offset, shape=(count,))
    return [np.asarray(vertices[name]) for name in names]


def _ascii_columns(header: Header, index: int, names: list[str]) -> list[NDArray[np.generic]]:
    data = np.asarray(np.memmap(header.path, dtype=np.uint8, mode="r"))
    offset = header.size
    for element, count in zip(header.elements[:index], header.counts, strict=False):
        _, _, offset, _ = parse_rows(
            data, offset, SPACE, np.full(len(element.properties), -1), True, np.empty((count, 0))
        )
    properties = [prop.name for prop in header.elements[index].properties]
    # a digit and a separator a number; the last line may have no end
    count = _check_size(header, index, offset - 1, 2 * len(properties))
    targets = np.array([names.index(name) if name in names else -1 for name in properties])
    rows = np.empty((count, len(names)))
    num_rows, num_lines, position, status = parse_rows(data, offset, SPACE, targets, True, rows)
    if status != PARSED:
        what = {
            NOT_A_NUMBER: "is not all numbers",
            TOO_FEW: f"has fewer than {len(properties)} numbers",
            TOO_MANY: f"has more than {len(properties)} numbers",
        }[status]
        line = bytes(data[position : position + 400])
        raise InputError(f"{header.path}: line {num_lines} after the header {what}: {quoted(line)}, {WANTED}")
    if num_rows < count:
        raise InputError(
            f"{header.path}: the header promises {count} vertices, found {num_rows}; the file is cut off"
        )
    return list(rows.T)


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


PLY = Format("PLY", frozenset({".ply"}), has_ply_magic, open_ply)
