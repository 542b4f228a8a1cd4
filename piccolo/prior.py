"""Prior knowledge of the user on a camera's pose."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

from .arguments import check_fields
from .errors import InputError

HEADING_TOLERANCE_DEG = 20.0


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a camera's pose: each option narrows the search, a pose against it is refused.

    Parameters
    ----------
    near, radius
        The camera is within `radius` [m] of the position `near` (x, y, z) [m]; a z of None is any height.
    height
        Least and greatest height of the camera above the floor [m].
    heading_deg, heading_tolerance_deg
        Heading [deg] of the image centre, clockwise from the scan's +y, and its largest error (20).
    within
        Names of the scans in the map that the camera may be in, by default all.
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
        """Refuse contradictory values, naming the option."""
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
        given = self.heading_tolerance_deg
        return HEADING_TOLERANCE_DEG if given is None else given

    @property
    def is_empty(self) -> bool:
        """True if nothing is said of the pose."""
        return replace(self, use_gps=True) == NOTHING_KNOWN

    def without_heading(self) -> "Prior":
        """Return the prior without what it says of the heading."""
        return replace(self, heading_deg=None, heading_tolerance_deg=None)


NOTHING_KNOWN = Prior()


@dataclass(frozen=True)
class GpsPrior:
    """A photo's GPS position in the scan, which may be wrong indoors."""

    center_world: tuple[float, float]  # [m] in the scan's coordinates, of any height
    radius: float  # [m] within which the camera is searched first
    is_used: bool = True  # the result lies there; else it was found, or not found, without it

    def apply_to(self, prior: Prior) -> Prior:
        """Return the prior with this position in place of its own."""
        return replace(prior, near=(*self.center_world, None), radius=self.radius)
