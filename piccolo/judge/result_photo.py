"""The photo of a result, read from its file in the same way as when it was localized."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from ..photo.camera import Calibration
from ..photo.panorama import Panorama, read_panorama
from ..photo.photo import Photo
from .result import Result


def photo_of(result: Result, path: Path | None = None) -> Photo:
    """Return the photo of a result with its settings of then, without masks; `path` if it has moved."""
    picture = path or result.pano
    if result.cameras:
        return Photo(picture).with_calibration(Calibration("the result", result.cameras))
    how: Any = result.settings.get("panorama") or {}
    given = {name: how.get(name) for name in ("fov_deg", "projection", "cube_order")}
    return Photo(picture, **given)


def read_as_localized(result: Result) -> Panorama:
    """Read the photo of a result as when it was localized, with what was masked then masked."""
    how: Any = result.settings.get("panorama") or {}
    nadir_deg = float(how.get("mask_nadir_deg") or 0.0)
    photo = replace(photo_of(result), mask=how.get("mask"), mask_nadir_deg=nadir_deg)
    return read_panorama(photo)
