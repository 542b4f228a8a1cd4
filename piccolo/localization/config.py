"""What the default method is made of: views, image scales, beams. `benchmark.py ablation` removes parts."""

from typing import NamedTuple

from ..views.candidate_views import SEARCH_VIEW
from ..views.view import ViewConfig


class Beam(NamedTuple):
    """How many poses go on to each stage."""

    num_coarse: int  # after a short descent from each start
    num_middle: int  # after the descent on prepared views
    num_fine: int  # after the descent on middle cells
    num_perturbed: int  # are perturbed and refined for as long as that helps


class ImageScale(NamedTuple):
    """One size of the panorama."""

    width: int  # [px] a multiple of local_normalization's STATS_WIDTH
    cell_deg: float  # colours are averaged over cells this wide
    sigma_deg: float  # of the Gaussian in which contrast is judged


class ImageScales(NamedTuple):
    """The sizes at which the panorama is compared, widest first: each is made from the one before."""

    full: ImageScale = ImageScale(1024, 0.0, 10.0)
    fine: ImageScale = ImageScale(256, 0.0, 10.0)
    middle: ImageScale = ImageScale(128, 0.0, 14.0)
    search: ImageScale = ImageScale(128, 7.5, SEARCH_VIEW.sigma_deg)


class MethodConfig(NamedTuple):
    """Views from coarse to fine, the image scales that go with them, and how many poses are kept."""

    middle_view: ViewConfig = ViewConfig(num_rings=48, stats_rings=24, sigma_deg=14.0, voxel_per_range=1 / 30)
    fine_view: ViewConfig = ViewConfig(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 80)
    full_view: ViewConfig = ViewConfig(num_rings=96, stats_rings=24, sigma_deg=10.0, voxel_per_range=1 / 150)
    scales: ImageScales = ImageScales()
    beam: Beam = Beam(400, 48, 8, 2)
    uses_features: bool = True
    uses_search: bool = True  # where features alone are not sure
    min_starts: int = 1000


METHOD = MethodConfig()
