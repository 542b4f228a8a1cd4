"""Settings of the default method."""

from dataclasses import asdict, dataclass
from typing import get_args

from ..confidence.confidence import MIN_CONFIDENCE, check_confidence
from ..errors import InputError
from ..geometry.rotations import Gravity
from ..optimize.settings import Solver
from ..scan_map.prior import NOTHING_KNOWN, Prior

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
