"""Settings of the default method."""

from dataclasses import asdict, dataclass
from typing import Literal, NamedTuple

from ..arguments import MIN_CONFIDENCE, check_fields
from ..confidence.confidence import check_confidence
from ..errors import InputError
from ..geometry.pose import Gravity
from ..optimize.refine import Solver
from ..photo import NOTHING_KNOWN, Prior
from ..views.candidate_views import SEARCH_VIEW
from ..views.view import ViewConfig

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
        """Refuse values that mean nothing, naming the setting."""
        check_fields(self)
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise InputError(f"{name}: found {getattr(self, name)}, wanted 1 to {most}")
        check_confidence(self.min_confidence)

    def to_json(self) -> dict[str, object]:
        """Return the settings as they took effect."""
        return {"preset": "default", **asdict(self)}


ViewName = Literal["prepared", "middle", "fine", "points"]
ImageName = Literal["full", "fine", "middle", "search"]


class Beam(NamedTuple):
    """The number of poses that go on to each stage."""

    num_coarse: int  # after a short descent from each start
    num_middle: int  # after the descent on prepared views
    num_fine: int  # after the descent on middle cells
    num_perturbed: int  # are perturbed and refined for as long as that helps


class ImageScale(NamedTuple):
    """One size of the panorama."""

    width: int  # [px] a multiple of local_normalization's STATS_WIDTH
    cell_deg: float  # colours are averaged over cells this wide
    sigma_deg: float  # of the Gaussian in which contrast is judged
    blur_px: float = 0.0  # standard deviation, in the next wider image, with which that is blurred before


class ImageScales(NamedTuple):
    """The sizes at which the panorama is compared, widest first: each is made from the one before."""

    full: ImageScale = ImageScale(1024, 0.0, 10.0)
    fine: ImageScale = ImageScale(256, 0.0, 10.0)
    middle: ImageScale = ImageScale(128, 0.0, 14.0)
    search: ImageScale = ImageScale(128, 7.5, SEARCH_VIEW.sigma_deg)


# edges drawn at a pose, as wide as those of the photo's fine image
DRAWN_VIEW = ViewConfig(
    num_rings=160, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150, draws_edges=True
)
# narrow edges are for the last descent: all others need them as wide as those of coarse voxels
SHAPE_SCALES = ImageScales(fine=ImageScales().fine._replace(blur_px=1.7))


VIEWS: dict[ViewName, ViewConfig] = {  # from coarse to fine
    "prepared": SEARCH_VIEW,
    "middle": ViewConfig(num_rings=48, stats_rings=24, sigma_deg=14.0, voxel_per_range=1 / 30),
    "fine": ViewConfig(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 80),
    "points": ViewConfig(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150),
}
WHOLE_BEAM = Beam(400, 48, 8, 2)
PARTIAL_BEAM = Beam(1600, 192, 12, 3)  # of a part of the sphere: many places look like it
