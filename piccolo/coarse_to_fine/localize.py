"""The default method in order, one line a step: one panorama in a prepared map."""

import itertools
from dataclasses import replace
from typing import Literal

from ..confidence.alternatives import Hypothesis, alternative_poses, by_score
from ..confidence.localization import Localization
from ..panorama import Panorama
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .config import METHOD, MethodConfig
from .evaluation import evaluate
from .prior import apply_prior, nothing_allowed
from .query import Query, prepare_query
from .refinement import MAX_SCORE_LOSS, refine, refine_by_perturbation, refine_full_resolution, settle
from .scan_map import ScanMap
from .search import search_poses
from .search_result import NOTHING, SearchResult
from .settings import CoarseToFineSettings

HOPELESS_SCORE = 0.05  # of black, white and noisy pictures; views of other places have 0.1 and more
ALTERNATIVES_REFINED = 10  # at most
NO_PIXEL = "the panorama: no pixel counts, all are masked"


def localize(
    scan_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
    method: MethodConfig = METHOD,
) -> Localization:
    """Where the panorama was taken: search, refine, compare with the alternatives, evaluate.

    Where the gravity is `auto`, as known first, then as unknown; then both again with a wider beam. The first
    attempt whose result is confident ends the search.
    """
    candidates = apply_prior(scan_map, settings.prior)
    if len(candidates.centers) == 0 or not panorama.is_valid.any():
        is_masked = len(candidates.centers) > 0
        why = NO_PIXEL if is_masked else nothing_allowed(scan_map, settings.prior)
        return Localization(warnings=(why,))
    with watch.stage("search"):
        query = prepare_query(panorama, candidates, settings, workers, method)
    found = NOTHING
    gravities: list[Literal["known", "unknown"]]
    gravities = ["known", "unknown"] if settings.gravity == "auto" else [settings.gravity]
    for beam, gravity in itertools.product((method.beam, method.wide_beam), gravities):
        if beam is method.wide_beam and found.best.score < HOPELESS_SCORE:
            break
        with watch.stage("search"):
            starts = search_poses(query, gravity)
        with watch.stage("refine"):
            fine, middle = refine(query, starts, beam)
            best = refine_full_resolution(query, fine[0], 1)
            # A wider beam knows more alternatives: of the same pose, its margin is the one to believe.
            if best.score > found.best.score - MAX_SCORE_LOSS:
                others = alternative_poses(best.pose, fine, middle, ALTERNATIVES_REFINED)
                found = SearchResult(best, tuple(others))
            if found.is_confident:
                found = refine_alternatives(query, found)
        if found.is_confident:
            break
    with watch.stage("refine"):
        if not found.is_confident:
            found = refine_alternatives(query, found)
        return evaluate(query, panorama, replace(found, best=settle(query, found.best)))


def refine_alternatives(query: Query, found: SearchResult) -> SearchResult:
    """The same, with the alternatives that come near refined as carefully as the best; the better wins."""

    def refined(h: Hypothesis) -> Hypothesis:
        return refine_full_resolution(query, refine_by_perturbation(query, h), 2)

    near, far = found.near, found.alternatives[len(found.near) :]
    finished = list(query.workers.map(refined, near, "descend"))
    best, *others = by_score([found.best, *finished, *far])
    return SearchResult(best, tuple(alternative_poses(best.pose, others, count=ALTERNATIVES_REFINED)))
