"""PCD files of the Point Cloud Library, 0.5 to 0.7: ascii, binary and binary_compressed.

VIEWPOINT is where the sensor was; the points are already in the cloud's frame, so it is not applied.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .colors import brightest_of, color_names
from .columns import ColumnReader, Columns, points_of, read_colored, read_scalar
from .fixed_records import in_chunks, read_records, take_records
from .intensity import OPTION, intensity_reader
from .labels import label_reader
from .lzf import MAX_RATIO, decompress_lzf
from .number_lines import LineLayout, NumberLines
from .pcd_header import WANTED, PcdField, PcdHeader, read_header
from .reader import (
    PLAIN,
    ChunkReader,
    CloudFormat,
    CloudReadOptions,
    PointSource,
    RawCloud,
    point_label,
    quoted,
)

FIRST_LINES = re.compile(rb"(?:#[^\n]*\n|[ \t\r\n])*(?:# \.PCD|VERSION[ \t]+0?\.\d)")
PADDING = "_"
PACKED_NAMES = ("rgb", "rgba")  # 0xAARRGGBB in one number
PACKED_TYPES = ("f4", "u4", "i4")
INTENSITY, LABEL = "intensity", "label"
SCALAR_TYPES = ("f4", "f8", "u1", "u2", "u4", "i1", "i2", "i4")


def open_pcd(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The points of a PCD file.

    Colours are `rgb` or `rgba`, three bytes in one integer or, if the field is declared a float, in its bits,
    in ASCII too; or r g b (red green blue) of uint8 0-255, uint16 0-65535 or float 0-1. Alpha and all other
    fields are left out. With the options for it, `intensity` or `label` stands in for colours. The size of a
    binary file is compared with the header before memory is reserved.
    """
    header = read_header(path)
    fields = _wanted_fields(header, options)
    _check_size(header)
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
    read_columns = partial(read[header.encoding], header, fields)
    read_chunks: ChunkReader = partial(_read_packed, header, fields[3].type, read_columns)
    if options.labels:
        read_chunks = label_reader(path, partial(read_scalar, read_columns), options.labels)
    elif fields[3].name == INTENSITY:
        read_chunks = intensity_reader(path, partial(read_scalar, read_columns))
    elif len(fields) == 6:
        brightest = brightest_of(path, [field.type for field in fields[3:]])
        read_chunks = partial(read_colored, path, read_columns, brightest)
    return PointSource(path, read_chunks, header.num_points)


