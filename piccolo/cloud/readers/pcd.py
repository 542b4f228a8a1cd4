"""PCD files of the Point Cloud Library, 0.5 to 0.7: ascii, binary and binary_compressed.

VIEWPOINT is where the sensor was; the points are already in the cloud's frame, so it is not applied.
"""

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from . import reader as raw
from .colors import BRIGHTEST, TYPES_WANTED, in_words, to_bytes
from .intensity import OPTION, in_gray
from .labels import in_palette
from .lines import quoted
from .lzf import MAX_RATIO, decompress_lzf
from .pcd_header import WANTED, Field, Header, read_header
from .point_lines import PointLines
from .reader import PLAIN, Format, PointSource, RawCloud, ReadOptions
from .records import read_records, take_records

FIRST_LINES = re.compile(rb"(?:#[^\n]*\n|[ \t\r\n])*(?:# \.PCD|VERSION[ \t]+0?\.\d)")
PADDING = "_"
PACKED_NAMES = ("rgb", "rgba")  # 0xAARRGGBB in one number
PACKED_TYPES = ("f4", "u4", "i4")
INTENSITY, LABEL = "intensity", "label"
MEASURED_TYPES = ("f4", "f8", "u1", "u2", "u4", "i1", "i2", "i4")
COLOR_NAMES = (("r", "g", "b"), ("red", "green", "blue"))


def open_pcd(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of a PCD file.

    Colours are `rgb` or `rgba`, three bytes in one integer or, if the field is declared a float, in its bits,
    in ASCII too; or r g b (red green blue) of uint8 0-255, uint16 0-65535 or float 0-1. Alpha and all other
    fields are left out. The options may welcome `intensity` or `label` in place of colours. The file's size
    is held against the header before memory is reserved.
    """
    header = read_header(path)
    fields = _wanted_fields(header, options)
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
    _check_size(header)
    read_chunks: Callable[[], Iterator[Any]] = partial(read[header.encoding], header, fields)
    if options.labels:
        read_chunks = in_palette(path, read_chunks, options.labels)
    elif fields[3].name == INTENSITY:
        read_chunks = in_gray(path, read_chunks)
    return PointSource(path, read_chunks, header.num_points)


def has_pcd_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` says it is PCD."""
    return FIRST_LINES.match(head) is not None


def _wanted_fields(header: Header, options: ReadOptions) -> tuple[Field, ...]:
    """The fields x y z and the colour's one or three, or the intensity if that is welcome."""
    found = {field.name: field for field in header.fields if field.count == 1}
    names = [field.name for field in header.fields]
    choices = [(LABEL,)] if options.labels else [*((name,) for name in PACKED_NAMES), *COLOR_NAMES]
    color = next((choice for choice in choices if all(name in found for name in choice)), None)
    has_intensity = color is None and INTENSITY in found and not options.labels
    if has_intensity and options.intensity_as_gray:
        color = (INTENSITY,)
    if not all(names.count(axis) == 1 and axis in found for axis in "xyz") or color is None:
        wanted_fields = "wanted x y z and label" if options.labels else WANTED
        listed = " ".join(names[:12]) or "none"
        more = f"; has intensity and no colours, {OPTION}" if has_intensity else ""
        raise InputError(f"{header.path}: the fields are {quoted(listed.encode())}, {wanted_fields}{more}")
    wanted = tuple(found[name] for name in (*"xyz", *color))
    types = ("f4", "f8"), (PACKED_TYPES if len(color) == 1 else tuple(BRIGHTEST))
    if color[0] in (INTENSITY, LABEL):
        types = types[0], MEASURED_TYPES
    for k, field in enumerate(wanted):
        if field.type not in types[k >= 3]:
            kinds = ("float32 or float64", "uint32, int32 or float32" if len(color) == 1 else TYPES_WANTED)
            raise InputError(f"{header.path}: '{field.name}' is of type {field.type}, wanted {kinds[k >= 3]}")
    if len({field.type for field in wanted[3:]}) > 1:
        found_types = " ".join(field.type for field in wanted[3:])
        raise InputError(f"{header.path}: {' '.join(color)} are of types {found_types}, wanted one for all")
    return wanted


def _check_size(header: Header) -> None:
    """Refuse a header that promises more than the file has."""
    found = header.path.stat().st_size - header.size
    if header.encoding == "ascii":
        promised = 2 * header.num_columns * header.num_points - 1  # a digit and a separator a number
    elif header.encoding == "binary":
        promised = header.row_size * header.num_points
    else:
        promised = 8  # what stands there is checked when it is unpacked
    if promised > found:
        raise InputError(
            f"{header.path}: the header promises {header.num_points} points in {promised} bytes or more, "
            f"found {found} bytes; the file is cut off or broken"
        )


def _read_ascii(header: Header, fields: tuple[Field, ...]) -> Iterator[Any]:
    targets = np.full(header.num_columns, -1)
    targets[[field.column for field in fields]] = np.arange(len(fields))
    lines = PointLines(header.path, WANTED, header.size, header.num_lines)
    num_left = header.num_points
    while num_left:
        before = lines.copy()
        rows = np.empty((min(num_left, raw.CHUNK), len(fields)))
        num_rows = lines.take_rows(targets, True, rows)
        if num_rows == 0:
            raise InputError(
                f"{header.path}: the header promises {header.num_points} points, found "
                f"{header.num_points - num_left}; the file is cut off"
            )
        num_left -= num_rows
        points_world, values = rows[:num_rows, :3].copy(), rows[:num_rows, 3:]
        if fields[3].name in (INTENSITY, LABEL):
            yield points_world, values[:, 0].copy()
            continue
        colors, wrong = _colors_of_text(fields[3:], values, points_world)
        if wrong >= 0:
            place = f"line {before.line_number(wrong)}"
            raise InputError(_color_complaint(header, fields, place, values[wrong]))
        yield RawCloud(points_world, colors)


def _colors_of_text(
    fields: tuple[Field, ...], values: NDArray[np.float64], points_world: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], int]:
    """Colours (N, 3) of the numbers (N, 1) or (N, 3) of ASCII; and the first that is wrong, or -1."""
    if len(fields) == 3:
        return to_bytes(values, points_world, BRIGHTEST[fields[0].type])
    is_finite: NDArray[np.bool_] = np.all(np.isfinite(points_world), axis=1)
    packed = np.where(is_finite, values[:, 0], 0.0)
    if fields[0].type == "f4":
        # alpha 255 and a red above 127 make a NaN, which in text has lost its bits
        is_right = np.abs(packed) <= np.finfo(np.float32).max
        bits = np.where(is_right, packed, 0.0).astype(np.float32).view(np.uint32)
    else:
        is_right = (packed >= -(2.0**31)) & (packed < 2.0**32) & (packed == np.floor(packed))
        bits = np.where(is_right, packed, 0.0).astype(np.int64).astype(np.uint32)
    return _unpacked(bits), -1 if is_right.all() else int(np.argmin(is_right))


