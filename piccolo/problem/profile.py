"""Kinds of photos: of the whole sphere or of a part, in scans with colours or by shape alone."""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from ..geometry.nearness import STARTING, STARTING_NARROW, Nearness
from ..views.candidate_views import SEARCH_VIEW
from ..views.view import ViewConfig
from .method import METHOD, Method
from .stages import FIRST, SECOND, SOFT, ImageName, Stage, ViewName

# by what a pose is judged: edges; views with colours; these and local features of the scan drawn there
EvidenceKind = Literal["shape", "views", "drawn scan"]
# tilts of the camera that a search tries: the known one (upright if none is), about level, all
Tilts = Literal["known", "level", "any"]


class Beam(NamedTuple):
    """The numbers of poses that go on from stage to stage."""

    num_coarse: int  # after a short descent from each start
    num_middle: int  # after the descent on prepared views
    num_fine: int  # after the descent on middle cells
    num_perturbed: int  # that are perturbed and refined as long as the score rises


class ImageScale(NamedTuple):
    """One size of the panorama."""

    width: int  # [px] a multiple of local_normalization's STATS_WIDTH
    cell_deg: float  # colours are averaged over cells this wide
    sigma_deg: float  # of the Gaussian over which contrast is normalised
    blur_px: float = 0.0  # standard deviation of a blur before shrinking, in pixels of the wider image


class ImageScales(NamedTuple):
    """The sizes at which the panorama is compared, widest first; each image is made from the one before."""

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
# of edges drawn at a pose, which are as wide as those of the photo's fine image
DRAWN_VIEW = ViewConfig(
    num_rings=160, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150, draws_edges=True
)
# the edges are blurred for all but the last descent, to be as wide as those of coarse voxels
SHAPE_SCALES = ImageScales(fine=ImageScales().fine._replace(blur_px=1.7))


class DifferenceSteps(NamedTuple):
    """Image and step with which the loss is differentiated for a covariance."""

    image: ImageName  # of the photo
    turn: float  # [rad] step of the differences; a move is this times the acting range
    # by trials in made rooms, for whose errors less is too narrow, and in scans with a point every 10 cm, for
    # whose errors more is too wide
    inflation: float


COLOR_STEPS = (
    DifferenceSteps("full", math.radians(0.1), 1.5),
    DifferenceSteps("fine", math.radians(0.3), 1.0),
)
# for dark, noisy photos; there are too few to calibrate its factor
ROUGH_COLOR_STEPS = DifferenceSteps("middle", math.radians(0.3), 1.0)
# for edges, by which poses have larger errors
SHAPE_STEPS = (
    DifferenceSteps("full", math.radians(0.5), 1.0),
    DifferenceSteps("fine", math.radians(0.5), 1.0),
)
ROUGH_SHAPE_STEPS = DifferenceSteps("fine", math.radians(0.8), 1.0)
WHOLE_BEAM = Beam(400, 48, 8, 2)
PARTIAL_BEAM = Beam(1600, 192, 12, 3)  # many places look like a part of the sphere


