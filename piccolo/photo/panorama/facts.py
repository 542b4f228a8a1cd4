"""Facts in a photo's file besides its pixels: digest, size, time, place, focal length, elevation.

Damaged fields count as missing. The focal length in pixels is by the first of these that is plausible:
- FocalLength with FocalPlaneXResolution and its unit, at the size at which the picture was taken;
- FocalLengthIn35mmFilm, the focal length that shows the same angle over the diagonal of 36 x 24 mm, 43.27 mm,
  as CIPA DCG-001 defines it. Diagonals are compared, as a phone's 4:3 picture is not as wide as film of 3:2.
  For a picture of another shape, such as 16:9, some cameras use its own diagonal, others the whole sensor's.
"""

import hashlib
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat, cast

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from ...system.arrays import Bytes
from ...system.errors import InputError
from ...system.files.cache import sha256_of_arrays
from ...system.files.json_file import read_bytes, reading_once
from ..camera import Calibration
from ..photo import File, Photo, as_photo
from .cube import face_paths
from .gpano import ASPECT_TOLERANCE
from .picture import PNG_MAGIC, WANTED, open_picture

TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)")
OFFSET = re.compile(r"[+-]\d\d:\d\d")
DEGREE_PARTS = 1.0, 60.0, 3600.0  # degrees, minutes, seconds
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # [mm]
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # by FocalPlaneResolutionUnit, which is 2 if missing
MIN_FILM = 8.0  # [mm] on film: shorter focal lengths are not of a plain lens
MAX_FILM = 800.0  # [mm] nor are longer ones
BREATHING = 0.01  # relative error of a focal length by focusing
ZOOMING = 0.03  # the same of a zoom lens, whose focal length is rounded
SENSOR_SHAPES = 4 / 3, 3 / 2  # usual ratios of width to height
MAX_DISAGREEMENT = 0.25  # relative, of both focal lengths; beyond, the picture was cropped
CAMERA_ELEVATION = 0x9405  # CameraElevationAngle of EXIF 2.31 [deg]


class GpsPosition(NamedTuple):
    """Position by the camera's GPS receiver, in WGS 84."""

    latitude_deg: float
    longitude_deg: float
    accuracy: float | None  # [m] horizontal; None if the file does not name it


class PhotoFacts(NamedTuple):
    """Facts in a photo's file besides its pixels."""

    # digest of the file; for several files, of their digests, one a line, in the order of FACE_LETTERS or rig
    sha256: str
    image_size: tuple[int, int]  # width and height [px] as stored, of the first of several files
    capture_time: str | None  # ISO 8601, with the offset from UTC if the file has it
    gps: GpsPosition | None


def sha256_of(path: Path, rig: Calibration | None = None) -> str | None:
    """Return the digest of a photo's file or files, whatever they contain; None if they can't be read."""
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


def read_photo_facts(photo: File | Bytes | Photo) -> PhotoFacts:
    """Return the facts in a photo's file, or in the first file of a folder of cube faces or of a rig.

    For an array (H, W, 3) these are digest and size. Damaged metadata count as missing. Raise InputError if
    the file is missing or is not a picture.
    """
    photo = as_photo(photo)
    if isinstance(photo.picture, np.ndarray):
        height, width = photo.picture.shape[:2]
        return PhotoFacts(sha256_of_arrays(photo.picture), (width, height), None, None)
    files = _files_of(photo.path, photo.instant)
    with reading_once(), open_picture(files[0], content := read_bytes(files[0], WANTED)) as image:
        exif: Mapping[int, Any]
        try:
            if chunk := _exif_chunk(content):
                image.info["exif"] = chunk
            own = Image.Image.getexif(image)  # PngImageFile's own decodes the whole picture
            exif = own.get_ifd(IFD.Exif)
            gps = own.get_ifd(IFD.GPSInfo)
        except Exception:  # Pillow raises errors of many kinds for damaged metadata
            exif = {}
            gps = {}
        return PhotoFacts(_digest(files), image.size, _capture_time(exif), _gps_position(gps))


def _exif_chunk(content: bytes) -> bytes:
    """Return the EXIF in a PNG file, before or after its pixels; empty without, or for another file."""
    begin = len(PNG_MAGIC) if content.startswith(PNG_MAGIC) else len(content)
    while begin + 8 <= len(content):
        end = begin + 8 + int.from_bytes(content[begin : begin + 4])
        if content[begin + 4 : begin + 8] == b"eXIf":
            return content[begin + 8 : end]
        begin = end + 4  # after its checksum
    return b""


