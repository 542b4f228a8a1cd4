"""What a photo's file says of itself beside its pixels: a digest, its size, when and where it was taken."""

import hashlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from ..camera import Calibration
from ..cloud.digest import sha256_of_arrays
from ..errors import InputError
from ..files.json_file import read_bytes, reading_once
from .cube import face_paths
from .picture import PNG_MAGIC, WANTED, opened

TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)")
OFFSET = re.compile(r"[+-]\d\d:\d\d")
DEGREE_PARTS = 1.0, 60.0, 3600.0  # degrees, minutes, seconds


class GpsPosition(NamedTuple):
    """Where a receiver in the camera was, on the WGS 84 ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    accuracy: float | None  # [m] horizontal, None if the file does not say


class Photo(NamedTuple):
    """A photo's file without its pixels."""

    sha256: str  # of the file; of several, of their digests in the order of FACE_LETTERS or rig, one a line
    image_size: tuple[int, int]  # width and height [px], as stored; of several the first
    capture_time: str | None  # ISO 8601, with the offset from UTC if the file has it
    gps: GpsPosition | None


def sha256_of(path: Path, rig: Calibration | None = None) -> str | None:
    """Digest of a photo's file or files, whether they are pictures or not; None where they can't be read."""
    try:
        return _digest(_files_of(path, rig))
    except (OSError, InputError):
        return None


def _files_of(path: Path, rig: Calibration | None) -> list[Path]:
    if rig is not None:
        return rig.images_in(path)
    return list(face_paths(path).values()) if path.is_dir() else [path]


def _digest(files: list[Path]) -> str:
    digests = [hashlib.sha256(read_bytes(file, WANTED)).hexdigest() for file in files]
    return digests[0] if len(files) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def photo_of(path: Path, rig: Calibration | None = None) -> Photo:
    """What a photo's file, or the first of a folder of cube faces or of a rig's pictures, says of itself.

    Raises
    ------
    InputError
        The file is missing or no picture. Metadata that are damaged count as missing.
    """
    files = _files_of(path, rig)
    with reading_once(), opened(files[0], content := read_bytes(files[0], WANTED)) as image:
        exif: Mapping[int, Any]
        try:
            if chunk := _exif_chunk(content):
                image.info["exif"] = chunk
            own = Image.Image.getexif(image)  # that of PngImageFile decodes the picture to find the chunk
            exif, gps = own.get_ifd(IFD.Exif), own.get_ifd(IFD.GPSInfo)
        except Exception:  # Pillow raises whatever damaged metadata bring
            exif, gps = {}, {}
        return Photo(_digest(files), image.size, _capture_time(exif), _gps_position(gps))


def _exif_chunk(content: bytes) -> bytes:
    """The EXIF in a PNG file, before or behind the pixels; empty if there is none, or for another file."""
    begin = len(PNG_MAGIC) if content.startswith(PNG_MAGIC) else len(content)
    while begin + 8 <= len(content):
        end = begin + 8 + int.from_bytes(content[begin : begin + 4])
        if content[begin + 4 : begin + 8] == b"eXIf":
            return content[begin + 8 : end]
        begin = end + 4  # behind its checksum
    return b""


def photo_of_array(rgb: NDArray[np.uint8]) -> Photo:
    """The same of pixels (H, W, 3): their digest and size."""
    height, width = rgb.shape[:2]
    return Photo(sha256_of_arrays(rgb), (width, height), None, None)


def _capture_time(exif: Mapping[int, Any]) -> str | None:
    """When the picture was taken, by the camera's clock."""
    found = TIME.fullmatch(str(exif.get(Base.DateTimeOriginal, "")).strip("\0 "))
    if not found:
        return None
    year, month, day, clock = found.groups()
    digits = re.sub(r"\D", "", str(exif.get(Base.SubsecTimeOriginal, "")))[:6]
    offset = OFFSET.fullmatch(str(exif.get(Base.OffsetTimeOriginal, "")).strip("\0 "))
    return f"{year}-{month}-{day}T{clock}" + (f".{digits}" if digits else "") + (offset[0] if offset else "")


def _gps_position(gps: Mapping[int, Any]) -> GpsPosition | None:
    """Where the picture was taken; None if the file does not say, or says what can't be."""
    try:
        latitude = _degrees(gps[GPS.GPSLatitude], gps[GPS.GPSLatitudeRef], "NS")
        longitude = _degrees(gps[GPS.GPSLongitude], gps[GPS.GPSLongitudeRef], "EW")
        accuracy = float(gps.get(GPS.GPSHPositioningError, math.nan))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    is_possible = abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and (latitude, longitude) != (0.0, 0.0)
    if not is_possible:
        return None
    return GpsPosition(latitude, longitude, accuracy if 0.0 < accuracy < math.inf else None)


def _degrees(parts: Any, reference: str, letters: str) -> float:
    """Degrees from degrees, minutes and seconds, positive for the first letter."""
    sign = {letters[0]: 1.0, letters[1]: -1.0}[str(reference).strip("\0 ").upper()]
    return sign * sum(float(part) / unit for part, unit in zip(parts, DEGREE_PARTS, strict=False))