def _read_binary(header: Header, fields: tuple[Field, ...]) -> Iterator[Any]:
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": ["<" + field.type for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": header.row_size,
        }
    )
    num_before = 0
    for records in read_records(header.path, header.size, header.num_points, dtype):
        yield _chunk(header, fields, [records[field.name] for field in fields], num_before)
        num_before += len(records)


def _read_compressed(header: Header, fields: tuple[Field, ...]) -> Iterator[Any]:
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
    for begin in range(0, header.num_points, raw.CHUNK):
        chunk = slice(begin, begin + raw.CHUNK)
        yield _chunk(header, fields, [columns[field.name][chunk] for field in fields], begin)


def _chunk(
    header: Header, fields: tuple[Field, ...], columns: list[NDArray[np.generic]], num_before: int
) -> Any:
    """Points of the wanted fields' columns, behind `num_before` others; with a colour or what is measured."""
    with np.errstate(invalid="ignore"):  # a NaN of the kind that signals
        points_world = np.stack(columns[:3], axis=1, dtype=np.float64)
    if fields[3].name in (INTENSITY, LABEL):
        return points_world, columns[3].astype(np.float64)
    if len(fields) == 4:
        return RawCloud(points_world, _unpacked(np.ascontiguousarray(columns[3]).view(np.uint32)))
    values = np.stack(columns[3:], axis=1)
    colors, wrong = to_bytes(values, points_world, BRIGHTEST[fields[3].type])
    if wrong >= 0:
        place = f"point {num_before + wrong + 1}"
        raise InputError(_color_complaint(header, fields, place, values[wrong]))
    return RawCloud(points_world, colors)


def _unpacked(bits: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Colours (N, 3) of numbers (N,) 0xAARRGGBB."""
    return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)


def _color_complaint(
    header: Header, fields: tuple[Field, ...], place: str, color: NDArray[np.generic]
) -> str:
    type_ = fields[3].type
    wanted = f"0 to {BRIGHTEST[type_]:g}" if len(fields) == 6 else "32 bits"
    return f"{header.path}: {place} has the colour {in_words(color)}, wanted {wanted} of the type {type_}"


PCD = Format("PCD", frozenset({".pcd"}), has_pcd_magic, open_pcd, has_labels=True)
