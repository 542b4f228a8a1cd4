"""A photo with options that its file does not contain, and prior knowledge of the camera's pose."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, asdict, dataclass, fields, replace
from os import PathLike
from pathlib import Path

import numpy as np

from ..system.arguments import Projection, check_fields
from ..system.arrays import Bytes, Mask
from ..system.errors import InputError
from .camera import Calibration, Mount
from .camera.calibration import IDENTITY, read_rig
from .camera.photo_cameras import find_calibration, open_calibration

FACE_LETTERS = "rludfb"  # right, left, up, down, front, back
MAX_FOCAL_PX = 1e6
File = str | PathLike[str]
Vector = tuple[float, float, float]
HEADING_TOLERANCE_DEG = 20.0


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo with options that its file does not contain.

    A path or an array can be used in its place if no option is needed.

    Parameters
    ----------
    picture
        Path of a picture (JPEG, PNG, TIFF, WebP, HEIC) or of a folder of six cube faces; or an array
        (H, W, 3), RGB in uint8: a full equirectangular sphere, W = 2 H, or the picture of a given camera.
    mask
        **White is ignored**, in a picture of the photo's size, or in a folder of masks named like the
        photos. For an array photo, a mask (H, W) that is True where pixels are ignored. COLMAP, OpenSfM and
        nerfstudio ignore black: invert their masks.
    mask_nadir_deg
        Half angle [deg] of the cap about camera -z that is ignored. Only for files.
    camera
        Calibration: COLMAP's cameras.txt, OpenSfM's camera_models.json, or JSON of docs/CAMERAS.md; or a
        folder with NAME.camera.json or NAME.json for each photo that is not a sphere.
    rig
        Calibration of several cameras; `picture` is the folder of the pictures of one instant.
    focal_px
        Focal length [px] of a pinhole photo in its own pixels, known to 1 %; by default EXIF's.
    fov_deg
        Horizontal field of view [deg], by default from the file's metadata: of a part of the sphere about
        the horizon (only for files), or of a pinhole, fisheye or cylindrical picture, as `projection` says.
    projection
        By default "pinhole" if EXIF has a focal length and W is not 2 H, else "equirectangular".
    gravity_vector
        Direction of gravity in camera axes (+x image centre, +y left, +z up), of any length; (0, 0, -1)
        is an upright camera. By default from the file's metadata.
    refine_focal
        The focal length is known within 20 % only; it is estimated with the pose.
    cube_order
        Order of six cube faces in one picture, such as "rludfb" (right, left, up, down, front, back).

    Raises
    ------
    InputError
        An option is invalid or does not go with another, or a calibration can't be read. The picture is read
        when it is localized.
    """

    picture: File | Bytes
    _: KW_ONLY
    mask: File | Mask | None = None
    mask_nadir_deg: float = 0.0
    camera: File | Calibration | None = None
    rig: File | Calibration | None = None
    focal_px: float | None = None
    fov_deg: float | None = None
    projection: Projection | None = None
    gravity_vector: Vector | None = None
    refine_focal: bool = False
    cube_order: str | None = None

    def __post_init__(self) -> None:
        """Refuse invalid values, with the option's name; read the calibration."""
        check_fields(self)
        if self.camera is not None and self.rig is not None:
            raise InputError("`camera`, `rig`: found both, wanted one of them")
        self._check_values()
        self._check_together()
        if isinstance(self.picture, np.ndarray):
            self._check_array(self.picture)
        elif isinstance(self.mask, np.ndarray):
            raise InputError("`mask`: found an array for a picture in a file, wanted a path")
        if self.camera is not None and not isinstance(self.camera, Calibration):
            object.__setattr__(self, "camera", open_calibration(Path(self.camera)))
        if self.rig is not None and not isinstance(self.rig, Calibration):
            object.__setattr__(self, "rig", read_rig(Path(self.rig)))

    @property
    def name(self) -> str:
        """Path of the picture as given, or "array"."""
        return "array" if isinstance(self.picture, np.ndarray) else str(self.picture)

    @property
    def path(self) -> Path:
        """Path of the picture; "array" for an array."""
        return Path(self.name)

    @property
    def calibration(self) -> Calibration | Path | None:
        """Calibration of the camera, or the path of a folder or model with those of several photos."""
        return Path(self.camera) if isinstance(self.camera, str | PathLike) else self.camera

    @property
    def instant(self) -> Calibration | None:
        """Calibration of the rig whose pictures of one instant are in the folder; None for one picture."""
        assert self.rig is None or isinstance(self.rig, Calibration)
        return self.rig

    def with_calibration(self, calibration: Calibration) -> "Photo":
        """Return the photo with the calibration of its camera, or of its rig."""
        if calibration.is_rig:
            return replace(self, rig=calibration)
        return replace(self, camera=calibration)

    def with_refined_camera(self, cameras: tuple[Mount, ...]) -> "Photo":
        """Return the photo with its refined camera as the calibration of the stored picture.

        A photo of a rig, or of no single camera, is returned as it is.
        """
        if len(cameras) != 1 or self.rig is not None:
            return self
        own = find_calibration(self.calibration, self.path)
        R_lens_from_cam = IDENTITY if own is None or own.is_choice else own.mounts[0].R_lens_from_cam
        mount = replace(cameras[0], R_lens_from_cam=R_lens_from_cam)
        camera = Calibration("the refined camera", (mount,))
        return replace(self, camera=camera, focal_px=None, fov_deg=None, projection=None)

    def to_json(self) -> dict[str, object]:
        """Return the options in the form of a result's JSON."""
        options = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "picture"}
        for name in ("camera", "rig"):
            if isinstance(options[name], Calibration):
                options[name] = asdict(options[name])
        options["mask"] = "array" if isinstance(self.mask, np.ndarray) else self.mask
        return {k: str(v) if isinstance(v, PathLike) else v for k, v in options.items()}

    def _check_values(self) -> None:
        """Refuse numbers out of range."""
        for name, largest in (("fov_deg", 360.0), ("focal_px", MAX_FOCAL_PX)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and 0.0 < value <= largest):
                raise InputError(f"`{name}`: found {value}, wanted above 0 and at most {largest:g}")
        if not (math.isfinite(self.mask_nadir_deg) and 0.0 <= self.mask_nadir_deg <= 90.0):
            raise InputError(f"`mask_nadir_deg`: found {self.mask_nadir_deg}, wanted 0 to 90")
        if self.cube_order is not None and sorted(self.cube_order) != sorted(FACE_LETTERS):
            wanted = f"wanted each of the letters {FACE_LETTERS} once (right, left, up, down, front, back)"
            raise InputError(f"`cube_order`: found {self.cube_order}, {wanted}")
        vector = self.gravity_vector
        if vector is not None and not (all(map(math.isfinite, vector)) and math.hypot(*vector) > 0.0):
            raise InputError(f"`gravity_vector`: found {vector}, wanted three finite numbers, not all 0")

    def _list_ways(self) -> list[str]:
        """List the given options that say what the picture shows, in backticks; only one is allowed."""
        is_set = {
            "`camera` or `rig`": self.camera is not None or self.rig is not None,
            "`focal_px`": self.focal_px is not None,
            "`cube_order`": self.cube_order is not None,
            "`fov_deg` or `projection`": self.fov_deg is not None or self.projection is not None,
        }
        if self.focal_px is not None and self.fov_deg is None and self.projection == "pinhole":
            is_set["`fov_deg` or `projection`"] = False
        return [name for name, is_given in is_set.items() if is_given]

    def _check_together(self) -> None:
        """Refuse options that do not go together, and a projection without the angle that it needs."""
        ways = self._list_ways()
        if len(ways) > 1:
            raise InputError(f"{', '.join(ways)}: wanted only one of them")
        if self.projection in ("fisheye", "cylindrical") and self.fov_deg is None:
            found = f"`projection` {self.projection}: found no `fov_deg`"
            raise InputError(f"{found}, wanted the angle that the width shows")

    def _check_array(self, picture: Bytes) -> None:
        """Refuse an array that is not a picture, and options that need a file."""
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
            found = f"{picture.dtype} of shape {picture.shape}"
            raise InputError(f"`picture`: found {found}, wanted RGB in uint8 of shape (H, W, 3)")
        is_crop = self.fov_deg is not None and self.projection not in ("pinhole", "fisheye")
        has_path = self.mask is not None and not isinstance(self.mask, np.ndarray)
        if has_path or self.mask_nadir_deg or self.cube_order or self.rig or is_crop:
            needing = "`fov_deg` of a sphere, `cube_order`, `mask_nadir_deg`, `rig` and a path as `mask`"
            raise InputError(f"{needing}: found an array as picture, wanted a file")
        size = picture.shape[:2]
        if isinstance(self.mask, np.ndarray) and not (
            self.mask.shape == size and self.mask.dtype == np.bool_
        ):
            found = f"{self.mask.dtype} of shape {self.mask.shape}"
            raise InputError(f"`mask`: found {found}, wanted bool of shape {size}, as the picture's")


