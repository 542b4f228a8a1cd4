"""E57 files: the coloured points of all scans, each at its pose; decoded by libE57."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...geometry.point_transforms import rotate_points
from .e57_file import (
    NAMESPACE,
    E57File,
    Placement,
    child,
    children,
    has_e57_magic,
    number_of,
    opened,
    parsed_integer,
    parsed_number,
    placement_of,
    refusing,
    scaled,
    text_of,
)
from .intensity import OPTION, intensity_reader
from .reader import CHUNK, PLAIN, CloudFormat, CloudReadOptions, PointSource, PointsWithScalar, RawCloud

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
INVALID = {CARTESIAN: "cartesianInvalidState", SPHERICAL: "sphericalInvalidState"}
INTENSITY = "intensity"
INVALID_COLOR, INVALID_INTENSITY = "isColorInvalid", "isIntensityInvalid"
TOLERANCE = 0.01  # of 255, what a float colour may lie outside of its range
WANTED = "wanted scans with colorRed colorGreen colorBlue"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class E57Scan:
    """One scan of a file."""

    index: int
    label: str  # for messages
    num_points: int
    coordinates: tuple[str, ...]  # CARTESIAN or SPHERICAL
    channels: tuple[str, ...]  # COLORS or INTENSITY alone
    invalid: tuple[str, ...]  # fields that are 0 in points that count
    color_ranges: tuple[tuple[float, float], ...]  # of each channel; none: the intensity is read
    placement: Placement | None


class _UnusableError(Exception):
    """A scan is whole, but not of use here."""


def open_e57(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The coloured points of all scans of an E57 file.

    Points with an invalid state (direction only, or nothing) or an invalid colour are left out. A colour's
    range is the scan's colorLimits, or else what the field's declaration says; it is never guessed. Scans
    without colours beside others are left out, with a warning.
    """
    with opened(path) as file:
        scans, left_out = _scans(file, COLORS)
        measured, not_measured = ([], []) if scans else _scans(file, (INTENSITY,))
    if not scans and not (measured and options.intensity_as_gray):
        found = left_out[0] if left_out else "no scans"
        more = f"; {measured[0].label} has intensity and no colours, {OPTION}" if measured else ""
        raise InputError(f"{path}: {found}, {WANTED}{more}")
    warnings = tuple(f"{path}: {what}; left out" for what in (left_out if scans else not_measured))
    num_points = sum(scan.num_points for scan in scans or measured)
    read_chunks = intensity_reader(path, lambda: _read_scalar(path, measured))
    if scans:
        read_chunks = partial(_read_chunks, path, scans)
    return PointSource(path, read_chunks, num_points, warnings)


def _scans(file: E57File, channels: tuple[str, ...]) -> tuple[list[E57Scan], list[str]]:
    """The scans that have the channels, and why others have not."""
    elements = children(file.root, "data3D")
    scans: list[E57Scan] = []
    left_out: list[str] = []
    for index, element in enumerate(elements):
        label = f"scan {index + 1} of {len(elements)} ({text_of(element, 'name')[:40]!r})"
        try:
            scans.append(_scan(file, element, channels, index, label))
        except _UnusableError as reason:
            left_out.append(f"{label} {reason}")
    return scans, left_out


def _scan(file: E57File, element: Element, channels: tuple[str, ...], index: int, label: str) -> E57Scan:
    """What is to be read of a scan; _UnusableError if nothing is."""
    points = child(element, "points")
    prototype = child(points, "prototype")
    if points is None or prototype is None or points.get("type") != "CompressedVector":
        raise _UnusableError("has no points")
    num_points = parsed_integer(file.path, points.get("recordCount", "0"))
    if num_points <= 0:
        raise _UnusableError(f"has {num_points} points")
    fields = {field.tag.removeprefix(NAMESPACE): field for field in prototype}
    coordinates = next((names for names in (CARTESIAN, SPHERICAL) if fields.keys() >= set(names)), None)
    if coordinates is None:
        raise _UnusableError("has neither cartesian nor spherical coordinates")
    if not fields.keys() >= set(channels):
        raise _UnusableError("has no colours" if channels == COLORS else "has no intensity")
    if channels != COLORS and fields.keys() >= set(COLORS):
        raise _UnusableError("has colours, but without a range")
    invalid = (INVALID[coordinates], INVALID_COLOR if channels == COLORS else INVALID_INTENSITY)
    _check_size(file, label, num_points, prototype)
    return E57Scan(
        index=index,
        label=label,
        num_points=num_points,
        coordinates=coordinates,
        channels=channels,
        invalid=tuple(name for name in invalid if name in fields),
        color_ranges=tuple(
            _color_range(file.path, element, fields[name]) for name in channels if name != INTENSITY
        ),
        placement=placement_of(file.path, element),
    )


def _check_size(file: E57File, label: str, num_points: int, prototype: Element) -> None:
    """Refuse more points than the bits of the file could hold."""
    num_bits = sum(_num_bits(file.path, field) for field in prototype.iter())
    if num_bits == 0 or num_points * num_bits > 8 * file.size:
        raise InputError(
            f"{file.path}: {label} promises {num_points} points of {num_bits} bits, found a file of "
            f"{file.size} bytes; it is broken"
        )


