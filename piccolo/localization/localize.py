"""The default method in order, one line a step: one panorama in a prepared map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES, Hypothesis
from ..confidence.confidence import CLEAR_MATCHES, classify
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import Pose, is_correct
from ..geometry.rotations import Gravity
from ..jobs.blas import one_blas_thread
from ..jobs.once import Once
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..local_features.hypotheses import count_matches, poses_of
from ..local_features.keypoints import HALVES
from ..panorama import Panorama
from ..scan_map.prior import NOTHING_KNOWN
from ..scan_map.scan_map import ScanMap
from .evaluation import evaluate
from .first_look import FIRST_BEAM, brief_query, is_rather_mirrored, is_whole, mirror_score, tilted_query
from .focal_length import WIDE, calibrate, change_camera
from .last_descent import HOPELESS_SCORE, refine_to_the_end
from .prior import apply_prior, contradictions, nothing_allowed
from .query import Query, prepare_query
from .refinement import refine, refine_matches
from .search import search_poses
from .selection import is_clear, is_sure
from .settings import METHOD, CoarseToFineSettings, MethodConfig

NUM_MATCHED = 6  # poses from matches that are refined
GUESSES = (0.0, -0.15, 0.15)  # of the logarithm of a focal length: a fifth off is within reach of one of them
ALL_HALVES = len(HALVES)
NO_PIXEL = "the panorama: no pixel counts, all are masked"


@one_blas_thread
def localize(
    scan_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
    method: MethodConfig = METHOD,
) -> Localization:
    """Where a panorama was taken: attempts until one is sure; the best, refined to the end, is evaluated."""
    candidates = apply_prior(scan_map, settings.prior)
    if len(candidates.sparse) == 0:
        return Localization(warnings=(nothing_allowed(scan_map, settings.prior),))
    if not panorama.is_valid.any():
        return Localization(warnings=(NO_PIXEL,))
    with watch.stage("search"):
        query = prepare_query(panorama, candidates, settings, workers, method)
    images = query.photo.images
    with workers.beside(images.middle, images.fine, images.full, query.photo.colors):
        hypotheses: list[Hypothesis] = []
        for attempt in attempts_for(query):
            query = replace(query, num_halves=attempt.num_halves)
            hypotheses, is_enough = attempt.run(query, attempt, hypotheses, watch)
            if is_enough:
                break
        hypotheses += search_beyond_prior(query, scan_map, watch)
        with watch.stage("refine"):
            found = refine_to_the_end(query, hypotheses)
            if panorama.focal_prior is None or found.best.score < HOPELESS_SCORE:
                return evaluate(query, found)
            return evaluate(*calibrate(query, found))


Found = tuple[list[Hypothesis], bool]  # and whether no more attempts need be made


class Attempt(NamedTuple):
    """One search with its refinement."""

    run: Callable[[Query, "Attempt", list[Hypothesis], Stopwatch], Found]  # which adds to what is known
    num_halves: int  # of the photo's features that are asked; 0: whole views alone
    gravity: Gravity = "known"  # with which whole views are searched
    is_brief: bool = False  # whole views from few starts


def attempts_for(query: Query) -> list[Attempt]:
    """Searches for a photo, in order, each to be made where those before leave doubt.

    A whole upright sphere that is clear by whole views needs no more. Else come the poses that matches vote
    for, of half of the views first, and then whole views: with the gravity `auto` as known, then as unknown
    (briefly, of a whole sphere).
    """
    method = query.method
    looks_first = method.uses_features and method.uses_search and is_whole(query)
    attempts = [Attempt(look_first, 0)] if looks_first else []
    if method.uses_features:
        attempts += [Attempt(search_matches, num_halves) for num_halves in (1, ALL_HALVES)]
    if method.uses_search and query.settings.gravity != "unknown":
        attempts.append(Attempt(search_views, ALL_HALVES))
    if method.uses_search and query.settings.gravity != "known":
        attempts.append(Attempt(search_views, ALL_HALVES, "unknown", is_brief=looks_first))
    return attempts


def look_first(query: Query, attempt: Attempt, known: list[Hypothesis], watch: Stopwatch) -> Found:
    """Where brief whole views lead; True if one pose explains the photo, no other does, nor its mirror."""
    first = brief_query(query)
    of_mirror = Once(partial(mirror_score, query))
    with query.workers.beside(of_mirror):
        with watch.stage("search"):
            starts = search_poses(first, attempt.gravity)
        with watch.stage("refine"):
            found = known + refine(first, starts, FIRST_BEAM)
            return found, is_clear(query, found) and not is_rather_mirrored(first, starts, of_mirror())


def search_matches(query: Query, attempt: Attempt, known: list[Hypothesis], watch: Stopwatch) -> Found:
    """Hypotheses, and the poses that matches vote for; True if these leave no doubt.

    Half of the features count for nothing if they leave any: all give the same poses then, and better ones.
    """
    with watch.stage("match"):
        poses = matched_poses(query)
        is_half = attempt.num_halves < ALL_HALVES
        if is_half and (not poses or count_matches(query.matches, poses[0]) < CLEAR_MATCHES):
            return known, False
        found = known + refine_matches(query, poses)
        is_enough = is_sure(query, found)
        return known if is_half and not is_enough else found, is_enough


def search_views(query: Query, attempt: Attempt, known: list[Hypothesis], watch: Stopwatch) -> Found:
    """Hypotheses, and where whole views lead; True if these leave no doubt."""
    asked = tilted_query(query) if attempt.is_brief else query
    with watch.stage("search"):
        starts = search_poses(asked, attempt.gravity)
    with watch.stage("refine"):
        found = known + refine(asked, starts, FIRST_BEAM if attempt.is_brief else query.method.beam)
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
    """Return the poses that matches vote for, best first.

    Where whole views are not asked, only those that the prior allows.
    """
    level = query.photo.R_cam_from_level if query.settings.gravity == "known" else None
    poses = [f.pose for f in poses_of(query.matches, level, NUM_MATCHED, query.workers)]
    if query.method.uses_search:
        return poses
    return [pose for pose in poses if not contradictions(query.scan_map, pose, query.settings.prior)]


def has_guessed_focal(panorama: Panorama) -> bool:
    """True for a photo whose focal length is a guess: `localize_guessed` is to be asked."""
    return panorama.focal_prior is not None and panorama.focal_prior.deviation > WIDE


def localize_guessed(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Localize a photo whose focal length is a guess with several, and return the likeliest result."""
    camera = panorama.cameras[0].camera
    width = panorama.rgb.shape[1]
    taken = [panorama.retaken(change_camera(camera, np.array([guess])), width) for guess in GUESSES]
    return likeliest([localize(scan_map, photo, settings, workers, watch) for photo in taken], settings)


def likeliest(found: Sequence[Localization], settings: CoarseToFineSettings) -> Localization:
    """Return the most confident of several results; it shares its probability with those of other poses."""
    ranked = sorted(found, key=lambda f: -f.confidence)
    best = ranked[0]
    rivals: list[Localization] = []
    for other in ranked[1:]:
        if other.pose and other.evidence and not any(is_correct(f.pose, other.pose) for f in (best, *rivals)):
            rivals.append(other)
    total = best.confidence + sum(f.confidence for f in rivals)
    if total <= best.confidence:
        return best
    share = best.confidence / total
    others = [
        Alternative(f.pose, f.evidence.score, None, f.evidence.num_matches, share * f.confidence)
        for f in rivals
        if f.pose and f.evidence
    ]
    listed = [*others, *best.alternatives][:MAX_ALTERNATIVES]
    confidence = share * best.confidence
    none = 1.0 - confidence - sum(a.probability or 0.0 for a in listed)
    probabilities = np.array([confidence, *(a.probability or 0.0 for a in listed), none])
    status = classify(probabilities, settings.min_confidence)
    return replace(
        best, status=status, confidence=confidence, probability_none=none, alternatives=tuple(listed)
    )
