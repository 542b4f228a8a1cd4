"""What EXIF says of a photo's lens and of how the camera was held; what is damaged counts as not said.

The focal length in pixels, from the more exact of two:
- FocalLength with FocalPlaneXResolution and its unit, at the size at which the picture was taken;
- FocalLengthIn35mmFilm, the focal length that shows the same angle over the diagonal of 36 x 24 mm, 43.27 mm,
  as CIPA DCG-001 defines it: a phone's 4:3 picture is compared with film of 3:2, so widths can't be.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, SupportsFloat, cast

from PIL.ExifTags import Base

FILM_DIAGONAL = math.hypot(36.0, 24.0)  # [mm]
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of FocalPlaneResolutionUnit; 2 where it is missing
MIN_FILM, MAX_FILM = 8.0, 800.0  # [mm] what is wider is no photo by a plain lens
BREATHING, ZOOMING = 0.01, 0.03  # of a focal length: what focusing changes, and what a zoom rounds
MAX_DISAGREEMENT = 0.25  # of the two: one of them is of the picture before it was cropped
CAMERA_ELEVATION = 0x9405  # CameraElevationAngle of EXIF 2.31 [deg]


class ExifFocal(NamedTuple):
    """A focal length, and where it comes from."""

    focal: float  # [px]
    deviation: float  # standard deviation of its logarithm
    source: str  # in words


def focal_of(exif: Mapping[int, object], size: tuple[int, int]) -> ExifFocal | None:
    """The focal length of a picture of this size [px]; None if EXIF does not say, or what can't be."""
    diagonal = math.hypot(*size)
    film = _number(exif, Base.FocalLengthIn35mmFilm)
    film = film if film and MIN_FILM <= film <= MAX_FILM else None
    plane = _focal_by_plane(exif, size)
    if plane and not MIN_FILM <= plane / diagonal * FILM_DIAGONAL <= MAX_FILM:
        plane = None
    if plane and film and abs(plane / diagonal * FILM_DIAGONAL / film - 1.0) > MAX_DISAGREEMENT:
        plane = None
    lens = ZOOMING if _is_zoom(exif) else BREATHING
    if plane:
        return ExifFocal(plane, lens, "EXIF's focal length and the resolution of its sensor")
    if film:
        rounding = 1.0 / math.sqrt(12.0) / film  # whole millimetres
        focal = film / FILM_DIAGONAL * diagonal
        return ExifFocal(focal, math.hypot(lens, rounding), f"EXIF's 35 mm equivalent of {film:g} mm")
    return None


def _is_zoom(exif: Mapping[int, object]) -> bool:
    """True if the lens has several focal lengths, or a part of the picture was enlarged."""
    lens = exif.get(Base.LensSpecification)
    has_range = isinstance(lens, tuple) and len(lens) > 1 and lens[0] != lens[1]
    return has_range or (_number(exif, Base.DigitalZoomRatio) or 1.0) > 1.0


def _focal_by_plane(exif: Mapping[int, object], size: tuple[int, int]) -> float | None:
    """Focal length [px] by the pixels of the sensor, of which the picture may be a smaller copy."""
    focal, per_unit = _number(exif, Base.FocalLength), _number(exif, Base.FocalPlaneXResolution)
    unit = MM_PER_UNIT.get(int(_number(exif, Base.FocalPlaneResolutionUnit) or 2))
    if not (focal and per_unit and unit):
        return None
    sides = _number(exif, Base.ExifImageWidth), _number(exif, Base.ExifImageHeight)
    taken = max(side or 0.0 for side in sides) or max(size)
    return focal * per_unit / unit * max(size) / taken


def elevation_deg(exif: Mapping[int, object]) -> float | None:
    """Elevation of the image centre above the horizon [deg]; None if EXIF does not say."""
    value = _number(exif, CAMERA_ELEVATION, least=-90.0)
    return value if value is None or value <= 90.0 else None


def _number(exif: Mapping[int, object], tag: int, least: float = 0.0) -> float | None:
    """The finite number in a tag; None if it is missing, no number or less than `least`."""
    try:
        value = float(cast(SupportsFloat, exif[tag]))
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if math.isfinite(value) and value >= least else None
