"""Settings for reading the files of a cloud."""

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ..geometry.pose import rotation_to_z
from ..system.arrays import Array
from ..system.errors import InputError, import_optional

# what points have beside x y z, with which photos are compared
Channel = Literal["colors", "intensity", "shape"]
UpAxis = Literal["auto", "z", "y", "x", "-z", "-y", "-x"]

RANGES = (1.0, 255.0, 65535.0)  # values that full brightness may have
WITHOUT_COLORS: tuple[Channel, ...] = ("intensity", "shape")
COLUMNS = {"i": "intensity", "r": "red", "g": "green", "b": "blue"}  # short names of columns
METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}  # per unit of length


@dataclass(frozen=True)
class CloudSettings:
    """Unit, axes, channels and coordinate system of a cloud's files."""

    scale: float | None = None  # metres per unit of the files; None: as the files say, or 1
    up: UpAxis = "auto"  # the axis that points up; auto: that of the format, y in glTF and else z
    channels: tuple[Channel, ...] = get_args(Channel)  # the first of these that the files have is read
    crs: str | None = None  # coordinate system, such as EPSG:25832; None: the one that the file names
    color_range: float | None = None  # value of full brightness; None: by the file's values
    columns: tuple[str, ...] = ()  # names of the columns, such as x y z i r g b; empty: by the file

    @classmethod
    def of_options(cls, ignore_colors: bool, **others: Any) -> "CloudSettings":
        """Return the settings for a user's options."""
        channels = WITHOUT_COLORS if ignore_colors else BY_FILE.channels
        return cls(channels=channels, **others)

    def __post_init__(self) -> None:
        if self.up not in get_args(UpAxis):
            raise InputError(f"`up`: found {self.up!r}, wanted one of {', '.join(get_args(UpAxis))}")
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0.0):
            raise InputError(f"`units`: found {self.scale}, wanted a number above 0 (metres a unit)")
        if self.color_range not in (None, *RANGES):
            raise InputError(f"`color_range`: found {self.color_range}, wanted 1, 255 or 65535")
        if self.columns and not {*"xyz"} <= {*self.columns}:
            found = ",".join(self.columns)
            raise InputError(f"`columns`: found {found[:80]!r}, wanted x, y, z among them, as x,y,z,i,r,g,b")
        if self.crs:
            check_crs(self.crs)


def check_crs(crs: str, what: str = "GPS in photos") -> Any:
    """Return the coordinate system of x and y that a text names, as pyproj's object.

    Raise InputError if there is none; `what` names the feature that needs pyproj, should it be missing.
    """
    pyproj = import_optional(what, "pyproj", "gps")
    try:
        return pyproj.CRS.from_user_input(crs).to_2d()
    except pyproj.exceptions.CRSError as error:
        wanted = "wanted a coordinate system such as EPSG:25832"
        raise InputError(f"`crs`: found {crs[:80]!r}, {wanted}") from error


def from_wgs84(crs: str, latitude_deg: float, longitude_deg: float) -> tuple[float, float] | None:
    """Return x and y [m] of a place in a projected system, whatever its unit; None if it has no such x, y."""
    system = check_crs(crs)
    pyproj = import_optional("GPS in photos", "pyproj", "gps")
    if not system.is_projected:
        return None
    transformer = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    x, y = transformer.transform(longitude_deg, latitude_deg)
    metres = float(system.axis_info[0].unit_conversion_factor)
    return (x * metres, y * metres) if math.isfinite(x) and math.isfinite(y) else None


BY_FILE = CloudSettings()  # all is as the files say
IN_COLORS = CloudSettings(channels=("colors",))  # the files must have colours


def R_z_from_axis(up: UpAxis, of_file: UpAxis) -> Array:
    """Return the rotation (3, 3) that turns the axis `up`, or if that is "auto" the axis `of_file`, to z."""
    name = of_file if up == "auto" else up
    sign = -1.0 if name.startswith("-") else 1.0
    return np.round(rotation_to_z(sign * np.eye(3)["xyz".index(name[-1])])) + 0.0
