"""Settings of the default method, and what is known of a camera beforehand."""

import math
from dataclasses import asdict, dataclass
from typing import get_args

from ..confidence.confidence import MIN_CONFIDENCE, check_confidence
from ..errors import InputError
from ..geometry.rotations import Gravity
from ..optimize.settings import Solver


@dataclass(frozen=True)
class Prior:
    """What the user knows beforehand; each narrows the search."""

    near_world: tuple[float, float, float | None] | None = None  # [m] within `radius`; None: any height
    radius: float | None = None  # [m]
    height: tuple[float, float] | None = None  # [m] least and most above the floor
    heading_deg: float | None = None  # of the image centre, clockwise from the cloud's +y, as GPano counts
    heading_tolerance_deg: float = 20.0
    within: tuple[str, ...] = ()  # names of the map's scans that the camera may be in; all if none

    def __post_init__(self) -> None:
        """Refuse what contradicts itself, naming the option."""
        numbers = *(self.near_world or ()), *(self.height or ()), self.radius, self.heading_deg
        if not all(math.isfinite(number) for number in numbers if number is not None):
            raise InputError("--near, --radius, --height, --heading: found nan or inf, wanted finite numbers")
        if (self.near_world is None) != (self.radius is None):
            raise InputError("--near, --radius: found one of them, wanted both or none")
        if self.radius is not None and self.radius <= 0.0:
            raise InputError(f"--radius: found {self.radius}, wanted metres above 0")
        if self.height is not None and not self.height[0] < self.height[1]:
            raise InputError(f"--height: found {list(self.height)}, wanted MIN below MAX")
        if not 0.0 < self.heading_tolerance_deg <= 180.0:
            raise InputError(f"--heading-tolerance: found {self.heading_tolerance_deg}, wanted 0 to 180")


NOTHING_KNOWN = Prior()
# at most: a minute and a gigabyte for a flat, far beyond what finds more
MOST = {"num_yaws": 3600, "num_rotations": 50_000, "max_starts": 100_000}


@dataclass(frozen=True)
class CoarseToFineSettings:
    """The default method."""

    gravity: Gravity = "auto"  # auto: as known first, and as unknown if that does not convince
    solver: Solver = "gauss-newton"  # of the last descent
    prior: Prior = NOTHING_KNOWN
    num_yaws: int = 48  # gravity known
    num_rotations: int = 2000  # of SO(3), gravity unknown
    max_starts: int = 4000  # poses from which a descent begins
    min_confidence: float = MIN_CONFIDENCE  # below it a pose is not called localized

    def __post_init__(self) -> None:
        """Refuse counts that mean nothing, naming the setting."""
        for name, kind in (("gravity", Gravity), ("solver", Solver)):
            if getattr(self, name) not in get_args(kind):
                found, known = getattr(self, name), ", ".join(get_args(kind))
                raise InputError(f"{name}: found {found!r}, wanted one of {known}")
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise InputError(f"{name}: found {getattr(self, name)}, wanted 1 to {most}")
        check_confidence(self.min_confidence)

    def to_json(self) -> dict[str, object]:
        """The settings as they took effect."""
        return {"preset": "default", **asdict(self)}
