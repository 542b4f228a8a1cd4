"""Google's Photo Sphere XMP: the part of the sphere that a picture shows, and the camera's attitude.

https://developers.google.com/streetview/spherical-metadata. The few fields are searched in the text, as
attributes and as elements, without an XML parser: no entities are expanded, and in damaged XML only damaged
fields are lost. Crops are embedded in the full sphere here. A pose is written into a JPEG as text too, so
that all that other programs wrote stays as it is.
"""

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ...geometry.pose import DECIMALS, R_cam_from_angles
from ...system.arrays import Array, Bytes, Mask
from ...system.errors import InputError
from .panorama import GPano
from .picture import MAX_PICTURE_WIDTH, SPHERE_NAMESPACE as NAMESPACE, open_picture

PREFIX = re.compile(rb"xmlns:([A-Za-z_][\w.-]{0,40})\s{0,9}=\s{0,9}[\"']" + re.escape(NAMESPACE))
FIELD = rb"\b%s:(\w{1,60})(?:\s{0,9}=\s{0,9}[\"']([^\"'<>]{0,80})[\"']|\s{0,9}>([^<>]{0,80})</)"
MAX_GPANO_NUMBER = 1e9
MAX_PREFIXES = 4  # of the namespace that are searched
CROP_NAMES = "CroppedAreaLeft CroppedAreaTop CroppedAreaImageWidth CroppedAreaImageHeight"
CROP_FIELDS = tuple(f"{name}Pixels" for name in f"{CROP_NAMES} FullPanoWidth FullPanoHeight".split())
ASPECT_TOLERANCE = 0.01  # relative, of a picture's width to height
MIN_STRIP = 2.0 * (1.0 + ASPECT_TOLERANCE)  # width to height: a wider picture is no whole sphere
MIN_REGION = 0.02  # of the sphere's picture: smaller pictures would take much memory for little
JPEG_MAGIC = b"\xff\xd8"
APP0 = 0xE0
APP1 = 0xE1
SCAN = 0xDA
MARKER = re.compile(rb"\xff+")
EXIF_MARK, XMP_MARK = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"
MAX_BODY_SIZE = 0xFFFF - 2
POSE_NAMES = ("PoseHeadingDegrees", "PosePitchDegrees", "PoseRollDegrees")
END = re.compile(rb"</([A-Za-z_][\w.-]{0,40}):RDF\s{0,9}>")
ABOUT = re.compile(rb":about\s{0,9}=\s{0,9}(\"[^\"<]{0,999}\"|'[^'<]{0,999}')")
# the rest of a description that contained nothing but the pose
LEFTOVER = re.compile(
    rb"<[\w.-]{1,40}:Description [\w.-]{1,40}:about=(\"[^\"<]{0,999}\"|'[^'<]{0,999}') xmlns:GPano=\""
    + re.escape(NAMESPACE)
    + rb"\"/>"
)
EMPTY_PACKET = (
    b'<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    b'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"></rdf:RDF></x:xmpmeta>'
    b'<?xpacket end="w"?>'
)

Pixels = tuple[Bytes, Mask]  # rgb (H, W, 3), is_valid (H, W)


@dataclass(frozen=True)
class CropRegion:
    """The part of the sphere that a picture shows, as fractions of the full width and height."""

    left: float = 0.0
    top: float = 0.0
    width: float = 1.0
    height: float = 1.0

    @property
    def is_full(self) -> bool:
        """True for the whole sphere."""
        return self == CropRegion()


def gpano_fields(xmp: bytes) -> dict[str, str]:
    """Return the Photo Sphere fields in an XMP packet: texts by names without their prefix."""
    fields: dict[str, str] = {}
    for prefix in list(dict.fromkeys(PREFIX.findall(xmp)))[:MAX_PREFIXES]:
        for name, attribute, element in re.findall(FIELD % re.escape(prefix), xmp):
            text = (attribute or element).decode("utf-8", "replace").strip()
            fields.setdefault(name.decode("ascii", "replace"), text)
    return fields


