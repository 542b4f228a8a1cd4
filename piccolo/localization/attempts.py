"""Searches for a photo, each with its refinement, in the order in which they are tried.

Most photos of the whole sphere, upright, need no local features: a first look by whole views finds them. That
a photo is mirrored, features would tell: its mirrored picture is searched too, as far as is cheap.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import CLEAR_MATCHES
from ..geometry.pose import Pose
from ..geometry.rotations import Gravity
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Once
from ..local_features.hypotheses import count_matches, poses_of
from ..local_features.keypoints import HALVES
from ..panorama.texels import Texels
from ..scan_map.camera_positions import COARSE_SPACING
from ..scan_map.prior import NOTHING_KNOWN
from ..scan_map.scan_map import ScanMap
from .prior import contradictions
from .query import Query
from .refinement import FIRST_ITERATIONS, descend_all, refine, refine_matches
from .search import Starts, search_poses
from .selection import is_clear, is_sure
from .settings import Beam

WHOLE = 0.9  # of the sphere that the photo shows, at least
MIRROR_RATIO = 1.1  # of the first scores, the photo as it is by its mirrored picture
FIRST_STARTS = 300  # few: what is clear is found by them
FIRST_BEAM = Beam(100, 12, 4, 1)
FIRST_ROTATIONS = 1000  # of SO(3)
FEW_CELLS = 200  # of the grid: fewer, which a prior has left, are all searched
NUM_SCORED = 64  # starts, where only the best score is asked for
ALL_HALVES = len(HALVES)
NUM_MATCHED = 6  # poses from matches that are refined

Found = tuple[list[Hypothesis], bool]  # and whether no more attempts need be made
# one search with its refinement, which adds to what is known
Attempt = Callable[[Query, list[Hypothesis], Stopwatch], Found]


def attempts_for(query: Query) -> list[tuple[int, Attempt]]:
    """Searches for a photo, in order, and how many halves of its features each asks: 0, whole views alone.

    A whole upright sphere that is clear by whole views needs no more. Else come the poses that matches vote
    for, of half of the views first, and then whole views: with the gravity `auto` as known, then as unknown
    (briefly, of a whole sphere).
    """
    method = query.method
    looks_first = method.uses_features and method.uses_search and is_whole(query)
    attempts: list[tuple[int, Attempt]] = [(0, look_first)] if looks_first else []
    if method.uses_features:
        attempts += [(num_halves, search_matches) for num_halves in (1, ALL_HALVES)]
    if method.uses_search and query.settings.gravity != "unknown":
        attempts.append((ALL_HALVES, search_views))
    if method.uses_search and query.settings.gravity != "known":
        with_any_tilt = partial(search_views, gravity="unknown", is_brief=looks_first)
        attempts.append((ALL_HALVES, with_any_tilt))
    return attempts


def look_first(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Found:
    """Where brief whole views lead; True if one pose explains the photo, no other does, nor its mirror."""
    first = brief_query(query)
    of_mirror = Once(partial(mirror_score, query))
    with query.workers.beside(of_mirror):
        with watch.stage("search"):
            starts = search_poses(first, "known")
        with watch.stage("refine"):
            found = known + refine(first, starts, FIRST_BEAM)
            return found, is_clear(query, found) and first_score(first, starts) >= MIRROR_RATIO * of_mirror()


def search_matches(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Found:
    """Hypotheses, and the poses that matches vote for; True if these leave no doubt.

    Half of the features count for nothing if they leave any: all give the same poses then, and better ones.
    """
    with watch.stage("match"):
        poses = matched_poses(query)
        is_half = query.num_halves < ALL_HALVES
        if is_half and (not poses or count_matches(query.matches, poses[0]) < CLEAR_MATCHES):
            return known, False
        found = known + refine_matches(query, poses)
        is_enough = is_sure(query, found)
        return known if is_half and not is_enough else found, is_enough


def search_views(
    query: Query,
    known: list[Hypothesis],
    watch: Stopwatch,
    gravity: Gravity = "known",
    is_brief: bool = False,
) -> Found:
    """Hypotheses, and where whole views lead; True if these leave no doubt."""
    asked = tilted_query(query) if is_brief else query
    with watch.stage("search"):
        starts = search_poses(asked, gravity)
    with watch.stage("refine"):
        found = known + refine(asked, starts, FIRST_BEAM if is_brief else query.method.beam)
        return found, is_sure(query, found)


def search_beyond_prior(query: Query, scan_map: ScanMap, watch: Stopwatch) -> list[Hypothesis]:
    """Search a whole photo in all of the map: what the prior leaves must be better than what it excludes."""
    is_asked = query.settings.prior != NOTHING_KNOWN and query.method.uses_search and is_whole(query)
    if not is_asked:
        return []
    settings = replace(query.settings, prior=NOTHING_KNOWN)
    anywhere = brief_query(replace(query, scan_map=scan_map, settings=settings))
    with watch.stage("search"):
        starts = search_poses(anywhere, "known")
    with watch.stage("refine"):
        return refine(anywhere, starts, FIRST_BEAM)


def matched_poses(query: Query) -> list[Pose]:
    """Return the poses that matches vote for, best first; without whole views, what the prior allows."""
    level = query.photo.R_cam_from_level if query.settings.gravity == "known" else None
    poses = [f.pose for f in poses_of(query.matches, level, NUM_MATCHED, query.workers)]
    if query.method.uses_search:
        return poses
    return [pose for pose in poses if not contradictions(query.scan_map, pose, query.settings.prior)]


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
    search = query.photo.images.search()
    rgbx = np.ascontiguousarray(search.rgbx.reshape(-1, search.width + 2)[:, ::-1]).reshape(-1)
    images = query.photo.images._replace(search=Once(lambda: Texels(rgbx, search.width)))
    across = np.diag([1.0, -1.0, 1.0])
    level = across @ query.photo.R_cam_from_level @ across
    photo = replace(query.photo, images=images, R_cam_from_level=level)
    prior = replace(query.settings.prior, heading_deg=None)
    settings = replace(query.settings, prior=prior, max_starts=min(NUM_SCORED, query.settings.max_starts))
    return replace(query, photo=photo, settings=settings)
