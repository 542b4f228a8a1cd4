"""What functions of the API may be told about a photo, and what it asks for."""

from collections.abc import Mapping
from dataclasses import fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from .camera.files import read_calibration, read_rig
from .cloud.settings import CloudSettings
from .errors import InputError
from .geometry.rotations import Gravity
from .localization.settings import CoarseToFineSettings
from .optimize.settings import Solver
from .panorama import ReadOptions
from .panorama.model import Projection
from .paper.settings import PaperSettings
from .scan_map.prior import Prior

File = str | PathLike[str]
Settings = CoarseToFineSettings | PaperSettings


class QueryOptions(TypedDict, total=False):
    """What `Scan.localize` may be told about a photo; all may be left out."""

    mask: File | NDArray[np.bool_]  # what is to be ignored: white pixels of a picture, True of an array
    mask_nadir_deg: float  # the cap of this half angle about the camera's down axis is ignored
    fov_deg: float  # horizontal field of view of a picture that is a part of the sphere
    projection: Projection  # of the picture: "equirectangular", "pinhole" or "fisheye"
    focal_px: float  # focal length of a pinhole photo [px]
    camera: File  # calibration of the camera, see docs/CAMERAS.md
    rig: File  # the same of several cameras; the panorama is the folder of one instant's pictures
    gravity_vector: tuple[float, float, float]  # down, in the camera's axes
    refine_focal: bool  # the focal length is a first guess
    cube_order: str  # the picture is six cube faces in this order, such as "rludfb"
    use_gps: bool  # a GPS position in the file narrows the search (default), or not
    gravity: Gravity  # "known": upright camera, "unknown": any rotation, "auto": both are tried
    solver: Solver  # of the last descent
    near_world: tuple[float, float, float]  # [m] the camera is within `radius` of this
    radius: float  # [m]
    height: tuple[float, float]  # [m] least and most above the floor
    heading_deg: float  # of the image centre, clockwise from the cloud's +y
    heading_tolerance_deg: float
    within: tuple[str, ...]  # names of the map's scans that the camera may be in
    min_confidence: float  # below it a pose is not called localized


def refuse_unknown(options: Mapping[str, object], known: type, function: str) -> None:
    """TypeError for an option that is none, as Python has it for keywords."""
    for name in options.keys() - known.__annotations__.keys():
        raise TypeError(f"{function}() has no option {name!r}; it has {', '.join(known.__annotations__)}")


READ_FIELDS = {f.name for f in fields(ReadOptions)}
PRIOR_FIELDS = {f.name for f in fields(Prior)}


class Asked(NamedTuple):
    """What options say of a photo."""

    read_options: ReadOptions
    settings: Settings
    is_masked: NDArray[np.bool_] | None  # of an array


def asked_of(
    options: QueryOptions, function: str, settings: Settings, cloud_settings: CloudSettings
) -> Asked:
    """What the options of a function say, beside the settings of photos that say nothing else."""
    refuse_unknown(options, QueryOptions, function)
    given: dict[str, Any] = dict(options)
    is_masked = given.pop("mask") if isinstance(given.get("mask"), np.ndarray) else None
    if "mask" in given:
        given["mask"] = Path(given["mask"])
    prior = {k: given.pop(k) for k in PRIOR_FIELDS & given.keys()}
    if isinstance(prior.get("within"), str):
        raise InputError(f"within: found the text {prior['within']!r}, wanted a list of names")
    if prior:
        given["prior"] = Prior(**prior | {"within": tuple(prior.get("within", ()))})
    if "camera" in given and "rig" in given:
        raise InputError("camera, rig: wanted only one of them")
    if "camera" in given:
        given["calibration"] = read_calibration(Path(given.pop("camera")))
    if "rig" in given:
        given["calibration"] = read_rig(Path(given.pop("rig")))
    read_options = ReadOptions(
        labels=cloud_settings.labels, **{k: given.pop(k) for k in READ_FIELDS & given.keys()}
    )
    return Asked(read_options, replace(settings, **given), is_masked)
