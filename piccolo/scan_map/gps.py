"""Positions of photos by GPS in a scan; they may be wrong indoors."""

from dataclasses import dataclass, replace

from ..cloud.settings import from_wgs84
from ..panorama.photo import GpsPosition
from ..prior import Prior


@dataclass(frozen=True)
class GpsPrior:
    """A photo's GPS position in the scan."""

    center_world: tuple[float, float]  # [m] in the scan's coordinates, of any height
    radius: float  # [m] within which the camera is searched first
    is_used: bool = True  # the result lies there; else it was found, or not found, without it

    def apply_to(self, prior: Prior) -> Prior:
        """Return the prior with this position in place of its own."""
        return replace(prior, near=(*self.center_world, None), radius=self.radius)


def gps_prior(gps: GpsPosition, crs: str, metres_per_unit: float) -> GpsPrior | None:
    """Return the GPS prior in a scan of this coordinate system; None outside the system's area."""
    place = from_wgs84(crs, gps.latitude_deg, gps.longitude_deg)
    if place is None:
        return None
    radius = 3.0 * max(gps.accuracy or 10.0, 5.0)  # [m] three sigmas; 10 m where the file does not say
    return GpsPrior((place[0] * metres_per_unit, place[1] * metres_per_unit), radius)
