"""A photo's GPS position as a prior that may be wrong: receivers are, indoors above all."""

from dataclasses import dataclass, replace

from ..cloud.crs import from_wgs84
from ..panorama.photo import GpsPosition
from .settings import Prior

DEFAULT_ACCURACY, LEAST_ACCURACY = 10.0, 5.0  # [m] where the file does not say, or says less
SIGMAS = 3.0


@dataclass(frozen=True)
class GpsPrior:
    """Where a photo's GPS position lies in the scan."""

    center_world: tuple[float, float]  # [m] in the scan's coordinates, of any height
    radius: float  # [m] within which the camera is searched first
    is_used: bool = True  # the result lies there; else it was found, or not found, without it

    def applied_to(self, prior: Prior) -> Prior:
        """The prior with this position in place of none."""
        return replace(prior, near_world=(*self.center_world, None), radius=self.radius)


def gps_prior(gps: GpsPosition, crs: str, metres_per_unit: float) -> GpsPrior | None:
    """The prior of a position in a scan of this system; None where the system does not hold."""
    place = from_wgs84(crs, gps.latitude_deg, gps.longitude_deg)
    if place is None:
        return None
    radius = SIGMAS * max(gps.accuracy or DEFAULT_ACCURACY, LEAST_ACCURACY)
    return GpsPrior((place[0] * metres_per_unit, place[1] * metres_per_unit), radius)
