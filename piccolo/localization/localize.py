"""The default method, one line a step: localize one panorama in a prepared map."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES, Hypothesis
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import Array, is_correct
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..panorama.manhattan import find_axes
from ..scan_map.scan_map import ScanMap
from .attempts import plan_attempts, search_beyond_prior
from .focal_length import WIDE, FocalFit, calibrate, change_camera
from .judge import judge, reconsider
from .last_descent import HOPELESS_SCORE, refine_to_the_end
from .prior import apply_prior, nothing_allowed
from .query import Query, prepare_query
from .selection import Selection
from .settings import METHOD, CoarseToFineSettings, MethodConfig
from .shape import Aligned, align_level, find_tilts, is_explained, is_tilt_known

GUESSES = (
    0.0,
    -0.15,
    0.15,
)  # added to the log of the focal length: one comes near enough to any that is 20 % off
NO_PIXEL = "the panorama: no pixel counts, all are masked"


class Found(NamedTuple):
    """The poses found for a photo, refined."""

    query: Query
    selection: Selection
    fit: FocalFit | None  # of a photo whose focal length is not exact


@one_blas_thread
def localize(
    scan_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
    method: MethodConfig = METHOD,
) -> Localization:
    """Localize a panorama: search until one attempt is sure, refine the best poses, judge the best one."""
    found = find_pose(scan_map, panorama, settings, workers, watch, method)
    if isinstance(found, Localization):
        return found
    with watch.stage("refine"):
        return judge(*found)


def find_pose(
    scan_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
    method: MethodConfig = METHOD,
) -> Found | Localization:
    """Search and refine, as `localize`; a result says why nothing can be searched."""
    allowed_map = apply_prior(scan_map, settings.prior)
    if len(allowed_map.sparse) == 0:
        return Localization(warnings=(nothing_allowed(scan_map, settings.prior),))
    if not panorama.is_valid.any():
        return Localization(warnings=(NO_PIXEL,))
    if not scan_map.has_shape:
        return find_once(scan_map, allowed_map, panorama, settings, workers, watch, method)
    axes = find_axes(panorama)
    yaw_of_walls = scan_map.yaw_of_walls
    level = align_level(yaw_of_walls, panorama, axes, settings)

    def search(one: Aligned) -> Found:
        return find_once(scan_map, allowed_map, panorama, one.settings, workers, watch, method, one.rotations)

    found = [search(level)]  # most cameras are about level
    if not is_tilt_known(panorama, settings) and not is_explained(found[0].selection, level):
        with watch.stage("search"):
            tilts = find_tilts(allowed_map, yaw_of_walls, panorama, axes, settings, workers, method)
        found += [search(tilt) for tilt in tilts]
    best = max(found, key=lambda one: one.selection.best.score)
    if len(level.rotations) == 0 or is_explained(best.selection, level):
        return best
    in_any_heading = search(level._replace(rotations=level.rotations[:0]))
    return max([best, in_any_heading], key=lambda one: one.selection.best.score)


def find_once(
    scan_map: ScanMap,
    allowed_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
    method: MethodConfig,
    rotations: Array | None = None,
) -> Found:
    """Search what the prior allows of a map, or some rotations (N, 3, 3) there, and refine."""
    with watch.stage("search"):
        query = prepare_query(panorama, allowed_map, settings, workers, method, rotations)
    images = query.photo.images
    # idle cores prepare the images that later steps need
    with workers.beside(images.middle, images.fine, images.full, query.photo.colors):
        hypotheses: list[Hypothesis] = []
        for num_parts, attempt in plan_attempts(query):
            query = replace(query, num_parts=num_parts)
            hypotheses, is_enough = attempt(query, hypotheses, watch)
            if is_enough:
                break
        hypotheses += search_beyond_prior(query, scan_map, watch)
        with watch.stage("refine"):
            return finish(query, hypotheses)


def finish(query: Query, hypotheses: Sequence[Hypothesis]) -> Found:
    """Refine the best of several poses to the end, with the focal length if that is not exact."""
    found = refine_to_the_end(query, hypotheses)
    if query.photo.given.focal_prior is None or found.best.score < HOPELESS_SCORE:
        return Found(query, found, None)
    return Found(*calibrate(query, found))


def has_guessed_focal(panorama: Panorama) -> bool:
    """Return True if the focal length is a guess, so that `localize_guessed` should try several."""
    return panorama.focal_prior is not None and panorama.focal_prior.deviation > WIDE


def localize_guessed(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Localize a photo with several focal lengths around a guess, and return the most confident result."""
    camera = panorama.cameras[0].camera
    width = panorama.rgb.shape[1]
    taken = [panorama.resample(change_camera(camera, np.array([guess])), width) for guess in GUESSES]
    return select_likeliest(
        [localize(scan_map, photo, settings, workers, watch) for photo in taken], settings
    )


def select_likeliest(found: Sequence[Localization], settings: CoarseToFineSettings) -> Localization:
    """Return the most confident of several results, its confidence reduced by results at other poses."""
    ranked = sorted(found, key=lambda f: -f.confidence)
    best = ranked[0]
    others_found: list[Localization] = []
    for other in ranked[1:]:
        if (
            other.pose
            and other.evidence
            and not any(is_correct(f.pose, other.pose) for f in (best, *others_found))
        ):
            others_found.append(other)
    total = best.confidence + sum(f.confidence for f in others_found)
    if total <= best.confidence:
        return best
    fraction = best.confidence / total
    others = [
        Alternative(f.pose, f.evidence.score, f.evidence.num_matches, f.confidence)
        for f in others_found
        if f.pose and f.evidence
    ]
    listed = replace(best, alternatives=(*others, *best.alternatives)[:MAX_ALTERNATIVES])
    return reconsider(listed, fraction, settings.min_confidence)