def _number(fields: dict[str, str], name: str, largest: float = MAX_GPANO_NUMBER) -> float | None:
    """Return the number in a field; None if it is missing, not a finite number, or out of range."""
    try:
        value = float(fields[name])
    except (KeyError, ValueError):
        return None
    return value if abs(value) <= largest else None  # not so for NaN


def attitude(fields: dict[str, str]) -> GPano:
    """Return the pitch and roll in the fields; a value out of range counts as missing."""
    return GPano(_number(fields, "PosePitchDegrees", 90.0), _number(fields, "PoseRollDegrees", 180.0))


def crop_region(fields: dict[str, str], aspect: float) -> CropRegion | None:
    """Return the part of the sphere that a picture of `aspect` (width / height) shows.

    Without fields this is the whole sphere. The fields are in pixels of the original picture; only their
    ratios are used, so that a picture that was resized later is placed right. Some phones write a strip's own
    height as that of the sphere: its middle is then put on the horizon. Return None if the fields make no
    sense, or are those of a picture of another shape.
    """
    if not fields.keys() & set(CROP_FIELDS):
        return CropRegion()
    numbers = _crop_numbers(fields)
    if numbers is None:
        return None
    left, top, width, height, full_width, full_height = numbers
    if lacks_horizon(fields):
        full_height = full_width / 2.0
        top = (full_height - height) / 2.0
    is_inside = width <= full_width and -1.0 <= top <= full_height - height + 1.0 and abs(left) <= full_width
    # within 1.5 pixels, for rounding, or within one per cent
    is_same_shape = abs(width / height / aspect - 1.0) <= max(0.01, 1.5 / width, 1.5 / height)
    if not (is_inside and is_same_shape):
        return None
    return CropRegion(left / full_width, top / full_height, width / full_width, height / full_height)


def _crop_numbers(fields: dict[str, str]) -> list[float] | None:
    """Return the numbers of CROP_FIELDS; None if one is missing or makes no sense."""
    numbers = [number for name in CROP_FIELDS if (number := _number(fields, name)) is not None]
    return numbers if len(numbers) == len(CROP_FIELDS) and min(numbers[2:]) >= 1.0 else None


def lacks_horizon(fields: dict[str, str]) -> bool:
    """Return True if the fields give the crop's height as the sphere's, so that its horizon is unknown."""
    numbers = _crop_numbers(fields)
    if numbers is None:
        return False
    *_, height, full_width, full_height = numbers
    return full_height == height and full_width > MIN_STRIP * height


def rotation_to_level(gpano: GPano) -> Array | None:
    """Return R_level_from_cam (3, 3) from pitch and roll; None if both are missing; one missing is 0.

    `x_level = R_level_from_cam @ x_cam`; both frames have +x towards the image centre, +y left, +z up, level
    with z against gravity and x at the heading. Google's reference: pitch is the image centre's elevation
    above the horizon, and as roll grows the horizon turns counterclockwise in the image, so the camera's
    right side goes down. Euler angles are taken in the order heading, pitch, roll about its own axes:
    R_level_from_cam = R_y(-pitch) R_x(roll).
    """
    if gpano.pitch_deg is None and gpano.roll_deg is None:
        return None
    return R_cam_from_angles(90.0, gpano.pitch_deg or 0.0, gpano.roll_deg or 0.0).T


def attitude_of_gravity(down_cam: tuple[float, float, float]) -> GPano:
    """Return pitch and roll of a camera from the direction of gravity (3,) in its axes.

    The axes are +x image centre, +y left, +z up. Up is the third row of R_level_from_cam:
    (sin pitch, cos pitch sin roll, cos pitch cos roll).
    """
    x, y, z = (-value for value in down_cam)
    across = math.hypot(y, z)
    roll = math.degrees(math.atan2(y, z)) if across > 0.0 else 0.0
    return GPano(math.degrees(math.atan2(x, across)), roll)


def region_of_fov(fov_deg: float, width: int, height: int) -> CropRegion:
    """Return the region of a picture centred on the horizon, with the same degrees per pixel both ways."""
    wide = fov_deg / 360.0  # fraction of the sphere's picture
    high = fov_deg / 180.0 * height / width
    return CropRegion((1.0 - wide) / 2.0, (1.0 - high) / 2.0, wide, high)