def has_pcd_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` says it is PCD."""
    return FIRST_LINES.match(head) is not None


def _wanted_fields(header: PcdHeader, options: CloudReadOptions) -> tuple[PcdField, ...]:
    """The fields x y z and the colour's one or three, or the intensity or label if the options say so."""
    found = {field.name: field for field in header.fields if field.count == 1}
    names = [field.name for field in header.fields]
    color = next(((name,) for name in PACKED_NAMES if name in found), color_names(found))
    if options.labels:
        color = (LABEL,) if LABEL in found else ()
    has_intensity = not color and INTENSITY in found and not options.labels
    if has_intensity and options.intensity_as_gray:
        color = (INTENSITY,)
    if not all(names.count(axis) == 1 and axis in found for axis in "xyz") or not color:
        wanted_fields = "wanted x y z and label" if options.labels else WANTED
        listed = " ".join(names[:12]) or "none"
        more = f"; has intensity and no colours, {OPTION}" if has_intensity else ""
        raise InputError(f"{header.path}: the fields are {quoted(listed.encode())}, {wanted_fields}{more}")
    wanted = tuple(found[name] for name in (*"xyz", *color))
    for field in wanted[:4] if len(color) == 1 else wanted[:3]:
        types: tuple[str, ...] = ("f4", "f8")
        kinds = "float32 or float64"
        if field.name in PACKED_NAMES:
            types, kinds = PACKED_TYPES, "uint32, int32 or float32"
        elif field.name in (INTENSITY, LABEL):
            types, kinds = SCALAR_TYPES, "numbers of 32 bits or float64"
        if field.type not in types:
            raise InputError(f"{header.path}: '{field.name}' is of type {field.type}, wanted {kinds}")
    return wanted


def _check_size(header: PcdHeader) -> None:
    """Refuse a binary file that is shorter than its header promises; others are checked as they are read."""
    found = header.path.stat().st_size - header.size
    promised = {"ascii": 0, "binary": header.row_size * header.num_points}.get(header.encoding, 8)
    if promised > found:
        raise InputError(
            f"{header.path}: the header promises {header.num_points} points in {promised} bytes or more, "
            f"found {found} bytes; the file is cut off or broken"
        )


def _read_ascii(header: PcdHeader, fields: tuple[PcdField, ...]) -> Iterator[Columns]:
    layout = LineLayout(tuple(field.column for field in fields), header.num_columns, header.size)
    for rows in NumberLines(header.path, layout, WANTED).read_rows(header.num_points):
        yield list(rows.T)


def _read_binary(header: PcdHeader, fields: tuple[PcdField, ...]) -> Iterator[Columns]:
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": ["<" + field.type for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": header.row_size,
        }
    )
    for records in read_records(header.path, header.size, header.num_points, dtype):
        yield [records[field.name] for field in fields]


def _read_compressed(header: PcdHeader, fields: tuple[PcdField, ...]) -> Iterator[Columns]:
    kept = [field for field in header.fields if field.name != PADDING]  # PCL leaves padding out
    promised = header.num_points * sum(field.size for field in kept)
    found = header.path.stat().st_size - header.size - 8
    with header.path.open("rb") as file:
        file.seek(header.size)
        packed_size, size = take_records(file, header.path, 2, np.dtype("<u4")).tolist()
        if packed_size > found or size > MAX_RATIO * packed_size or size != promised:
            raise InputError(
                f"{header.path}: {size} bytes packed into {packed_size}, found {found}, wanted "
                f"{promised} for {header.num_points} points; the file is cut off or broken"
            )
        packed = take_records(file, header.path, packed_size, np.dtype(np.uint8))
    table = np.empty(size, dtype=np.uint8)
    if decompress_lzf(packed, table) != size:
        raise InputError(f"{header.path}: the compressed data are broken, {WANTED}")
    columns = {}
    begin = 0
    for field in kept:  # all points' values of a field, then those of the next
        end = begin + field.size * header.num_points
        if field in fields:
            columns[field.name] = table[begin:end].view("<" + field.type)
        begin = end
    yield from in_chunks([columns[field.name] for field in fields])


def _read_packed(header: PcdHeader, type_: str, read_columns: ColumnReader) -> Iterator[RawCloud]:
    """The points with colours 0xAARRGGBB of a declared type, whose numbers ASCII has as text."""
    num_before = 0
    for columns in read_columns():
        points_world, values = points_of(columns), columns[3]
        if header.encoding == "ascii":
            bits, is_right = _bits_of_text(
                np.where(np.isfinite(points_world).all(axis=1), values, 0.0), type_
            )
            if not is_right.all():
                wrong = int(np.argmin(is_right))
                raise InputError(
                    f"{point_label(header.path, num_before + wrong)} has the colour {values[wrong]:g}, "
                    f"wanted 32 bits of the type {type_}"
                )
        else:
            bits = np.ascontiguousarray(values).view(np.uint32)
        num_before += len(bits)
        yield RawCloud(points_world, np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8))


def _bits_of_text(values: NDArray[np.float64], type_: str) -> tuple[NDArray[np.uint32], NDArray[np.bool_]]:
    """32 bits (N,) of each number, and whether it has as many."""
    if type_ == "f4":
        # alpha 255 and a red above 127 make a NaN, which in text has lost its bits
        is_right = np.abs(values) <= np.finfo(np.float32).max
        return np.where(is_right, values, 0.0).astype(np.float32).view(np.uint32), is_right
    is_right = (values >= -(2.0**31)) & (values < 2.0**32) & (values == np.floor(values))
    return np.where(is_right, values, 0.0).astype(np.int64).astype(np.uint32), is_right


PCD = CloudFormat("PCD", frozenset({".pcd"}), has_pcd_magic, open_pcd, has_labels=True)
