"""The default method in order, one line a step: one panorama in a prepared map."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import compress

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import CLEAR_MATCHES
from ..confidence.localization import Localization
from ..geometry.pose import Pose
from ..geometry.rotations import Gravity
from ..jobs.blas import one_blas_thread
from ..jobs.once import Once
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..local_features.hypotheses import count_matches, poses_of
from ..panorama import Panorama
from ..scan_map.prior import NOTHING_KNOWN
from ..scan_map.scan_map import ScanMap
from .config import METHOD, Beam, MethodConfig
from .evaluation import evaluate, surroundings_of
from .first_look import FIRST_BEAM, first_query, is_clear, is_whole, mirror_score, tilted_query
from .focal_length import FocalFit, fit_focal, recalibrated
from .prior import apply_prior, contradictions, nothing_allowed
from .query import Query, prepare_query
from .refinement import compared, refine, refine_full_resolution, refine_matched, refine_unoccluded, settle
from .search import search_poses
from .search_result import NEAR_RATIO, SURE_MATCHES, SearchResult, found_among
from .settings import CoarseToFineSettings
from .standings import fairly_selected
from .starts import Starts

NUM_MATCHED = 6  # poses from matches that are refined
ALTERNATIVES_COMPARED, ALTERNATIVES_REFINED = 8, 4  # at most
MAX_CALIBRATIONS = 4  # fits of a focal length
HOPELESS_SCORE = 0.02  # of black, white and noisy pictures, and of most views of other places
FAINT_SCORE, FAINT_MATCHES = 0.1, 6  # nothing that has less of both is ever localized
NEAR_MATCHES = 0.5  # an alternative with this part of the matches is refined as carefully as the best
GRAVITIES: dict[str, tuple[Gravity, ...]]  # in which whole views are searched, one after the other
GRAVITIES = {"known": ("known",), "unknown": ("unknown",), "auto": ("known", "unknown")}
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
    """Where the panorama was taken: search, refine, match features, compare with the alternatives, evaluate.

    A whole upright sphere that is clear by whole views needs no more. Else come the poses that matches vote
    for, and where they leave doubt, whole views: with the gravity `auto` as known, then as unknown (briefly,
    of a whole sphere), until one is sure.
    """
    candidates = apply_prior(scan_map, settings.prior)
    if len(candidates.sparse) == 0 or not panorama.is_valid.any():
        is_masked = len(candidates.sparse) > 0
        why = NO_PIXEL if is_masked else nothing_allowed(scan_map, settings.prior)
        return Localization(warnings=(why,))
    with watch.stage("search"):
        query = prepare_query(panorama, candidates, settings, workers, method)
    first = first_query(query)
    of_mirror = Once(lambda: mirror_score(first))
    is_looked_at = method.uses_features and method.uses_search and is_whole(query)
    soon = [*query.soon_needed(), of_mirror] if is_looked_at else query.soon_needed()
    with workers.beside(*soon, query.colors):
        hypotheses: list[Hypothesis] = []
        if is_looked_at:
            starts, hypotheses = searched(first, "known", FIRST_BEAM, watch)
            with watch.stage("search"):
                query = first if is_clear(first, starts, hypotheses, of_mirror) else query
        if query.by_features:
            query, hypotheses = in_doubt(query, hypotheses, is_looked_at, watch)
        if settings.prior != NOTHING_KNOWN and method.uses_search:
            hypotheses = hypotheses + beyond_prior(query, scan_map, watch)
        with watch.stage("refine"):
            found = finished(query, hypotheses)
            if panorama.focal_prior is None or found.best.score < HOPELESS_SCORE:
                return evaluate(query, panorama, found)
            return evaluate(*calibrated(query, panorama, found))


def in_doubt(
    query: Query, hypotheses: list[Hypothesis], is_looked_at: bool, watch: Stopwatch
) -> tuple[Query, list[Hypothesis]]:
    """The hypotheses of a first look, if one was taken, and those of matches and of whole views.

    And the query, of half of the photo's features where these suffice.
    """
    method, settings = query.method, query.settings
    if method.uses_features:
        with watch.stage("match"):
            query, hypotheses = matched(query, hypotheses)
    for gravity in GRAVITIES[settings.gravity] if method.uses_search else ():
        if is_sure(query, hypotheses):
            break
        is_brief = is_looked_at and gravity == "unknown"
        asked, beam = (tilted_query(query), FIRST_BEAM) if is_brief else (query, method.beam)
        hypotheses = hypotheses + searched(asked, gravity, beam, watch)[1]
    return query, hypotheses


def matched(query: Query, hypotheses: list[Hypothesis]) -> tuple[Query, list[Hypothesis]]:
    """Hypotheses, and the poses that matches vote for: those of half of the views if that leaves no doubt."""
    half = replace(query, num_halves=1)
    poses = matched_poses(half)
    if poses and count_matches(half.matches, poses[0]) >= CLEAR_MATCHES:
        found = hypotheses + refine_matched(half, poses)
        if is_sure(half, found):
            return half, found
    return query, hypotheses + refine_matched(query, matched_poses(query))


def beyond_prior(query: Query, scan_map: ScanMap, watch: Stopwatch) -> list[Hypothesis]:
    """Search a whole photo in all of the map: what the prior leaves must be better than what it excludes."""
    if not is_whole(query):
        return []
    settings = replace(query.settings, prior=NOTHING_KNOWN)
    anywhere = first_query(replace(query, scan_map=scan_map, settings=settings))
    return searched(anywhere, "known", FIRST_BEAM, watch)[1]


def searched(query: Query, gravity: Gravity, beam: Beam, watch: Stopwatch) -> tuple[Starts, list[Hypothesis]]:
    """The starts of a search by whole views, and where they lead."""
    with watch.stage("search"):
        starts = search_poses(query, gravity)
    with watch.stage("refine"):
        return starts, refine(query, starts, beam)


def is_sure(query: Query, hypotheses: Sequence[Hypothesis]) -> bool:
    """True if the best of some hypotheses leaves no doubt."""
    found = fairly_selected(query, found_among(hypotheses, ALTERNATIVES_COMPARED))
    return found.is_sure(count_matches(query.matches, found.best.pose))


def matched_poses(query: Query) -> list[Pose]:
    """Return the poses that matches vote for, best first.

    Where whole views are not asked, only those that the prior allows.
    """
    is_known = query.settings.gravity == "known"
    level = query.R_cam_from_level if is_known else None
    poses = [f.pose for f in poses_of(query.matches, level, NUM_MATCHED, query.workers)]
    if query.method.uses_search:
        return poses
    return [pose for pose in poses if not contradictions(query.scan_map, pose, query.settings.prior)]


def finished(query: Query, hypotheses: Sequence[Hypothesis]) -> SearchResult:
    """The best of some hypotheses, and the best elsewhere, those near it refined to the same end.

    Where all are faint, the best is refined on fine cells by itself first: if it stays so, no more is asked.
    """

    def refined(h: Hypothesis) -> Hypothesis:
        return refine_full_resolution(query, h, 2)

    def matches_of(h: Hypothesis) -> int:
        return count_matches(query.matches, h.pose)

    def is_faint(found: SearchResult) -> bool:
        some = found.best, *found.alternatives
        return all(h.score < FAINT_SCORE and matches_of(h) < FAINT_MATCHES for h in some)

    found = found_among(hypotheses, ALTERNATIVES_COMPARED)
    if found.best.score < HOPELESS_SCORE:
        return found
    if is_faint(found):
        best = refine_unoccluded(query, found.best)[1]
        found = fairly_selected(query, found_among([best, *found.alternatives], ALTERNATIVES_COMPARED))
        if is_faint(found):
            return found
    least = max(NEAR_MATCHES * matches_of(found.best), SURE_MATCHES)
    is_near = [h.score > NEAR_RATIO * found.best.score or matches_of(h) >= least for h in found.alternatives]
    near = list(compress(found.alternatives, is_near))[:ALTERNATIVES_REFINED]
    if not near:
        best = refine_unoccluded(query, found.best)[1]
        return settled(query, found_among([best, *found.alternatives], ALTERNATIVES_COMPARED))
    ends = list(query.workers.map(refined, [found.best, *near], "descend"))
    far = [h for h in found.alternatives if not any(h is other for other in near)]
    return settled(query, fairly_selected(query, found_among([*ends, *far], ALTERNATIVES_COMPARED)))


def calibrated(
    query: Query, panorama: Panorama, found: SearchResult
) -> tuple[Query, Panorama, SearchResult, FocalFit]:
    """Fit the focal length at the best pose, and refine the poses with it, until it is at rest."""
    for k in range(MAX_CALIBRATIONS):
        fit = fit_focal(query, panorama, found.best.pose, is_first=k == 0)
        if fit.is_at_rest:
            break
        query, panorama = recalibrated(query, panorama, fit.change)
        poses = [fit.moved(found.best.pose), *(h.pose for h in found.alternatives)]
        again = partial(compared, query)
        moved = [Hypothesis(pose, 0.0) for pose in poses]
        found = finished(query, list(query.workers.map(again, moved, "compare")))
    else:
        fit = fit_focal(query, panorama, found.best.pose, is_first=False)
    return query, panorama, found, fit


def settled(query: Query, found: SearchResult) -> SearchResult:
    """The same with a best pose that has come to rest, and that is still the best one then."""
    at_rest: list[Hypothesis] = []
    with query.workers.beside(*map(Once, surroundings_of(query, found.best.pose))):  # it hardly moves
        for _ in range(1 + len(found.alternatives)):
            best = settle(query, found.best)
            at_rest.append(best)
            found = fairly_selected(query, replace(found, best=best))
            if any(found.best is h for h in at_rest):
                break
    return found