def as_photo(photo: File | Bytes | Photo) -> Photo:
    """Return a photo; a path or an array becomes a photo without options."""
    return photo if isinstance(photo, Photo) else Photo(photo)


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a camera's pose: it narrows the search, and poses that contradict it are refused.

    Parameters
    ----------
    near, radius
        The camera is within `radius` [m] of the position `near` (x, y, z) [m]; if z is None, at any height.
    height
        Least and greatest height of the camera above the floor [m].
    heading_deg, heading_tolerance_deg
        Heading [deg] of the image centre, clockwise from the scan's +y, and its largest error (20).
    within
        Names of the map's scans in which the camera may be, by default all.
    use_gps
        Search near the GPS position in the photo's file first, if the scan's coordinate system is known.

    Raises
    ------
    InputError
        An option is invalid, or only one of two that belong together is given.
    """

    _: KW_ONLY
    near: tuple[float, float, float | None] | None = None
    radius: float | None = None
    height: tuple[float, float] | None = None
    heading_deg: float | None = None
    heading_tolerance_deg: float | None = None
    within: Sequence[str] = ()
    use_gps: bool = True

    def __post_init__(self) -> None:
        """Refuse invalid and contradictory values; the message names the option."""
        check_fields(self)
        object.__setattr__(self, "within", tuple(self.within))
        numbers = *(self.near or ()), *(self.height or ()), self.radius, self.heading_deg
        if not all(math.isfinite(number) for number in numbers if number is not None):
            raise InputError("`near`, `height`, `heading_deg`: found nan or inf, wanted finite numbers")
        if (self.near is None) != (self.radius is None):
            raise InputError("`near`, `radius`: found one of them, wanted both or none")
        if self.radius is not None and self.radius <= 0.0:
            raise InputError(f"`radius`: found {self.radius}, wanted metres above 0")
        if self.height is not None and not self.height[0] < self.height[1]:
            raise InputError(f"`height`: found {list(self.height)}, wanted MIN below MAX")
        if self.heading_tolerance_deg is not None and self.heading_deg is None:
            raise InputError("`heading_tolerance_deg`: only with `heading_deg`")
        if not 0.0 < self.tolerance_deg <= 180.0:
            raise InputError(f"`heading_tolerance_deg`: found {self.tolerance_deg}, wanted 0 to 180")

    @property
    def tolerance_deg(self) -> float:
        """Largest error [deg] of the heading."""
        tolerance_deg = self.heading_tolerance_deg
        return HEADING_TOLERANCE_DEG if tolerance_deg is None else tolerance_deg

    @property
    def is_empty(self) -> bool:
        """True if no option restricts the pose."""
        return replace(self, use_gps=True) == NOTHING_KNOWN

    def without_heading(self) -> "Prior":
        """Return the prior without its heading."""
        return replace(self, heading_deg=None, heading_tolerance_deg=None)


NOTHING_KNOWN = Prior()


@dataclass(frozen=True)
class GpsPrior:
    """A photo's GPS position in the scan, which may be wrong indoors."""

    center_world: tuple[float, float]  # x and y [m] in the scan's coordinates; the height is not known
    radius: float  # [m] within which the camera is searched first
    is_used: bool = True  # the photo was localized there; if not, it was searched everywhere

    def apply_to(self, prior: Prior) -> Prior:
        """Return the prior with this position in place of its own."""
        return replace(prior, near=(*self.center_world, None), radius=self.radius)
