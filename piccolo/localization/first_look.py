"""The first look: a photo of the whole sphere, upright, is compared with whole views alone.

Most such photos fit one view and no other, and need no local features. What these would tell more is whether
the photo is mirrored: its mirrored picture is searched too, as far as that is cheap.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..jobs.once import Once
from ..scan_map.camera_positions import COARSE_SPACING
from .config import Beam
from .query import Query
from .refinement import NUM_SCORED, first_score
from .search import search_poses
from .search_result import found_among
from .standings import fairly_selected
from .starts import Starts

WHOLE = 0.9  # of the sphere that the photo shows, at least
CLEAR_SCORE, CLEAR_MARGIN = 0.3, 0.5  # at least, see docs/METHOD.md
MIRROR_RATIO = 1.1  # of the first scores, the photo as it is by its mirrored picture
NUM_COMPARED = 8
FIRST_STARTS, FIRST_BEAM = 300, Beam(100, 12, 4, 1)  # few: what is clear is found by them
FIRST_ROTATIONS = 1000  # of SO(3)
FEW_CELLS = 200  # of the grid: fewer, which a prior has left, are all searched


def is_whole(query: Query) -> bool:
    """True if the photo shows nearly the whole sphere, upright or at a known tilt."""
    return query.settings.gravity != "unknown" and query.photo.valid_share >= WHOLE


def first_query(query: Query) -> Query:
    """The query as it is first asked: by whole views alone, from few starts."""
    settings = replace(query.settings, max_starts=min(FIRST_STARTS, query.settings.max_starts))
    return replace(query, settings=settings, num_halves=0)


def tilted_query(query: Query) -> Query:
    """The query of a whole photo that was searched as upright, as it is then asked with any tilt: briefly.

    In every other cell of the grid, by few rotations, from few starts. Tilted photos that hide nothing are
    found so, others by their features.
    """
    scan_map, settings = query.scan_map, query.settings
    cells = np.floor(scan_map.centers[scan_map.sparse] / COARSE_SPACING).astype(np.int64)
    is_even = (cells.sum(axis=1) % 2 == 0) | (len(cells) < FEW_CELLS)
    num_rotations = min(FIRST_ROTATIONS, settings.num_rotations)
    settings = replace(
        settings, max_starts=min(FIRST_STARTS, settings.max_starts), num_rotations=num_rotations
    )
    return replace(query, scan_map=scan_map.narrowed(is_even), settings=settings)


def is_clear(query: Query, starts: Starts, hypotheses: Sequence[Hypothesis], of_mirror: Once[float]) -> bool:
    """True if one pose explains a whole photo, no other does, and the mirrored photo fits worse.

    `of_mirror` is its `mirror_score`.
    """
    found = fairly_selected(query, found_among(hypotheses, NUM_COMPARED))
    if found.best.score < CLEAR_SCORE or found.margin < CLEAR_MARGIN:
        return False
    return not is_rather_mirrored(query, starts, of_mirror())


def is_rather_mirrored(query: Query, starts: Starts, of_mirror: float) -> bool:
    """True if the mirrored photo fits nearly as well, by the first scores from the starts of the photo."""
    return first_score(query, starts) < MIRROR_RATIO * of_mirror


def mirror_score(query: Query) -> float:
    """The first score of the mirrored photo, by a search of its own."""
    mirror = mirrored(query)
    return first_score(mirror, search_poses(mirror, "known"))


def mirrored(query: Query) -> Query:
    """The query of the photo turned over, left for right, for a first score; no heading is known of it."""
    across, prior = np.diag([1.0, -1.0, 1.0]), replace(query.settings.prior, heading_deg=None)
    settings = replace(query.settings, prior=prior, max_starts=min(NUM_SCORED, query.settings.max_starts))
    level = across @ query.R_cam_from_level @ across
    return replace(query, images=query.images.mirrored(), R_cam_from_level=level, settings=settings)