def full_size(path: Path, region: CropRegion, size: tuple[int, int]) -> tuple[int, int]:
    """Return width and height [px], 2:1, of the full sphere at the resolution of a picture of `size`.

    If the sphere is 2:1 only within 1 %, the direction with more pixels per degree is shrunk.

    Raise InputError if the region does not fit the picture, or the full sphere would be too large.
    """
    width = size[0] / region.width
    height = size[1] / region.height
    found = f"{path}: found {size[0]} x {size[1]}"
    if abs(width - 2.0 * height) > ASPECT_TOLERANCE * 2.0 * height:
        raise InputError(f"{found} of a sphere of {width:.0f} x {height:.0f}, wanted that width = 2 x height")
    if region.height > 1.0 + ASPECT_TOLERANCE:
        raise InputError(f"{found}, higher than the sphere at this field of view, wanted a smaller `fov_deg`")
    if width > MAX_PICTURE_WIDTH:
        raise InputError(f"{found} of a sphere {width:.0f} wide, wanted at most {MAX_PICTURE_WIDTH}")
    if region.width * region.height < MIN_REGION:
        percent = 100.0 * region.width * region.height
        raise InputError(f"{found}, {percent:.2g} % of the sphere, wanted at least {100.0 * MIN_REGION:g} %")
    full_height = int(min(height, width / 2.0) + 1e-6)  # a quotient may be rounded below a whole number
    return 2 * full_height, full_height


