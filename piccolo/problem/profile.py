"""Kinds of photos: of the whole sphere or of a part, in scans with colours or by shape alone."""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from ..views.candidate_views import SEARCH_VIEW
from ..views.view import ViewConfig
from .stages import FIRST, SECOND, Stage, ViewName

# the scan's shape; its coloured views; these, and local features of the scan drawn at the pose
EvidenceKind = Literal["shape", "views", "drawn scan"]


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


VIEWS: dict[ViewName, ViewConfig] = {  # from coarse to fine
    "prepared": SEARCH_VIEW,
    "middle": ViewConfig(num_rings=48, stats_rings=24, sigma_deg=14.0, voxel_per_range=1 / 30),
    "fine": ViewConfig(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 80),
    "points": ViewConfig(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150),
}
# edges drawn at a pose, as wide as those of the photo's fine image
DRAWN_VIEW = ViewConfig(
    num_rings=160, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150, draws_edges=True
)
# narrow edges are for the last descent: all others need them as wide as those of coarse voxels
SHAPE_SCALES = ImageScales(fine=ImageScales().fine._replace(blur_px=1.7))


@dataclass(frozen=True)
class Profile:
    """A kind of photo: the ways in which it is searched and judged."""

    evidence: EvidenceKind  # with what poses are compared
    is_partial: bool  # the photo shows a part of the sphere
    beam: Beam
    first: Stage  # of short descents from starts; a photo of a part needs more iterations
    clear_score: float  # least score of one pose alone that explains a whole photo: see docs/METHOD.md
    # alternatives at which the scan is drawn at most; None: all that could win. Of a whole photo it is drawn
    # in four views for each, and further ones never won
    most_rivals: int | None
    discount: float = 1.0  # of scores by shape: of few blocks chance explains more

    @property
    def has_shape(self) -> bool:
        """True if edges are compared: the scan has no colours."""
        return self.evidence == "shape"

    @property
    def uses_matches(self) -> bool:
        """True if local features speak for poses, not whole views alone."""
        return self.evidence == "drawn scan"

    @property
    def is_narrow(self) -> bool:
        """True for a photo of a part of the sphere that is compared with the drawn scan."""
        return self.uses_matches and self.is_partial

    def by_views(self) -> "Profile":
        """Return the profile by whole views alone; shape has no other."""
        return replace(self, evidence="views") if self.uses_matches else self


CLEAR_SCORE = 0.3
CLEAR_SHAPE = 0.1
WHOLE_BEAM = Beam(400, 48, 8, 2)
PARTIAL_BEAM = Beam(1600, 192, 12, 3)  # of a part of the sphere: many places look like it
PROFILES = (
    Profile("drawn scan", False, WHOLE_BEAM, FIRST, CLEAR_SCORE, most_rivals=4),
    Profile("drawn scan", True, PARTIAL_BEAM, SECOND, CLEAR_SCORE, most_rivals=None),
    Profile("shape", False, WHOLE_BEAM, FIRST, CLEAR_SHAPE, most_rivals=0),
    Profile("shape", True, PARTIAL_BEAM, SECOND, CLEAR_SHAPE, most_rivals=0),
)


def choose_profile(valid_share: float, is_partial: bool, has_shape: bool) -> Profile:
    """Return the profile of a photo that shows a share of the sphere, in a scan with colours or by shape."""
    found = next(p for p in PROFILES if (p.is_partial, p.has_shape) == (is_partial, has_shape))
    return replace(found, discount=math.sqrt(valid_share)) if has_shape and is_partial else found


def choose_scales(has_shape: bool) -> ImageScales:
    """Return the sizes at which a photo is compared, in a scan with colours or by shape."""
    return SHAPE_SCALES if has_shape else ImageScales()