def _num_bits(path: Path, field: Element) -> int:
    """The length of a field in a record, at least."""
    type_ = field.get("type")
    if type_ == "Float":
        return 32 if field.get("precision") == "single" else 64
    if type_ in ("Integer", "ScaledInteger"):
        low = parsed_integer(path, field.get("minimum", str(-(1 << 63))))
        high = parsed_integer(path, field.get("maximum", str((1 << 63) - 1)))
        return max(high - low, 0).bit_length()
    return 0


def _color_range(path: Path, element: Element, field: Element) -> tuple[float, float]:
    """The values of a channel that mean dark and full brightness."""
    name = field.tag.removeprefix(NAMESPACE)
    limits = child(element, "colorLimits")
    low, high = (number_of(path, child(limits, name + end)) for end in ("Minimum", "Maximum"))
    if low is not None and high is not None and low < high:
        return low, high
    declared = [field.get(end) for end in ("minimum", "maximum")]
    if None in declared:
        raise _UnusableError(f"has colours without a range: neither colorLimits nor a declared {name}")
    first, last = (parsed_number(path, text or "") for text in declared)
    if field.get("type") == "ScaledInteger":
        first, last = scaled(path, field, first), scaled(path, field, last)
    if not first < last:
        raise _UnusableError(f"has colours without a range: {name} is declared {first:g} to {last:g}")
    return first, last


def _read_chunks(path: Path, scans: list[E57Scan]) -> Iterator[RawCloud]:
    with opened(path) as file:
        for scan in scans:
            for columns in _read_scan(file, scan):
                with np.errstate(over="ignore", invalid="ignore"):  # broken points may be infinite
                    cloud = _cloud(path, scan, columns)
                yield cloud


def _read_scalar(path: Path, scans: list[E57Scan]) -> Iterator[PointsWithScalar]:
    with opened(path) as file:
        for scan in scans:
            for columns in _read_scan(file, scan):
                with np.errstate(over="ignore", invalid="ignore"):
                    points_world, is_valid = _points(scan, columns)
                yield points_world, columns[INTENSITY][is_valid]


def _read_scan(file: E57File, scan: E57Scan) -> Iterator[dict[str, Array]]:
    """The columns of a scan, a chunk at a time, in room that is used again."""
    names = (*scan.coordinates, *scan.channels, *scan.invalid)
    columns = {name: np.empty(min(scan.num_points, CHUNK)) for name in names}
    num_read = 0
    with refusing(file.path, file.libe57):
        reader = _reader(file, scan, columns)
    while num_read < scan.num_points:
        with refusing(file.path, file.libe57):
            count = reader.read()
        if count == 0:
            break
        num_read += count
        yield {name: column[:count] for name, column in columns.items()}
    reader.close()
    if num_read != scan.num_points:
        raise InputError(
            f"{file.path}: {scan.label} promises {scan.num_points} points, found {num_read}; "
            "the file is broken"
        )


def _reader(file: E57File, scan: E57Scan, columns: dict[str, Array]) -> Any:
    """libE57's reader, which fills the columns from their beginning at each call."""
    buffers = file.libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(file.libe57.SourceDestBuffer(file.image_file, name, column, len(column), True, True))
    return file.image_file.root()["data3D"][scan.index]["points"].reader(buffers)


def _points(scan: E57Scan, columns: dict[str, Array]) -> tuple[Array, NDArray[np.bool_]]:
    """The points that count (N, 3), in the world, from the columns of a chunk, and which these are."""
    is_valid = np.ones(len(columns[scan.coordinates[0]]), dtype=np.bool_)
    for name in scan.invalid:
        is_valid &= columns[name] == 0
    a, b, c = (columns[name][is_valid] for name in scan.coordinates)
    if scan.coordinates == SPHERICAL:
        a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
    points_world = np.stack([a, b, c], axis=1)
    if scan.placement is not None:
        R_world_from_local = scan.placement.R_world_from_local
        points_world = rotate_points(points_world, R_world_from_local) + scan.placement.center_world
    return points_world, is_valid


def _cloud(path: Path, scan: E57Scan, columns: dict[str, Array]) -> RawCloud:
    """The points that count, in the world, and their colours."""
    points_world, is_valid = _points(scan, columns)
    channels = [
        _channel(path, scan, columns[name][is_valid], *range_)
        for name, range_ in zip(COLORS, scan.color_ranges, strict=True)
    ]
    return RawCloud(points_world, np.stack(channels, axis=1))


def _channel(path: Path, scan: E57Scan, values: Array, low: float, high: float) -> NDArray[np.uint8]:
    """Channel (N,) 0-255 of values (N,) in the range from `low` to `high`."""
    brightness = (values - low) * (255.0 / (high - low))
    is_wrong = ~((brightness >= -TOLERANCE) & (brightness <= 255.0 + TOLERANCE))
    if is_wrong.any():
        raise InputError(
            f"{path}: {scan.label} has a colour of {values[np.argmax(is_wrong)]:g}, wanted {low:g} to "
            f"{high:g} as the file declares"
        )
    return np.rint(brightness).astype(np.uint8)


E57 = CloudFormat("E57", frozenset({".e57"}), has_e57_magic, open_e57)