def _capture_time(exif: Mapping[int, Any]) -> str | None:
    """Return the time at which the picture was taken, by the camera's clock; None if it is missing."""
    parts = TIME.fullmatch(str(exif.get(Base.DateTimeOriginal, "")).strip("\0 "))
    if not parts:
        return None
    year, month, day, clock = parts.groups()
    digits = re.sub(r"\D", "", str(exif.get(Base.SubsecTimeOriginal, "")))[:6]
    offset = OFFSET.fullmatch(str(exif.get(Base.OffsetTimeOriginal, "")).strip("\0 "))
    time = f"{year}-{month}-{day}T{clock}" + (f".{digits}" if digits else "") + (offset[0] if offset else "")
    with suppress(ValueError):  # a clock that was not set writes zeros
        datetime.fromisoformat(time)
        return time
    return None


def _gps_position(gps: Mapping[int, Any]) -> GpsPosition | None:
    """Return the position at which the picture was taken; None if it is missing or impossible."""
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
    """Convert degrees, minutes and seconds to degrees, positive for the first of two letters."""
    sign = {letters[0]: 1.0, letters[1]: -1.0}[str(reference).strip("\0 ").upper()]
    return sign * sum(float(part) / unit for part, unit in zip(parts, DEGREE_PARTS, strict=False))


class ExifFocal(NamedTuple):
    """A focal length, and its source."""

    focal: float  # [px]
    deviation: float  # standard deviation of its logarithm
    source: str  # for messages


def read_focal_length(exif: Mapping[int, object], size: tuple[int, int]) -> ExifFocal | None:
    """Return the focal length by EXIF of a picture of this size [px]; None if missing or impossible."""
    diagonal = math.hypot(size[0], size[1])
    film = _number(exif, Base.FocalLengthIn35mmFilm)
    film = film if film and MIN_FILM <= film <= MAX_FILM else None
    plane = _focal_by_plane(exif, size)
    if plane and not MIN_FILM <= plane / diagonal * FILM_DIAGONAL <= MAX_FILM:
        plane = None
    if plane and film and abs(plane / diagonal * FILM_DIAGONAL / film - 1.0) > MAX_DISAGREEMENT:
        plane = None
    range_ = exif.get(Base.LensSpecification)
    is_zoom = isinstance(range_, tuple) and len(range_) > 1 and range_[0] != range_[1]
    is_enlarged = (_number(exif, Base.DigitalZoomRatio) or 1.0) > 1.0
    lens = ZOOMING if is_zoom or is_enlarged else BREATHING
    if plane:
        return ExifFocal(plane, lens, "EXIF's focal length and the resolution of its sensor")
    if film:
        rounding = 1.0 / math.sqrt(12.0) / film  # whole millimetres
        source = f"EXIF's 35 mm equivalent of {film:g} mm"
        focal = film / FILM_DIAGONAL * diagonal
        cut = film / FILM_DIAGONAL * _largest_diagonal(size)
        if cut == focal:
            return ExifFocal(focal, math.hypot(lens, rounding), source)
        source += f" ({focal:.0f} px for this shape of sensor, up to {cut:.0f} if a larger one was cut)"
        deviation = math.hypot(lens, rounding, math.log(cut / focal) / 2.0)
        return ExifFocal(math.sqrt(focal * cut), deviation, source)
    return None


def _largest_diagonal(size: tuple[int, int]) -> float:
    """Return the diagonal [px] of the largest usual sensor from which a picture may have been cut.

    The picture has the sensor's whole width or height. If its shape is usual, it is the sensor's.
    """
    longer = max(size)
    shorter = min(size)
    if any(abs(longer / shorter / shape - 1.0) <= ASPECT_TOLERANCE for shape in SENSOR_SHAPES):
        return math.hypot(size[0], size[1])
    sensors = [(max(longer, shorter * shape), max(shorter, longer / shape)) for shape in SENSOR_SHAPES]
    return max(math.hypot(*sensor) for sensor in sensors)


def _focal_by_plane(exif: Mapping[int, object], size: tuple[int, int]) -> float | None:
    """Return the focal length [px] by the sensor's resolution, or None; the picture may be a smaller copy."""
    focal = _number(exif, Base.FocalLength)
    per_unit = _number(exif, Base.FocalPlaneXResolution)
    unit = MM_PER_UNIT.get(int(_number(exif, Base.FocalPlaneResolutionUnit) or 2))
    if not (focal and per_unit and unit):
        return None
    sides = _number(exif, Base.ExifImageWidth), _number(exif, Base.ExifImageHeight)
    taken = max(side or 0.0 for side in sides) or max(size)
    return focal * per_unit / unit * max(size) / taken


def elevation_deg(exif: Mapping[int, object]) -> float | None:
    """Return the elevation of the image centre above the horizon [deg]; None if EXIF has none."""
    value = _number(exif, CAMERA_ELEVATION, least=-90.0)
    return value if value is None or value <= 90.0 else None


def _number(exif: Mapping[int, object], tag: int, least: float = 0.0) -> float | None:
    """Return the finite number in a tag; None if it is missing, not a number, or less than `least`."""
    try:
        value = float(cast(SupportsFloat, exif[tag]))
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if math.isfinite(value) and value >= least else None
