"""Frozen, typed settings with units; a result repeats the ones it was made with."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Literal

from .errors import InputError

Gravity = Literal["auto", "known", "unknown"]
MIN_CONFIDENCE = 0.9
Solver = Literal["gauss-newton", "lbfgs", "adam"]
UpAxis = Literal["auto", "z", "y", "x", "-z", "-y", "-x"]

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}  # per unit of length


@dataclass(frozen=True)
class CloudSettings:
    """How the files of a cloud are to be understood."""

    scale: float = 1.0  # metres per unit of the files
    up: UpAxis = "auto"  # the axis that points up; auto: z, or what the cloud's own planes say
    intensity_as_gray: bool = False  # where a file has no colours

    def __post_init__(self) -> None:
        """Refuse a scale that means nothing."""
        if not (math.isfinite(self.scale) and self.scale > 0.0):
            raise InputError(
                f"--scale: found {self.scale}, wanted a number above 0 (metres a unit of the file)"
            )


IN_METRES = CloudSettings()


def check_confidence(min_confidence: float) -> None:
    """Refuse a line that no confidence can pass or fail."""
    if not 0.0 < min_confidence < 1.0:
        raise InputError(f"--min-confidence: found {min_confidence}, wanted above 0 and below 1")


@dataclass(frozen=True)
class DescentSettings:
    """A descent on the sampling loss; the paper's names in brackets."""

    solver: Solver = "adam"
    num_iterations: int = 100  # [N_iter] of the solver
    step_size: float = 0.1  # Adam's first step [rad, m]
    step_decay: float = 0.8  # factor on the step whenever the loss has not fallen for `patience` iterations
    patience: int = 5
    use_visibility: bool = True  # leave out the points that the camera can't see
    num_culls: int = 4  # times during the descent at which hidden points are left out anew


@dataclass(frozen=True)
class PaperSettings(DescentSettings):
    """Algorithm 1 of the paper. What it leaves open has the defaults given here."""

    gravity: Gravity = "known"  # known: the camera is upright, only its yaw is searched
    num_translations: int = 50  # [N_t] positions on a uniform grid over the cloud's box, all in free space
    num_rotations: int = (
        0  # [N_r] 0 for the paper's: 8 yaws where gravity is known, 32 rotations of SO(3) if not
    )
    num_by_loss: int = 50  # [K1] poses kept by the sampling loss
    num_by_histogram: int = 6  # [K2] poses kept by the colour histograms, and refined
    grid_margin: float = 0.0  # share of the box left out of the grid on each side
    histogram_bins: int = 8  # a channel
    histogram_width: int = 256  # [px] of the views and of the panorama that are compared
    min_distance: float = (
        0.3  # poses closer than this [m] and than `min_angle_deg` are one: the better is kept
    )
    min_angle_deg: float = 15.0
    max_points: int = 1_000_000  # of a larger cloud, this many are taken, evenly in space
    min_confidence: float = MIN_CONFIDENCE  # below it a pose is not called localized
    seed: int = 0  # repeated in the result; this preset draws nothing at random

    def __post_init__(self) -> None:
        """Refuse values that mean nothing, naming the setting."""
        counts = ("num_translations", "num_by_loss", "num_by_histogram", "num_iterations", "num_culls")
        for name in (*counts, "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: found {getattr(self, name)}, wanted at least 1")
        if self.num_rotations < 0:
            raise InputError(
                f"num_rotations: found {self.num_rotations}, wanted 1 or more, or 0 for the paper's"
            )
        if self.gravity == "auto":
            raise InputError("gravity: found auto, wanted known or unknown with the preset paper")
        if not 0.0 <= self.grid_margin < 0.5:
            raise InputError(f"grid_margin: found {self.grid_margin}, wanted 0 to below 0.5")
        check_confidence(self.min_confidence)
        if not 2 <= self.histogram_bins <= 64:
            raise InputError(f"histogram_bins: found {self.histogram_bins}, wanted 2 to 64")

    @property
    def effective_num_rotations(self) -> int:
        """N_r with the paper's default filled in."""
        return self.num_rotations or (8 if self.gravity == "known" else 32)

    def to_json(self) -> dict[str, object]:
        """The settings as they took effect."""
        return {"preset": "paper", **asdict(self), "num_rotations": self.effective_num_rotations}


@dataclass(frozen=True)
class Prior:
    """What the user knows beforehand; each narrows the search."""

    near_world: tuple[float, float, float] | None = None  # [m] the camera is within `radius` of this
    radius: float | None = None  # [m]
    height: tuple[float, float] | None = None  # [m] least and most above the floor
    heading_deg: float | None = None  # of the image centre, clockwise from the cloud's +y, as GPano counts
    heading_tolerance_deg: float = 20.0

    def __post_init__(self) -> None:
        """Refuse what contradicts itself, naming the option."""
        if (self.near_world is None) != (self.radius is None):
            raise InputError("--near, --radius: found one of them, wanted both or none")
        if self.radius is not None and self.radius <= 0.0:
            raise InputError(f"--radius: found {self.radius}, wanted metres above 0")
        if self.height is not None and not self.height[0] < self.height[1]:
            raise InputError(f"--height: found {list(self.height)}, wanted MIN below MAX")
        if not 0.0 < self.heading_tolerance_deg <= 180.0:
            raise InputError(f"--heading-tolerance: found {self.heading_tolerance_deg}, wanted 0 to 180")


@dataclass(frozen=True)
class EngineSettings:
    """The default engine."""

    gravity: Gravity = "auto"  # auto: as known first, and as unknown if that does not convince
    solver: Solver = "gauss-newton"  # of the last descent
    prior: Prior = Prior()
    num_yaws: int = 48  # gravity known
    num_rotations: int = 2000  # of SO(3), gravity unknown
    min_starts: int = 1000
    max_starts: int = 4000
    candidates_per_start: int = 4  # a start for so many places, within these bounds
    poses_per_start: int = 12  # scored poses from which distinct ones are picked, a start
    num_coarse: int = 400  # poses kept after a short descent from each start
    num_middle: int = 48  # poses kept after the descent on wide cells
    num_fine: int = 8  # poses kept after the descent on middle cells
    num_polished: int = 2  # poses shaken and refined for as long as that helps
    num_points: int = 30_000  # for the last millimetres
    min_confidence: float = MIN_CONFIDENCE  # below it a pose is not called localized
    seed: int = 0  # repeated in the result; nothing is drawn at random

    def __post_init__(self) -> None:
        """Refuse counts that mean nothing, naming the setting."""
        for name, value in asdict(self).items():
            if isinstance(value, int) and name != "seed" and value < 1:
                raise InputError(f"{name}: found {value}, wanted at least 1")
        check_confidence(self.min_confidence)

    def wider(self) -> "EngineSettings":
        """Settings that keep more poses on the way down, for a second look."""
        return replace(
            self,
            num_coarse=2 * self.num_coarse,
            num_middle=4 * self.num_middle,
            num_fine=3 * self.num_fine,
            num_polished=2 * self.num_polished,
        )

    def to_json(self) -> dict[str, object]:
        """The settings as they took effect."""
        return {"preset": "default", **asdict(self)}