@dataclass(frozen=True)
class Profile:
    """All that differs between kinds of photos. The defaults are for whole photos in scans with colours.

    `of_part` and `by_shape` list what differs for other kinds.
    """

    method: Method = METHOD  # the numbers that all kinds have in common
    evidence: EvidenceKind = "drawn scan"  # by what poses are judged
    is_partial: bool = False  # the photo shows a part of the sphere
    is_narrow: bool = False  # whole views constrain its pose little: local features do
    # the search
    follows_walls: bool = False  # its lines are aligned with the scan's walls, at several tilts
    looks_first: bool = True  # a brief search by whole views is tried first, unless its tilt is unknown
    is_always_upright: bool = False  # an upright camera is also tried if gravity is `unknown`
    default_tilt: Tilts = "known"  # what is tried first if its tilt is unknown: upright, or about level
    thins_starts: bool = True  # with few candidates, there are fewer starts
    starts_apart: Nearness = STARTING  # starts nearer to each other count as one
    subtracts_means: bool = False  # of views and photo, in the correlation on wide cells
    scores_again: bool = True  # starts are ordered by scores on the fine cells of the search
    # the refinement
    beam: Beam = WHOLE_BEAM
    first: Stage = FIRST  # the short descent from each start
    # Chosen: the largest number of places near candidates at which the scan is drawn: half a minute of a core
    # at most. With 32, three of twelve tilted panoramas of which 40 % is hidden are not found.
    most_places: int = 256
    refines_on_matches: bool = False  # at candidates with many matches, a pose is refined on them
    soft: tuple[Stage, ...] = ()  # stages before the first descent on points
    settles_near: bool = False  # a descent near a given pose is slow: it goes on with occluders masked
    # the choice
    clear_score: float = 0.3  # least score of a pose that explains the photo without matches
    # largest number of alternatives at which the scan is drawn; None: all that could win. For a whole photo
    # four views of the scan are drawn for each, and alternatives beyond these never won
    most_rivals: int | None = 4
    discount: float = 1.0  # factor of scores by shape: on few blocks chance explains more
    # geometry and errors
    fits_sphere: bool = True  # what a panorama shows of the sphere is compared with the scan
    steps: tuple[DifferenceSteps, ...] = COLOR_STEPS  # of a covariance: that of these which tells more
    rough_steps: DifferenceSteps = ROUGH_COLOR_STEPS  # if all of these are too rough
    own_share: float = 1.0  # of the variance by images: errors that other photos do not have in common
    has_few_blocks: bool = False  # so that their covariance is too small in the mean
    compares_halves: bool = True  # a covariance grows if the halves of a badly stitched photo disagree

    @property
    def has_shape(self) -> bool:
        """True if edges are compared, as the scan has no colours."""
        return self.evidence == "shape"

    @property
    def uses_matches(self) -> bool:
        """True if poses are judged by matches of local features too, not by whole views alone."""
        return self.evidence == "drawn scan"

    def by_views(self) -> "Profile":
        """Return the profile that judges poses by whole views alone; by shape it is always so."""
        return replace(self, evidence="views", is_narrow=False) if self.uses_matches else self

    def near_others(self) -> "Profile":
        """Return the profile for a search near others: of few places, few look like a part of the sphere."""
        return replace(self, thins_starts=True, beam=WHOLE_BEAM)


def of_part(whole: Profile) -> Profile:
    """Return the profile of photos that show a part of the sphere, from that of whole ones."""
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
        first=SECOND,  # a part of the sphere needs more iterations
        most_places=32,  # by trials: more find no more
        refines_on_matches=True,
        settles_near=True,
        most_rivals=None,
        has_few_blocks=True,
        compares_halves=False,
    )


def by_shape(by_colors: Profile) -> Profile:
    """Return the profile of photos in scans without colours, from that in scans with colours."""
    return replace(
        by_colors,
        evidence="shape",
        is_narrow=False,
        follows_walls=True,
        soft=(SOFT,),
        clear_score=0.1,
        most_rivals=0,
        fits_sphere=False,
        steps=SHAPE_STEPS,
        rough_steps=ROUGH_SHAPE_STEPS,
        own_share=0.05,  # chosen: the scan's edges are displaced from those of all photos alike
        compares_halves=False,
    )


WHOLE = Profile()
PARTIAL = of_part(WHOLE)
PROFILES = (WHOLE, PARTIAL, by_shape(WHOLE), by_shape(PARTIAL))


def choose_profile(valid_share: float, is_partial: bool, has_shape: bool, method: Method = METHOD) -> Profile:
    """Return the profile of a photo that shows a fraction of the sphere, `valid_share`."""
    kind = next(p for p in PROFILES if (p.is_partial, p.has_shape) == (is_partial, has_shape))
    profile = replace(kind, method=method)
    return replace(profile, discount=math.sqrt(valid_share)) if has_shape and is_partial else profile


def choose_scales(has_shape: bool) -> ImageScales:
    """Return the sizes at which a photo is compared; `has_shape` if the scan has no colours."""
    return SHAPE_SCALES if has_shape else ImageScales()
