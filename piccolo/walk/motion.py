"""The motion of a carried camera: its speed, its smoothness, and the odds of a jump."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from itertools import pairwise

from ..arguments import check_fields
from ..errors import InputError
from ..scan_map.camera_positions import COARSE_SPACING

MAX_SPEED = 2.0  # [m/s] of a walking person with a camera
MAX_ACCELERATION = 2.0  # [m/s^2]
MAX_STEP = 5.0  # [m] from one frame without time to the next
REACH_SLACK = COARSE_SPACING / 2.0  # [m] beyond what a person walks: places are as rough as their grid
JUMP_LOG = -9.0  # log odds of a jump to any place: lift, cut, pocket, a place that was not scanned


@dataclass(frozen=True)
class Motion:
    """The motion of a carried camera.

    Parameters
    ----------
    max_speed
        Largest speed of the camera [m/s], 2 by default. If frames have no times, it is the largest
        distance [m] between consecutive frames, 5 by default.
    max_acceleration
        Standard deviation of the acceleration along each axis [m/s^2]: less smooths the path more.
    is_timed
        False if the times of the frames are only their order.
    """

    _: KW_ONLY
    max_speed: float | None = None
    max_acceleration: float = MAX_ACCELERATION
    is_timed: bool = True

    def __post_init__(self) -> None:
        """Refuse speeds and accelerations that are not above 0."""
        check_fields(self)
        for name in ("max_speed", "max_acceleration"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise InputError(f"`{name}`: found {value}, wanted a number above 0")

    @property
    def speed(self) -> float:
        """Largest speed [m/s]; of frames without times largest step [m]."""
        return self.max_speed or (MAX_SPEED if self.is_timed else MAX_STEP)

    def reach(self, seconds: float) -> float:
        """Return how far [m] the camera may be from where it was so long ago, or later."""
        return self.speed * abs(seconds) + REACH_SLACK

    def to_settings(self) -> dict[str, object]:
        """Return the motion as results repeat it."""
        return {**asdict(self), "max_speed": self.speed}

    @property
    def jump_log(self) -> float:
        """Log odds of a jump, from a frame to a later one; frames without times may be anywhere."""
        return JUMP_LOG if self.is_timed else 0.0


def check_times(times: Sequence[float]) -> None:
    """Refuse times that are not finite or do not rise."""
    if not all(math.isfinite(time) for time in times):
        raise InputError("times: found one that is no finite number, wanted seconds")
    for k, (before, after) in enumerate(pairwise(times)):
        if after <= before:
            raise InputError(f"times: found {after} after {before} at frame {k + 1}, wanted them to rise")
