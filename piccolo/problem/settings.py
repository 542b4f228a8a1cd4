"""Settings of the default method."""

from dataclasses import asdict, dataclass
from typing import NamedTuple

from ..geometry.pose import Gravity
from ..photo.photo import NOTHING_KNOWN, Prior
from ..system.arguments import MIN_CONFIDENCE, check_confidence, check_fields
from ..system.errors import InputError
from .accuracy import PAPER_ACCURACY, Accuracy, Demand
from .method import METHOD, Method

# largest values: a minute and a gigabyte for a flat; far smaller ones find as many photos
MOST = {"num_yaws": 3600, "num_rotations": 50_000, "max_starts": 100_000}


class Effort(NamedTuple):
    """The numbers of rotations and starts of a search."""

    num_yaws: int  # rotations about the vertical, with gravity known
    num_rotations: int  # of SO(3), with gravity unknown
    max_starts: int  # poses from which a descent begins
    first_starts: int = METHOD.first_starts  # the same for a brief search

    def brief(self, most: int | None = None) -> "Effort":
        """Return the effort of a brief search, with at most `most` starts."""
        wanted = self.first_starts if most is None else most
        return self._replace(max_starts=min(wanted, self.first_starts, self.max_starts))


@dataclass(frozen=True)
class CoarseToFineSettings:
    """Settings of the default method."""

    gravity: Gravity = "auto"  # auto: searched as known first, and as unknown if no pose is sure
    prior: Prior = NOTHING_KNOWN
    num_yaws: int = 48  # gravity known
    num_rotations: int = 2000  # of SO(3), gravity unknown
    max_starts: int = 4000  # poses from which a descent begins
    accuracy: Accuracy = PAPER_ACCURACY  # how exact a pose must be
    min_confidence: float = MIN_CONFIDENCE  # below it a pose is not called localized
    method: Method = METHOD  # for research: the numbers by which the method decides

    def __post_init__(self) -> None:
        """Refuse values out of range; the message names the setting."""
        check_fields(self)
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise InputError(f"{name}: found {getattr(self, name)}, wanted 1 to {most}")
        check_confidence(self.min_confidence)

    @property
    def effort(self) -> Effort:
        """The numbers of rotations and starts of a search."""
        return Effort(self.num_yaws, self.num_rotations, self.max_starts, self.method.first_starts)

    @property
    def demand(self) -> Demand:
        """The demands that a pose must meet to be called localized."""
        return Demand(self.accuracy, self.min_confidence)

    def to_json(self) -> dict[str, object]:
        """Return the settings and their values, as results list them."""
        return {"preset": "default", **asdict(self)}
