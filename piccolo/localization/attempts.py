"""The searches that are tried for a photo, in order, each with its refinement.

A first look by whole views finds most upright photos of the whole sphere, without local features. Only
features show that a photo is mirrored, so the first look briefly searches its mirror image too.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..geometry.pose import Pose
from ..jobs.threads import Once, Stopwatch
from ..local_features.hypotheses import count_matches, propose_poses
from ..photo import NOTHING_KNOWN
from ..scan_map.camera_positions import COARSE_SPACING
from ..scan_map.scan_map import ScanMap
from .beam import brief_query, refine_matches, refine_starts, score_mirror, score_starts
from .comparison import score_pose
from .query import Query
from .search import Tilts, search_poses
from .selection import is_clear, is_sure, rank
from .settings import Beam
from .verification import CHANCE_MATCHES, verify

MIRROR_RATIO = 1.1  # least ratio of first scores, photo to mirrored photo
FIRST_BEAM = Beam(100, 12, 4, 1)
FIRST_ROTATIONS = 1000  # of SO(3)
FEW_CELLS = 200  # of the grid; if a prior leaves fewer, all of them are searched
ENOUGH_MATCHES = 40  # of a part of the features: if the pose is sure, the others are not asked
NUM_MATCHED = 6  # poses from matches that are refined
COS_TILT = math.cos(math.radians(12.0))  # most angle between their vertical and a known one

Poses = tuple[list[Hypothesis], bool]  # hypotheses, and whether they make further attempts needless
# one search with its refinement, which adds to the known hypotheses
Attempt = Callable[[Query, list[Hypothesis], Stopwatch], Poses]


def plan_attempts(query: Query) -> list[tuple[Query, Attempt]]:
    """Return the searches for a photo in order, each with the query of the evidence that it uses.

    A first look by whole views, or the scan drawn at its poses, may settle a whole upright sphere, and a look
    along walls a photo of edges. Then come searches by whole views: with gravity `auto` as known, then as
    unknown (briefly, for a whole sphere). Poses from matches with features of the map, first of a part of the
    photo's views, then of all, come last: those of the map may have to be made. Partial photos, and those of
    any tilt, ask them first. Partial photos are mostly taken about level: with a tilt that is not known
    exactly, "known" searches about level.
    """
    looks_first = bool(query.features) and is_whole(query)
    first: list[tuple[Query, Attempt]] = []
    if looks_first:
        first = [(query.by_views(), look_first), (query.without_features(), draw_found)]
    if query.rotations is not None:
        first.append((query, look_along_walls))
    parts = [query.features[: k + 1] for k in range(len(query.features))]
    by_features: list[tuple[Query, Attempt]] = [
        (replace(query, features=part), search_matches if part is parts[-1] else search_part)
        for part in parts
    ]
    by_views: list[tuple[Query, Attempt]] = []
    asked = query.without_features() if looks_first else query
    is_partial = query.photo.is_partial
    if is_partial or query.settings.gravity != "unknown":
        upright: Tilts = "level" if is_partial and not query.photo.has_tilt else "known"
        by_views.append((asked, partial(search_views, tilts=upright)))
    if query.settings.gravity != "known":
        by_views.append((asked, partial(search_views, tilts="any", is_brief=looks_first)))
    return [*first, *by_views, *by_features] if looks_first else [*first, *by_features, *by_views]


def look_first(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Poses:
    """Search briefly by whole views; True if one pose alone is clear and beats the mirrored photo."""
    first = brief_query(query)
    of_mirror = Once(score_mirror, query)
    with query.workers.beside(of_mirror):
        with watch.stage("search"):
            starts = search_poses(first, "known")
        with watch.stage("refine"):
            found = known + refine_starts(first, starts, FIRST_BEAM)
            return found, is_clear(query, found) and score_starts(first, starts) >= MIRROR_RATIO * of_mirror()


def draw_found(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Poses:
    """Draw the scan at the poses that were found; True if the best is sure."""
    with watch.stage("refine"):
        return known, is_sure(query, known)


def look_along_walls(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Poses:
    """Search the few rotations of a photo whose lines lie along walls; True if one pose alone is clear."""
    refined = search_and_refine(query, "known", FIRST_BEAM, watch)
    with watch.stage("refine"):
        found = known + refined
        return found, is_clear(query, found)


def search_part(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Poses:
    """Search by a part of the features; its poses are dropped unless they are sure: all find better ones."""
    poses = match_poses(query, watch)
    if not poses or count_matches(query.matches, poses[0]) < ENOUGH_MATCHES:
        return known, False
    found, is_enough = refine_matched(query, poses, known, watch)
    return found if is_enough else known, is_enough


def search_matches(query: Query, known: list[Hypothesis], watch: Stopwatch) -> Poses:
    """Refine the poses that feature matches vote for; True if the result is sure."""
    return refine_matched(query, match_poses(query, watch), known, watch)


def refine_matched(query: Query, poses: list[Pose], known: list[Hypothesis], watch: Stopwatch) -> Poses:
    """Add poses from matches, refined; True if the best is sure."""
    with watch.stage("match"):
        found = known + add_verified(query, refine_matches(query, poses))
        return found, is_sure(query, found)


def search_views(
    query: Query, known: list[Hypothesis], watch: Stopwatch, tilts: Tilts, is_brief: bool = False
) -> Poses:
    """Search by whole views and refine; True if the result is sure."""
    asked = thin_query(query) if is_brief else query
    refined = search_and_refine(asked, tilts, FIRST_BEAM if is_brief else query.beam, watch)
    with watch.stage("refine"):
        found = known + add_verified(query, refined)
        return found, is_sure(query, found)


def search_and_refine(query: Query, tilts: Tilts, beam: Beam, watch: Stopwatch) -> list[Hypothesis]:
    """Search by whole views, and refine the starts to a few poses."""
    with watch.stage("search"):
        starts = search_poses(query, tilts)
    with watch.stage("refine"):
        return refine_starts(query, starts, beam)


def add_verified(query: Query, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """Verify the hypotheses of a photo of a part of the sphere; add poses refined on many matches."""
    if not query.photo.is_partial or not hypotheses:
        return hypotheses
    found = rank(hypotheses)
    poses = [h.pose for h in (found.best, *found.alternatives)]
    verified = query.workers.map(partial(verify, query), poses, "verify")
    refined = [v.pose for v in verified if v.num_matches > CHANCE_MATCHES]
    return [*hypotheses, *query.workers.map(partial(score_pose, query), refined, "compare")]


def search_beyond_prior(query: Query, scan_map: ScanMap, watch: Stopwatch) -> list[Hypothesis]:
    """Search a whole photo without the prior: poses that agree with it must beat those that it excludes."""
    is_asked = not query.settings.prior.is_empty and is_whole(query)
    if not is_asked:
        return []
    settings = replace(query.settings, prior=NOTHING_KNOWN)
    anywhere = brief_query(replace(query, scan_map=scan_map, settings=settings))
    return search_and_refine(anywhere, "known", FIRST_BEAM, watch)


def match_poses(query: Query, watch: Stopwatch) -> list[Pose]:
    """Return poses from feature matches, best first."""
    if query.scan_map.awaits_features:
        with watch.stage("prepare"):
            query.scan_map.features_now(query.workers)
    is_level = query.settings.gravity == "known" and (query.photo.has_tilt or not query.photo.is_partial)
    up_cam = query.photo.R_cam_from_level[:, 2]
    with watch.stage("match"):
        poses = [f.pose for f in propose_poses(query.matches, NUM_MATCHED, query.workers)]
    return [pose for pose in poses if not is_level or pose.R_cam_from_world[:, 2] @ up_cam >= COS_TILT]


def is_whole(query: Query) -> bool:
    """Return True if the photo shows nearly the whole sphere, upright or at a known tilt."""
    return query.settings.gravity != "unknown" and not query.photo.is_partial


def thin_query(query: Query) -> Query:
    """Return a brief query with any tilt, for a whole photo that was searched as upright.

    It searches every other cell of the grid, with few rotations. That finds tilted photos without occluders;
    features find the others.
    """
    brief = brief_query(query)
    cells = np.floor(query.scan_map.centers[query.scan_map.sparse] / COARSE_SPACING).astype(np.int64)
    is_even = (cells.sum(axis=1) % 2 == 0) | (len(cells) < FEW_CELLS)
    settings = replace(brief.settings, num_rotations=min(FIRST_ROTATIONS, query.settings.num_rotations))
    return replace(brief, scan_map=query.scan_map.narrow(is_even), settings=settings)