def embed_crop(path: Path, rgb: Bytes, is_valid: Mask, region: CropRegion) -> Pixels:
    """Return the full sphere with a picture at its region; all other pixels are not valid.

    The picture's edges are rounded to whole pixels, which moves it by half a pixel at most. It may cross the
    seam. A picture that is the full sphere is returned as it is.
    """
    height, width = is_valid.shape
    full_width, full_height = full_size(path, region, (width, height))
    left = round(region.left * full_width)
    top = max(round(region.top * full_height), 0)
    right = left + max(round(region.width * full_width), 1)
    bottom = min(top + max(round(region.height * full_height), 1), full_height)
    size = right - left, bottom - top
    if is_valid.shape != size[::-1]:  # area-averaged: a pixel is valid if all pixels in its average are
        mask = cv2.resize(is_valid.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        rgb = np.asarray(small, dtype=np.uint8)
        is_valid = np.asarray(mask == 255)
    if is_valid.shape == (full_height, full_width) and left % full_width == 0:
        return rgb, is_valid
    full_rgb = np.zeros((full_height, full_width, 3), dtype=np.uint8)
    full_valid = np.zeros((full_height, full_width), dtype=np.bool_)
    columns = np.arange(left, right) % full_width
    full_rgb[top:bottom, columns] = rgb
    full_valid[top:bottom, columns] = is_valid
    return full_rgb, full_valid


def check_size(label: str, size: tuple[int, int]) -> None:
    """Refuse a size (width, height) that is not 2:1, as a full sphere's is."""
    width, height = size
    if min(size) < 1 or abs(width - 2 * height) > ASPECT_TOLERANCE * 2 * height:
        raise InputError(f"{label}: found {width} x {height}, wanted width = 2 x height (a full sphere)")


class Segment(NamedTuple):
    """One segment of a JPEG: data[begin:end], including marker and length."""

    marker: int
    begin: int
    end: int


def with_pose(path: Path, data: bytes, angles_deg: tuple[float, float, float]) -> bytes:
    """Return the JPEG `data` with heading, pitch and roll in its XMP packet; other segments keep their bytes.

    Fields of an old pose are replaced. If there is no packet, one is put after the segments of JFIF and EXIF.
    """
    segments = list(jpeg_segments(data)) if data.startswith(JPEG_MAGIC) else []
    if not segments or segments[-1].marker != SCAN:
        raise InputError(f"{path}: no JPEG, or a damaged one; XMP can be written into a whole JPEG only")
    with open_picture(path, data) as image:
        size = image.size
    bodies = [data[begin + 4 : end] if marker == APP1 else b"" for marker, begin, end in segments]
    packets = [i for i, body in enumerate(bodies) if body.startswith(XMP_MARK)]
    edits = []  # begin, end, and the bytes that replace data[begin:end]
    for i in packets:
        packet = without_pose(bodies[i][len(XMP_MARK) :])
        if i == packets[0]:
            packet = _with_fields(path, packet, angles_deg, size)
        edits.append((segments[i].begin, segments[i].end, _segment(path, packet)))
    if not packets:
        pairs = zip(segments, bodies, strict=True)  # the segments of JFIF and EXIF must be the first
        first = takewhile(lambda pair: pair[0].marker == APP0 or pair[1].startswith(EXIF_MARK), pairs)
        place = max((segment.end for segment, _ in first), default=len(JPEG_MAGIC))
        edits = [(place, place, _segment(path, _with_fields(path, EMPTY_PACKET, angles_deg, size)))]
    pieces = []
    begin = 0
    for edit_begin, edit_end, new in edits:
        pieces += [data[begin:edit_begin], new]
        begin = edit_end
    return b"".join([*pieces, data[begin:]])


def jpeg_segments(data: bytes) -> Iterator[Segment]:
    """Yield the segments of a JPEG up to the header of its first scan; fewer if it is damaged."""
    begin = len(JPEG_MAGIC)
    while found := MARKER.match(data, begin):
        begin = found.end() - 1  # FF bytes may come before a marker
        if begin + 4 > len(data):
            return
        marker, length = struct.unpack_from(">xBH", data, begin)
        end = begin + 2 + length
        if length < 2 or end > len(data):
            return
        yield Segment(marker, begin, end)
        if marker == SCAN:
            return
        begin = end


def _segment(path: Path, packet: bytes) -> bytes:
    body = XMP_MARK + packet
    if len(body) > MAX_BODY_SIZE:
        raise InputError(f"{path}: its XMP leaves no room for the pose: with the pose it may have 64 KB")
    return struct.pack(">BBH", 0xFF, APP1, len(body) + 2) + body


def without_pose(packet: bytes) -> bytes:
    """Return the packet without the fields of a pose, whether these are attributes or elements."""
    for prefix in dict.fromkeys(PREFIX.findall(packet)):
        for name in POSE_NAMES:
            field = re.escape(prefix) + b":" + name.encode()
            packet = re.sub(rb"\s" + field + rb"\s{0,9}=\s{0,9}(\"[^\"<>]*\"|'[^'<>]*')", b"", packet)
            packet = re.sub(rb"<" + field + rb"\s{0,9}(/>|>[^<>]*</" + field + rb"\s{0,9}>)", b"", packet)
    return LEFTOVER.sub(b"", packet)


def _with_fields(
    path: Path, packet: bytes, angles_deg: tuple[float, float, float], size: tuple[int, int]
) -> bytes:
    """Return the packet with a description added: the pose, and fields that viewers need, if missing.

    A packet without the end of its RDF is damaged; a new packet replaces it.
    """
    if not END.search(packet):
        packet = EMPTY_PACKET
    *_, end = END.finditer(packet)
    names = [re.findall(re.escape(p) + rb":(\w{1,60})", packet) for p in set(PREFIX.findall(packet))]
    known = {name.decode() for some in names for name in some}
    fields = {} if "ProjectionType" in known else {"ProjectionType": "equirectangular"}
    if not known & set(CROP_FIELDS):
        check_size(f"{path}: without GPano's crop", size)
        fields |= {name: str(value) for name, value in zip(CROP_FIELDS, (0, 0, *size, *size), strict=True)}
    fields |= {n: f"{angle:.{DECIMALS}f}" for n, angle in zip(POSE_NAMES, angles_deg, strict=True)}
    attributes = "".join(f' GPano:{name}="{value}"' for name, value in fields.items()).encode()
    about = ABOUT.search(packet)  # must be the same in all descriptions
    rdf = end[1]
    place = end.start()
    description = b"<%s:Description %s:about=%s" % (rdf, rdf, about.group(1) if about else b'""')
    description += b' xmlns:GPano="%s"%s/>' % (NAMESPACE, attributes)
    return packet[:place] + description + packet[place:]
