"""E57 files, decoded by libE57: the coloured points of all scans, each placed by its pose, and the images."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from ...geometry.pose import Pose, rotate_points
from ...system.arrays import Array, Bytes
from ...system.errors import InputError
from ..cloud_settings import BY_FILE, RANGES, Channel, CloudSettings
from ..units import describe_foreign, units_of_wkt
from . import e57_file, reader
from .e57_file import E57File, open_file, parse_integer, read_number, refusing
from .reader import POINTS_A_CHUNK, MissingChannelError, PointSource

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
INTENSITY = "intensity"
INVALID = {  # fields that are 0 for valid points, by the fields that they qualify
    CARTESIAN: "cartesianInvalidState",
    SPHERICAL: "sphericalInvalidState",
    COLORS: "isColorInvalid",
    (INTENSITY,): "isIntensityInvalid",
}
# ranges of colours that a file leaves open, to be found from the values: the usual full brightness, twice
OPEN = {"Float": (1.0, 1.0)}
WIDE_RANGES = RANGES[-1], RANGES[-1]  # the same for whole numbers
COLOR_TOLERANCE = 0.01  # of 255, by which a float colour may lie outside of its range
CHANNELS: dict[Channel, tuple[str, ...]] = {"colors": COLORS, "intensity": (INTENSITY,), "shape": ()}
WANTED: dict[Channel, str] = {
    "colors": "wanted scans with colorRed colorGreen colorBlue",
    "intensity": "wanted scans with intensity",
    "shape": "wanted scans with points",
}
KINDS = {
    "spherical": "sphericalRepresentation",
    "pinhole": "pinholeRepresentation",
    "cylindrical": "cylindricalRepresentation",
    "visual-reference": "visualReferenceRepresentation",
}
SUFFIX = {"jpeg": ".jpg", "png": ".png"}
# first bytes of an image file
ENCODINGS = {"jpeg": b"\xff\xd8\xff", "png": b"\x89PNG\r\n\x1a\n"}
MAX_IMAGE_SIDE = 1 << 20  # [px]


@dataclass(frozen=True)
class E57Scan:
    """One scan of a file."""

    index: int  # in the file's data3D
    label: str  # for messages
    num_points: int
    coordinates: tuple[str, ...]  # CARTESIAN or SPHERICAL
    channels: tuple[str, ...]  # COLORS, or INTENSITY alone, or empty
    invalid: tuple[str, ...]  # the fields of INVALID that the scan has
    color_ranges: tuple[tuple[float, float], ...]  # black and full brightness by channel; empty: no colours
    pose: Pose | None  # of the scanner, as a camera's


class _UnusableError(Exception):
    """A scan is intact but can't be used; the message is what follows its label."""


