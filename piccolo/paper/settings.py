"""Settings of the paper's method, with the paper's names."""

from dataclasses import asdict, dataclass
from typing import Literal

from ..arguments import check_fields
from ..confidence.confidence import MIN_CONFIDENCE, check_confidence
from ..errors import InputError
from ..geometry.rotations import Gravity
from ..optimize.refine import DescentSettings
from ..views.zbuffer import MAX_VIEW_WIDTH, MIN_VIEW_WIDTH

PoseLoss = Literal["sampling", "photometric"]
Initialization = Literal["two-stage", "loss-only"]


@dataclass(frozen=True)
class PaperSettings(DescentSettings):
    """Algorithm 1 of the paper; the defaults are ours where it gives none."""

    gravity: Gravity = "known"  # known: the camera is upright, only its yaw is searched
    num_translations: int = 50  # [N_t] positions on a uniform grid over the cloud's box, all in free space
    num_rotations: int = 0  # [N_r] 0 for the paper's: 8 yaws if gravity is known, else 32 rotations of SO(3)
    loss: PoseLoss = "sampling"  # photometric: of the rendered cloud, pixel by pixel
    initialization: Initialization = "two-stage"  # loss-only: K2 poses by the loss, without histograms
    num_by_loss: int = 50  # [K1] poses kept by the loss
    num_by_histogram: int = 6  # [K2] poses kept by the colour histograms, and refined
    grid_margin: float = 0.0  # share of the box left out of the grid on each side
    histogram_bins: int = 8  # a channel
    photometric_width: int = 256  # [px] at most, of the views and of the panorama for the photometric loss
    histogram_width: int = 256  # [px] of the views and of the panorama that are compared
    min_distance: float = 0.3  # poses closer than this [m] and `min_angle_deg` are one: the better is kept
    min_angle_deg: float = 15.0
    max_points: int = 1_000_000  # of a larger cloud, this many are taken, evenly in space
    min_confidence: float = MIN_CONFIDENCE  # below it a pose is not called localized
    seed: int = 0  # repeated in the result; this preset draws nothing at random

    def __post_init__(self) -> None:
        check_fields(self)
        counts = ("num_translations", "num_by_loss", "num_by_histogram", "num_iterations", "num_culls")
        for name in (*counts, "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: found {getattr(self, name)}, wanted at least 1")
        if self.num_rotations < 0:
            found = f"found {self.num_rotations}"
            raise InputError(f"num_rotations: {found}, wanted 1 or more, or 0 for the paper's")
        if self.gravity == "auto":
            raise InputError("gravity: found auto, wanted known or unknown with the preset paper")
        if not 0.0 <= self.grid_margin < 0.5:
            raise InputError(f"grid_margin: found {self.grid_margin}, wanted 0 to below 0.5")
        check_confidence(self.min_confidence)
        if not 2 <= self.histogram_bins <= 64:
            raise InputError(f"histogram_bins: found {self.histogram_bins}, wanted 2 to 64")
        if not MIN_VIEW_WIDTH <= self.photometric_width <= MAX_VIEW_WIDTH or self.photometric_width % 2:
            wanted = f"wanted an even number of {MIN_VIEW_WIDTH} to {MAX_VIEW_WIDTH}"
            raise InputError(f"photometric_width: found {self.photometric_width}, {wanted}")

    @property
    def effective_num_rotations(self) -> int:
        """N_r with the paper's default filled in."""
        return self.num_rotations or (8 if self.gravity == "known" else 32)

    def to_json(self) -> dict[str, object]:
        """Return the settings as they took effect."""
        return {"preset": "paper", **asdict(self), "num_rotations": self.effective_num_rotations}
