"""The default method, one line a step: localize one panorama in a prepared map."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ..confidence.alternatives import MAX_ALTERNATIVES, Hypothesis
from ..confidence.confidence import LOCALIZED
from ..confidence.localization import Alternative, FocalLength, Localization
from ..geometry.nearness import CONFIRMED
from ..geometry.pose import Pose
from ..jobs.threads import Stopwatch, Workers, one_blas_thread
from ..judge.belief import NOTHING, make_belief
from ..judge.reasons import Reason
from ..judge.together import share_place
from ..panorama import Panorama
from ..panorama.edges import find_axes
from ..scan_map.scan_map import ScanMap
from .attempts import plan_attempts, search_beyond_prior
from .focal_length import WIDE, FocalFit, calibrate
from .judge import judge
from .last_descent import is_faint, refine_best
from .prior import apply_prior, nothing_allowed
from .query import Query, prepare_query
from .selection import Selection
from .settings import CoarseToFineSettings
from .shape import align_level, find_tilts, is_explained, is_tilt_known
from .sphere import SphereFit, calibrate_sphere

GUESSES = (
    0.0,
    -0.15,
    0.15,
)  # added to the log of the focal length: one comes near enough to any that is 20 % off
MOST_RANGE = 10.0  # [m] of what is seen: a pose moves by this times the change of the focal length's log
NO_PIXEL = "the panorama: no pixel counts, all are masked"


class Found(NamedTuple):
    """The poses found for a photo, refined."""

    query: Query
    selection: Selection
    fit: FocalFit | SphereFit | None  # None if the poses are faint, or nothing was fitted


@one_blas_thread()
def localize(
    scan_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
) -> Localization:
    """Localize a panorama: search until one attempt is sure, refine the best poses, judge the best one."""
    with watch.stage("search"):
        query = prepare_search(scan_map, panorama, settings, workers)
        if isinstance(query, Localization):
            return query
        query.photo.images.search()  # each search begins with it
    search = find_by_edges if query.evidence == "shape" else find
    found = search(query, scan_map, watch)
    with watch.stage("refine"):
        return judge(found.query, found.selection, found.fit)


def prepare_search(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, workers: Workers
) -> Query | Localization:
    """Prepare a panorama for the search where the prior allows; a result says why nothing is searched."""
    allowed_map = apply_prior(scan_map, settings.prior)
    if len(allowed_map.sparse) == 0:
        is_told = len(scan_map.centers) > 0  # else the scan has no position at all
        belief = NOTHING.rule_out(Reason.NOWHERE) if is_told else NOTHING
        return Localization(belief=belief, warnings=(nothing_allowed(scan_map, settings.prior),))
    if not panorama.is_valid.any():
        return Localization(warnings=(NO_PIXEL,))
    return prepare_query(panorama, allowed_map, settings, workers)


def find(query: Query, scan_map: ScanMap, watch: Stopwatch) -> Found:
    """Search until one attempt is sure, and refine the best poses to the end.

    The query has the part of the map that its prior allows.
    """
    images = query.photo.images
    # idle cores prepare the images that later steps need
    with query.workers.beside(images.middle, images.fine, images.full, query.colors):
        hypotheses: list[Hypothesis] = []
        asked = query
        for asked, attempt in plan_attempts(query):
            hypotheses, is_enough = attempt(asked, hypotheses, watch)
            if is_enough:
                break
        hypotheses += search_beyond_prior(asked, scan_map, watch)
        with watch.stage("refine"):
            return fit_camera(asked, refine_best(asked, hypotheses))


def find_by_edges(query: Query, scan_map: ScanMap, watch: Stopwatch) -> Found:
    """Find the poses of a photo in a scan without colours, at one tilt of the camera after another."""
    axes = find_axes(query.source)
    yaw_of_walls = scan_map.yaw_of_walls
    level = align_level(query, axes, yaw_of_walls)
    found = [find(level, scan_map, watch)]  # most cameras are about level
    if not is_tilt_known(query) and not is_explained(found[0].selection, level):
        with watch.stage("search"):
            tilts = find_tilts(query, axes, yaw_of_walls)
        found += [find(tilt, scan_map, watch) for tilt in tilts]
    best = max(found, key=lambda one: one.selection.best.score)
    if level.rotations is None or is_explained(best.selection, level):
        return best
    in_any_heading = find(level.with_rotations(None), scan_map, watch)
    return max([best, in_any_heading], key=lambda one: one.selection.best.score)


def fit_camera(query: Query, found: Selection) -> Found:
    """Compare what a photo says of its geometry with the scan, and refine the poses, unless they are faint.

    Photos of several cameras are taken as they say; so are edges, which lie beside those of the scan.
    """
    if is_faint(query, found):
        return Found(query, found, None)
    if query.given.focal_prior is not None:
        return Found(*calibrate(query, found))
    if query.given.cameras or query.scan_map.has_shape:
        return Found(query, found, None)
    return Found(*calibrate_sphere(query, found))


def has_guessed_focal(panorama: Panorama) -> bool:
    """Return True if the focal length is a guess, so that `localize_guessed` should try several."""
    return panorama.focal_prior is not None and panorama.focal_prior.deviation > WIDE


def localize_guessed(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Localize a photo with several focal lengths around a guess, until one result is sure."""
    camera = panorama.cameras[0].camera
    width = panorama.rgb.shape[1]
    found: list[Localization] = []
    for guess in GUESSES:
        photo = panorama.resample(camera.change(guess), width)
        found.append(localize(scan_map, photo, settings, workers, watch))
        if found[-1].status == LOCALIZED:
            break
    return select_likeliest(found, settings)


def is_same_place(one: Localization, pose: Pose, focal: FocalLength | None) -> bool:
    """Return True if a pose is a result's up to a move along the view that their focal lengths explain."""
    if one.pose is None:
        return False
    change = math.log(focal.px / one.focal_length.px) if focal and one.focal_length else 0.0
    offset = pose.center_world - one.pose.center_world
    ahead = one.pose.R_cam_from_world[0]
    along = float(offset @ ahead)
    moved = Pose(pose.R_cam_from_world, pose.center_world - along * ahead)
    return abs(along) < CONFIRMED.distance + MOST_RANGE * abs(change) and CONFIRMED.holds(one.pose, moved)


def select_likeliest(found: Sequence[Localization], settings: CoarseToFineSettings) -> Localization:
    """Return the most confident of several results, its confidence reduced by results at other places."""
    places: list[Localization] = []
    for one in sorted(found, key=lambda f: -f.confidence):
        if not any(one.pose is None or is_same_place(f, one.pose, one.focal_length) for f in places):
            places.append(one)
    best, *elsewhere = places
    others = [
        (Alternative(f.pose, f.evidence.score, f.evidence.num_matches), f.confidence)
        for f in elsewhere
        if f.pose and f.evidence
    ]
    if not any(confidence for _, confidence in others):
        return best
    factor, shared = share_place(best.belief, [best.confidence, *(confidence for _, confidence in others)])
    own = [
        (alternative, factor * place)
        for alternative, place in zip(best.alternatives, best.belief.place[1:-1], strict=True)
        if not any(CONFIRMED.holds(other.pose, alternative.pose) for other, _ in others)
    ]
    listed = [*zip([other for other, _ in others], shared, strict=True), *own][:MAX_ALTERNATIVES]
    alternatives = tuple(alternative for alternative, _ in listed)
    belief = make_belief([factor * best.belief.place[0], *(p for _, p in listed)])
    belief = replace(best.belief, place=belief.place)
    return replace(best, alternatives=alternatives).take_belief(belief, settings.min_confidence)
