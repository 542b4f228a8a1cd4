"""Kinds of photos: of the whole sphere or of a part, in scans with colours or by shape alone."""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from ..geometry.nearness import STARTING, STARTING_NARROW, Nearness
from ..views.candidate_views import SEARCH_VIEW
from ..views.view import ViewConfig
from .method import METHOD, Method
from .stages import FIRST, SECOND, SOFT, ImageName, Stage, ViewName

# the scan's shape; its coloured views; these, and local features of the scan drawn at the pose
EvidenceKind = Literal["shape", "views", "drawn scan"]
Tilts = Literal["known", "level", "any"]  # of the camera that are searched: its own, about level, all


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


class DifferenceSteps(NamedTuple):
    """Image and step with which the loss is differentiated for a covariance."""

    image: ImageName  # of the photo
    turn: float  # [rad] step of the differences; a move is this times the median range
    inflation: float  # so that 95 % of true poses lie in the 95 % region (tools/benchmark.py calibration)


COLOR_STEPS = (
    DifferenceSteps("full", math.radians(0.1), 1.1),
    DifferenceSteps("fine", math.radians(0.3), 0.36),
)
# of dark, noisy photos; they are too few to calibrate
ROUGH_COLOR_STEPS = DifferenceSteps("middle", math.radians(0.3), 1.0)
# of edges, whose poses have larger errors
SHAPE_STEPS = (
    DifferenceSteps("full", math.radians(0.5), 1.0),
    DifferenceSteps("fine", math.radians(0.5), 1.0),
)
ROUGH_SHAPE_STEPS = DifferenceSteps("fine", math.radians(0.8), 1.0)
WHOLE_BEAM = Beam(400, 48, 8, 2)
PARTIAL_BEAM = Beam(1600, 192, 12, 3)  # many places look like a part of the sphere


@dataclass(frozen=True)
class Profile:
    """A kind of photo: all in which kinds differ, by default as for a whole photo in a scan with colours.

    `of_part` and `by_shape` say what other kinds have instead.
    """

    method: Method = METHOD  # the numbers by which all kinds are decided
    evidence: EvidenceKind = "drawn scan"  # with what poses are compared
    is_partial: bool = False  # the photo shows a part of the sphere
    is_narrow: bool = False  # views tell little: matches with the drawn scan, and photos beside, place it
    # the search
    follows_walls: bool = False  # its lines are turned along the walls of the scan, at one tilt after another
    looks_first: bool = True  # unless its tilt is unknown, a brief look by whole views may settle it
    is_always_upright: bool = False  # it is searched as upright too if its tilt is said to be unknown
    default_tilt: Tilts = "known"  # how a photo of unknown tilt is searched: as upright, or about level
    thins_starts: bool = True  # it has fewer starts where there are few candidates
    starts_apart: Nearness = STARTING  # starts nearer to each other count as one
    subtracts_means: bool = False  # of views and photo, from the correlation of wide cells
    scores_again: bool = True  # its starts, on the cells of the search grid
    # the refinement
    beam: Beam = WHOLE_BEAM
    first: Stage = FIRST  # of short descents from starts
    refines_on_matches: bool = False  # the scan is drawn at all candidates; many matches add one
    soft: tuple[Stage, ...] = ()  # descents on points before all others
    settles_near: bool = False  # near a given pose it converges slowly: it goes on, without occluders
    # the choice
    clear_score: float = 0.3  # least score of one pose alone that explains a whole photo: see docs/METHOD.md
    # alternatives at which the scan is drawn at most; None: all that could win. Of a whole photo it is drawn
    # in four views for each, and further ones never won
    most_rivals: int | None = 4
    discount: float = 1.0  # of scores by shape: of few blocks chance explains more
    # geometry and errors
    fits_sphere: bool = True  # what a panorama shows of the sphere is compared with the scan
    steps: tuple[DifferenceSteps, ...] = COLOR_STEPS  # of a covariance, which is the mean by these
    rough_steps: DifferenceSteps = ROUGH_COLOR_STEPS  # if all of these are too rough
    own_share: float = 1.0  # of the variance by images: errors that other photos do not have in common
    has_few_blocks: bool = False  # so that their covariance is too small in the mean
    compares_halves: bool = True  # lenses stitched with an error: halves that disagree add to the covariance

    @property
    def has_shape(self) -> bool:
        """True if edges are compared: the scan has no colours."""
        return self.evidence == "shape"

    @property
    def uses_matches(self) -> bool:
        """True if local features speak for poses, not whole views alone."""
        return self.evidence == "drawn scan"

    def by_views(self) -> "Profile":
        """Return the profile by whole views alone; shape has no other."""
        return replace(self, evidence="views", is_narrow=False) if self.uses_matches else self


def of_part(whole: Profile) -> Profile:
    """Return the kind of photos of a part of the sphere: what they have other than whole ones."""
    return replace(
        whole,
        is_partial=True,
        is_narrow=True,
        looks_first=False,
        is_always_upright=True,
        default_tilt="level",
        thins_starts=False,
        starts_apart=STARTING_NARROW,
        subtracts_means=True,
        scores_again=False,
        beam=PARTIAL_BEAM,
        first=SECOND,  # which needs more iterations
        refines_on_matches=True,
        settles_near=True,
        most_rivals=None,
        has_few_blocks=True,
        compares_halves=False,
    )


def by_shape(seen: Profile) -> Profile:
    """Return the kind of photos in scans without colours: what they have other than in those with."""
    return replace(
        seen,
        evidence="shape",
        is_narrow=False,
        follows_walls=True,
        soft=(SOFT,),
        clear_score=0.1,
        most_rivals=0,
        fits_sphere=False,
        steps=SHAPE_STEPS,
        rough_steps=ROUGH_SHAPE_STEPS,
        own_share=0.05,  # chosen: edges of all photos lie beside those of the scan in the same way
        compares_halves=False,
    )


WHOLE = Profile()
PARTIAL = of_part(WHOLE)
PROFILES = (WHOLE, PARTIAL, by_shape(WHOLE), by_shape(PARTIAL))


def choose_profile(valid_share: float, is_partial: bool, has_shape: bool, method: Method = METHOD) -> Profile:
    """Return the profile of a photo that shows a share of the sphere, in a scan with colours or by shape."""
    kind = next(p for p in PROFILES if (p.is_partial, p.has_shape) == (is_partial, has_shape))
    found = replace(kind, method=method)
    return replace(found, discount=math.sqrt(valid_share)) if has_shape and is_partial else found


def choose_scales(has_shape: bool) -> ImageScales:
    """Return the sizes at which a photo is compared, in a scan with colours or by shape."""
    return SHAPE_SCALES if has_shape else ImageScales()