def open_e57(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of all scans of an E57 file that have colours, or another channel.

    Points with an invalid state (direction only, or nothing) or an invalid colour are left out. The range of
    colours is the scan's colorLimits, or else that which the field declares. A declared range of 16 bits or
    more may be wider than the values: then the values decide, as in all formats. If only some scans have the
    channel, the others are left out, with a warning.
    """
    with open_file(path) as file:
        scans, left_out = _scans(file, CHANNELS[channel])
        notes = _set_ranges(file, scans, options)
        crs = file.root.findtext("coordinateMetadata", "")[: reader.MAX_CRS_LENGTH]
    if not scans:
        error = InputError if channel == "shape" else MissingChannelError
        raise error(f"{path}: {left_out[0] if left_out else 'no scans'}, {WANTED[channel]}")
    num_points = sum(scan.num_points for scan in scans)
    source = reader.make_source(path, partial(_read, path, scans), channel, options, num_points)
    poses = [scan.pose for scan in scans if scan.pose is not None]
    # an identity is no scanner's pose: programs write it if they know none
    placed = [p for p in poses if not np.array_equal(p.R_cam_from_world, np.eye(3)) or p.center_world.any()]
    return source._replace(
        warnings=(*(f"{path}: {what}; left out" for what in left_out), *notes),
        station_axes=tuple(pose.R_cam_from_world[2] for pose in placed),
        unit_note=describe_foreign(units_of_wkt(crs)) if options.scale is None else "",
    )


def _scans(file: E57File, channels: tuple[str, ...]) -> tuple[list[E57Scan], list[str]]:
    """Return the scans that have the channels, and the reasons for leaving out others."""
    elements = file.root.findall("data3D/*")
    scans: list[E57Scan] = []
    left_out: list[str] = []
    for index, element in enumerate(elements):
        label = f"scan {index + 1} of {len(elements)} ({_text(element, 'name')[:40]!r})"
        try:
            scans.append(_scan(file, element, channels, index, label))
        except _UnusableError as reason:
            left_out.append(f"{label} {reason}")
    return scans, left_out


def _scan(file: E57File, element: Element, channels: tuple[str, ...], index: int, label: str) -> E57Scan:
    """Return the description of a scan. Raise _UnusableError if it can't be used."""
    points = element.find("points")
    prototype = element.find("points/prototype")
    if points is None or prototype is None or points.get("type") != "CompressedVector":
        raise _UnusableError("has no points")
    num_points = parse_integer(file.path, points.get("recordCount", "0"))
    if num_points <= 0:
        raise _UnusableError(f"has {num_points} points")
    fields = {field.tag: field for field in prototype}
    coordinates = next((names for names in (CARTESIAN, SPHERICAL) if fields.keys() >= set(names)), None)
    if coordinates is None:
        raise _UnusableError("has neither cartesian nor spherical coordinates")
    if not fields.keys() >= set(channels):
        raise _UnusableError("has no colours" if channels == COLORS else "has no intensity")
    num_bits = sum(_num_bits(file.path, field) for field in prototype.iter())
    if num_bits == 0 or num_points * num_bits > 8 * file.size:
        found = f"promises {num_points} points of {num_bits} bits, found a file of {file.size} bytes"
        raise InputError(f"{file.path}: {label} {found}; it is broken")
    invalid = tuple(INVALID[some] for some in (coordinates, channels) if INVALID.get(some) in fields)
    ranges = tuple(_color_range(file.path, element, fields[name]) for name in channels if name != INTENSITY)
    pose = e57_file.pose_of(file.path, element)
    return E57Scan(index, label, num_points, coordinates, channels, invalid, ranges, pose)


def _num_bits(path: Path, field: Element) -> int:
    """Return the least number of bits that a field takes in a record."""
    type_ = field.get("type")
    if type_ == "Float":
        return 32 if field.get("precision") == "single" else 64
    if type_ in ("Integer", "ScaledInteger"):
        low = parse_integer(path, field.get("minimum", str(-(1 << 63))))
        high = parse_integer(path, field.get("maximum", str((1 << 63) - 1)))
        return max(high - low, 0).bit_length()
    return 0


def _color_range(path: Path, element: Element, field: Element) -> tuple[float, float]:
    """Return a channel's values of black and of full brightness; both equal if the values must decide."""
    name = field.tag
    low = read_number(path, element, f"colorLimits/{name}Minimum")
    high = read_number(path, element, f"colorLimits/{name}Maximum")
    if low is not None and high is not None and low < high:
        return low, high
    declared = [field.get(end) for end in ("minimum", "maximum")]
    if None in declared:
        return OPEN.get(field.get("type", ""), WIDE_RANGES)
    first, last = (e57_file.read_scaled(path, field, text or "") for text in declared)
    if not first < last:
        raise _UnusableError(f"has colours without a range: {name} is declared {first:g} to {last:g}")
    return (first, last) if last < RANGES[-1] else OPEN.get(field.get("type", ""), WIDE_RANGES)


def _set_ranges(file: E57File, scans: list[E57Scan], settings: CloudSettings) -> tuple[str, ...]:
    """Replace, in the list, scans whose colours have an open range by those with one; return warnings."""
    notes: list[str] = []
    for k, scan in enumerate(scans):
        usual = next((high for low, high in scan.color_ranges if low == high), None)
        if not scan.color_ranges or (usual is None and settings.color_range is None):
            continue

        def read(scan: E57Scan = scan) -> Iterator[reader.Part]:
            for columns in _read_scan(file, scan):
                values = np.stack([columns[name] for name in COLORS], axis=1)
                yield values, values

        brightest, found = reader.find_brightest(file.path, read(), settings, usual or RANGES[-1])
        scans[k] = replace(scan, color_ranges=((0.0, brightest),) * len(COLORS))
        notes += found
    return tuple(dict.fromkeys(notes))


def _read(path: Path, scans: list[E57Scan]) -> Iterator[reader.Part]:
    """Yield the valid points (N, 3) of each scan, in the world, and their colours or intensity."""
    with open_file(path) as file:
        for scan in scans:
            for columns in _read_scan(file, scan):
                is_valid = np.ones(len(columns[scan.coordinates[0]]), dtype=np.bool_)
                for name in scan.invalid:
                    is_valid &= columns[name] == 0
                kept = {name: column[is_valid] for name, column in columns.items()}
                a, b, c = (kept[name] for name in scan.coordinates)
                with np.errstate(over="ignore", invalid="ignore"):  # broken points may be infinite
                    if scan.coordinates == SPHERICAL:
                        a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
                    points = np.stack([a, b, c], axis=1)
                    if scan.pose is not None:
                        R_world_from_scan = scan.pose.R_cam_from_world.T
                        points = rotate_points(points, R_world_from_scan) + scan.pose.center_world
                yield points, _colors(path, scan, kept) if scan.color_ranges else kept.get(INTENSITY, points)


def _colors(path: Path, scan: E57Scan, columns: dict[str, Array]) -> Bytes:
    """Return the colours (N, 3), scaled from the file's range to 0-255."""
    values = np.stack([columns[name] for name in COLORS], axis=1)
    low, high = np.array(scan.color_ranges).T
    with np.errstate(over="ignore", invalid="ignore"):
        brightness = (values - low) * (255.0 / (high - low))
    is_wrong = ~((brightness >= -COLOR_TOLERANCE) & (brightness <= 255.0 + COLOR_TOLERANCE))
    if is_wrong.any():
        i, k = np.argwhere(is_wrong)[0]
        wanted = f"wanted {low[k]:g} to {high[k]:g} as the file declares"
        raise InputError(f"{path}: {scan.label} has a colour of {values[i, k]:g}, {wanted}")
    colors: Bytes = np.rint(brightness).astype(np.uint8)
    return colors


def _read_scan(file: E57File, scan: E57Scan) -> Iterator[dict[str, Array]]:
    """Yield the columns of a scan, a chunk at a time; the next chunk overwrites the arrays."""
    names = (*scan.coordinates, *scan.channels, *scan.invalid)
    columns = {name: np.empty(min(scan.num_points, POINTS_A_CHUNK)) for name in names}
    buffers = file.libe57.VectorSourceDestBuffer()
    num_read = 0
    count = 1
    with refusing(file.path, file.libe57):
        for name, room in columns.items():
            buffers.append(file.libe57.SourceDestBuffer(file.image_file, name, room, len(room), True, True))
        compressed = file.image_file.root()["data3D"][scan.index]["points"].reader(buffers)
        while num_read < scan.num_points and count > 0:
            count = compressed.read()
            num_read += count
            yield {name: column[:count] for name, column in columns.items()}
    compressed.close()
    if num_read != scan.num_points:
        counts = f"promises {scan.num_points} points, found {num_read}"
        raise InputError(f"{file.path}: {scan.label} {counts}; the file is broken")


class E57Image(NamedTuple):
    """One representation of one image of a file."""

    file_name: str  # of the file that tools/e57_images.py writes
    name: str
    kind: str  # a key of KINDS
    encoding: str  # a key of ENCODINGS
    size: int  # [byte]
    width: int  # [px]
    height: int  # [px]
    fov_deg: tuple[float, float] | None  # of a spherical image, across and down
    pose: Pose | None
    pinhole: tuple[float, ...]  # focal lengths and principal point [px] of a pinhole image, or empty
    scan_guid: str  # of the scan to which it belongs, or empty
    node: tuple[int, str, str]  # index in images2D, names of the representation and the blob


def list_images(path: Path) -> list[E57Image]:
    """Return the images of an E57 file, in the order of the file."""
    stem = re.sub(r"[^\w.-]", "_", path.stem)
    with open_file(path) as file:
        images = list(_images(file))
    names = [f"{stem}_{index}{SUFFIX[image.encoding]}" for index, image in enumerate(images)]
    return [image._replace(file_name=name) for image, name in zip(images, names, strict=True)]


def read_image(path: Path, index: int) -> bytes:
    """Return the JPEG or PNG file of the image at an index of `list_images`."""
    with open_file(path) as file:
        image = list(_images(file))[index]
        number, representation, blob = image.node
        with refusing(path, file.libe57):
            content = file.image_file.root()["images2D"][number][representation][blob].read_buffer().tobytes()
    if not content.startswith(ENCODINGS[image.encoding]):
        raise InputError(f"{path}: image {index} begins with {content[:8]!r}, wanted a {image.encoding} file")
    return bytes(content)


def _images(file: E57File) -> Iterator[E57Image]:
    """Yield those representations of the elements of images2D that contain an image file."""
    elements = enumerate(file.root.findall("images2D/*"))
    for (number, element), (kind, place), encoding in product(elements, KINDS.items(), ENCODINGS):
        representation = element.find(place)
        blob = element.find(f"{place}/{encoding}Image")
        if representation is None or blob is None or blob.get("type") != "Blob":
            continue
        size = parse_integer(file.path, blob.get("length", ""))
        if not 0 < size <= file.size:  # libE57 allocates it
            found = f"promises {size} bytes, found a file of {file.size} bytes"
            raise InputError(f"{file.path}: image {number} {found}; it is broken")
        width = _side(file.path, representation, "imageWidth")
        height = _side(file.path, representation, "imageHeight")
        across = read_number(file.path, representation, "pixelWidth")
        down = read_number(file.path, representation, "pixelHeight")
        fov_deg = None
        if kind == "spherical" and across is not None and down is not None:
            fov_deg = math.degrees(across * width), math.degrees(down * height)
        yield E57Image(
            file_name="",
            name=_text(element, "name"),
            kind=kind,
            encoding=encoding,
            size=size,
            width=width,
            height=height,
            fov_deg=fov_deg,
            pose=e57_file.pose_of(file.path, element),
            pinhole=_pinhole(file.path, representation, across or 0.0, down or 0.0),
            scan_guid=_text(element, "associatedData3DGuid"),
            node=(number, place, f"{encoding}Image"),
        )


def _pinhole(path: Path, representation: Element, across: float, down: float) -> tuple[float, ...]:
    """Return fx, fy, cx, cy [px] of a pinhole image; empty if its focal length or a pixel size is missing.

    `across` and `down` [m] are the width and the height of a pixel.
    """
    names = "focalLength", "principalPointX", "principalPointY"
    focal, *center = (read_number(path, representation, name) or 0.0 for name in names)
    return (focal / across, focal / down, *center) if min(focal, across, down) > 0.0 else ()


def _text(element: Element, place: str) -> str:
    return element.findtext(place, "").strip()


def _side(path: Path, representation: Element, name: str) -> int:
    value = read_number(path, representation, name) or 0.0
    if not 0 < value <= MAX_IMAGE_SIDE:
        raise InputError(f"{path}: an image's {name} is {value:g}, wanted 1 to {MAX_IMAGE_SIDE}")
    return int(value)
