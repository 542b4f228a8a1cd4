"""Brief searches by whole views: from few starts, and of the photo mirrored.

Most photos of the whole sphere, upright, fit one view and no other, and need no local features. What these
would tell more is whether the photo is mirrored: its mirrored picture is searched too, as far as is cheap.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from ..jobs.once import Once
from ..panorama.texels import Texels
from ..scan_map.camera_positions import COARSE_SPACING
from .query import Query
from .refinement import FIRST_ITERATIONS, descend_all
from .search import Starts, search_poses
from .settings import Beam

WHOLE = 0.9  # of the sphere that the photo shows, at least
MIRROR_RATIO = 1.1  # of the first scores, the photo as it is by its mirrored picture
FIRST_STARTS = 300  # few: what is clear is found by them
FIRST_BEAM = Beam(100, 12, 4, 1)
FIRST_ROTATIONS = 1000  # of SO(3)
FEW_CELLS = 200  # of the grid: fewer, which a prior has left, are all searched
NUM_SCORED = 64  # starts, where only the best score is asked for


def is_whole(query: Query) -> bool:
    """True if the photo shows nearly the whole sphere, upright or at a known tilt."""
    return query.settings.gravity != "unknown" and query.photo.small.valid_share >= WHOLE


def brief_query(query: Query) -> Query:
    """The query from few starts."""
    settings = replace(query.settings, max_starts=min(FIRST_STARTS, query.settings.max_starts))
    return replace(query, settings=settings)


def tilted_query(query: Query) -> Query:
    """The brief query of a whole photo that was searched as upright, now with any tilt.

    In every other cell of the grid, by few rotations. Tilted photos that hide nothing are found so, others by
    their features.
    """
    brief = brief_query(query)
    cells = np.floor(query.scan_map.centers[query.scan_map.sparse] / COARSE_SPACING).astype(np.int64)
    is_even = (cells.sum(axis=1) % 2 == 0) | (len(cells) < FEW_CELLS)
    settings = replace(brief.settings, num_rotations=min(FIRST_ROTATIONS, query.settings.num_rotations))
    return replace(brief, scan_map=query.scan_map.narrowed(is_even), settings=settings)


def is_rather_mirrored(query: Query, starts: Starts, of_mirror: float) -> bool:
    """True if the mirrored photo, by its `mirror_score`, fits nearly as well as the photo itself."""
    return first_score(query, starts) < MIRROR_RATIO * of_mirror


def mirror_score(query: Query) -> float:
    """The first score of the mirrored photo, by a search of its own."""
    mirror = mirrored(query)
    return first_score(mirror, search_poses(mirror, "known"))


def first_score(query: Query, starts: Starts) -> float:
    """The best score after a short descent from the best starts on their candidates' prepared views."""
    some = starts.take(np.arange(min(NUM_SCORED, len(starts.candidate))))
    image = query.photo.images.search()
    _, scores = descend_all(query.scan_map, image, some, FIRST_ITERATIONS, query.workers)
    return float(scores.max(initial=0.0))


def mirrored(query: Query) -> Query:
    """The query of the photo turned over, left for right, for a first score; no heading is known of it."""
    across = np.diag([1.0, -1.0, 1.0])
    prior = replace(query.settings.prior, heading_deg=None)
    settings = replace(query.settings, prior=prior, max_starts=min(NUM_SCORED, query.settings.max_starts))
    images = query.photo.images._replace(search=Once(partial(turned_over, query.photo.images.search)))
    level = across @ query.photo.R_cam_from_level @ across
    photo = replace(query.photo, images=images, R_cam_from_level=level)
    return replace(query, photo=photo, settings=settings)


def turned_over(image: Once[Texels]) -> Texels:
    """An image with left and right exchanged."""
    texels = image()
    across = texels.rgbx.reshape(-1, texels.width + 2)[:, ::-1]
    return Texels(np.ascontiguousarray(across).reshape(-1), texels.width)
