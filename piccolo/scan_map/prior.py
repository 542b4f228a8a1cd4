"""Prior knowledge of a camera's pose: from the user, or a photo's GPS, which may be wrong indoors."""

import math
from dataclasses import dataclass, replace

from ..cloud.crs import from_wgs84
from ..errors import InputError
from ..panorama.photo import GpsPosition


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the user; each field narrows the search."""

    near_world: tuple[float, float, float | None] | None = None  # [m] within `radius`; None: any height
    radius: float | None = None  # [m]
    height: tuple[float, float] | None = None  # [m] least and most above the floor
    heading_deg: float | None = None  # of the image centre, clockwise from the cloud's +y, as GPano counts
    heading_tolerance_deg: float = 20.0
    within: tuple[str, ...] = ()  # names of the map's scans that the camera may be in; all if none
    # down, in the camera's axes, of any length; goes before metadata
    gravity_vector: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse contradictory values, naming the option."""
        numbers = *(self.near_world or ()), *(self.height or ()), self.radius, self.heading_deg
        if not all(math.isfinite(number) for number in numbers if number is not None):
            raise InputError("`near_world`, `height`, `heading`: found nan or inf, wanted finite numbers")
        if (self.near_world is None) != (self.radius is None):
            raise InputError("`near_world`, `radius`: found one of them, wanted both or none")
        if self.radius is not None and self.radius <= 0.0:
            raise InputError(f"radius: found {self.radius}, wanted metres above 0")
        if self.height is not None and not self.height[0] < self.height[1]:
            raise InputError(f"`height`: found {list(self.height)}, wanted MIN below MAX")
        if not 0.0 < self.heading_tolerance_deg <= 180.0:
            raise InputError(f"heading_tolerance_deg: found {self.heading_tolerance_deg}, wanted 0 to 180")
        vector = self.gravity_vector
        if vector is not None and not (all(map(math.isfinite, vector)) and math.hypot(*vector) > 0.0):
            raise InputError(f"`gravity_vector`: found {vector}, wanted three finite numbers, not all 0")


NOTHING_KNOWN = Prior()


@dataclass(frozen=True)
class GpsPrior:
    """A photo's GPS position in the scan."""

    center_world: tuple[float, float]  # [m] in the scan's coordinates, of any height
    radius: float  # [m] within which the camera is searched first
    is_used: bool = True  # the result lies there; else it was found, or not found, without it

    def apply_to(self, prior: Prior) -> Prior:
        """Return the prior with this position in place of its own."""
        return replace(prior, near_world=(*self.center_world, None), radius=self.radius)


def gps_prior(gps: GpsPosition, crs: str, metres_per_unit: float) -> GpsPrior | None:
    """Return the GPS prior in a scan of this coordinate system; None outside the system's area."""
    place = from_wgs84(crs, gps.latitude_deg, gps.longitude_deg)
    if place is None:
        return None
    radius = 3.0 * max(gps.accuracy or 10.0, 5.0)  # [m] three sigmas; 10 m where the file does not say
    return GpsPrior((place[0] * metres_per_unit, place[1] * metres_per_unit), radius)
