"""The evidence for and against the pose that was found, and the resulting status."""

import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from itertools import compress
from typing import Any

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES, Hypothesis
from ..confidence.confidence import LOCALIZED, NOT_LOCALIZED, Standing, classify, posterior
from ..confidence.localization import Alternative, Evidence, Localization
from ..confidence.occlusion import Agreement, compare_occlusion, measure_agreement
from ..local_features.hypotheses import count_matches, propose_poses
from ..local_features.matching import match
from ..optimize.refine import DescentSettings, make_sampling_loss, refine
from ..optimize.sampling_loss import sampling_loss
from ..panorama import Panorama
from ..views.zbuffer import visible_points
from .brief import mirror_query
from .covariance import estimate_covariance
from .focal_length import MOST_CONFLICT, FocalFit, fit_focal
from .last_descent import settle
from .prior import contradictions
from .query import Query
from .refinement import refine_matches
from .selection import Selection, assess_poses
from .verification import count_agreeing, find_copies

ENOUGH_EXPLAINED = 0.7  # with this score a photo is not mirrored
MIRROR_RATIO = 1.05  # least ratio of scores, mirrored photo to photo; in symmetric scenes it is about 1
MIRRORED = "the photo fits the scan better mirrored, left for right: turn it over and try again"
TELLING_STD = 0.03  # [m] of the position by the focal length: more is reported
LAST_STEP = 0.01  # [rad, m] of Adam and the first of L-BFGS, where they take the last descent


def judge(
    query: Query, found: Selection, fit: FocalFit | None = None, may_change: bool = True
) -> Localization:
    """Return the result for the best pose: evidence, covariance, probabilities and status.

    `fit` is the fitted focal length, if the photo's is not exact. If `may_change`, a copy of the best pose's
    place that turns out likelier becomes the best.
    """
    if found.best.score < 0.0:
        return Localization()
    settings = query.settings
    pose = found.best.pose
    points, coarse = query.surroundings_at(pose)
    if settings.solver != "gauss-newton":
        descent = DescentSettings(solver=settings.solver, step_size=LAST_STEP)
        pose = refine(points, make_sampling_loss(query.photo.colors()), pose, descent).pose
    measures: list[Callable[[], Any]] = [
        partial(estimate_covariance, query, pose, fit and fit.pose_covariance),  # takes longest
        lambda: compare_occlusion(points, query.photo.given, pose).fractions(),
        lambda: sampling_loss(visible_points(points, pose.center_world), query.photo.colors(), pose),
        lambda: measure_agreement(coarse, query.photo.panorama, pose),
    ]
    covariance, fractions, loss, agreement = query.workers.map(operator.call, measures, "evaluate")
    if not math.isfinite(loss):
        return Localization()
    evidence = collect_evidence(query, found, agreement, fractions)
    reported = found.alternatives[:MAX_ALTERNATIVES]
    standings = assess_poses(query, found.best, reported)
    is_copy = list_copies(query, found.best, reported)
    weighed = credit_copies(standings, is_copy)
    probabilities = posterior(weighed, covariance)
    likeliest = int(probabilities[:-1].argmax())
    if likeliest and is_copy[likeliest] and may_change:
        found = promote(query, found, reported[likeliest - 1])
        fit = fit and fit_focal(query, found.best.pose, is_first=False)
        return judge(query, found, fit, may_change=False)
    warnings = contradictions(query.scan_map, pose, settings.prior)
    if classify(probabilities, settings.min_confidence) != NOT_LOCALIZED and is_mirrored(query, found.best):
        warnings += (MIRRORED,)
    if warnings or (fit is not None and fit.conflict > MOST_CONFLICT):
        probabilities = np.append(np.zeros(len(standings)), 1.0)
    if fit is not None and classify(probabilities, settings.min_confidence) != LOCALIZED:
        warnings += explain_doubts(query.photo.given, fit)
    alternatives = tuple(
        Alternative(query.scan_map.to_world(h.pose), h.score, s.num_matches, float(p))
        for h, s, p in zip(reported, standings[1:], probabilities[1:-1], strict=True)
    )
    return Localization(
        classify(probabilities, settings.min_confidence),
        float(probabilities[0]),
        float(probabilities[-1]),
        query.scan_map.to_world(pose),
        loss,
        evidence,
        alternatives,
        covariance,
        warnings,
        cameras=() if fit is None else query.photo.given.cameras,
        focal_length=None if fit is None else fit.focal_length(query.photo.given),
        standings=tuple(weighed),
    )


def list_copies(query: Query, best: Hypothesis, others: Sequence[Hypothesis]) -> list[bool]:
    """Return True for the best pose and for copies of its place; of a photo without matches there False."""
    if not query.photo.is_partial or not query.num_parts:
        return [False] * (1 + len(others))
    return [True, *find_copies(query, best.pose, [h.pose for h in others])]


def credit_copies(standings: Sequence[Standing], is_copy: Sequence[bool]) -> list[Standing]:
    """Give copies of a place all the most matches that one of them has.

    How many of a photo's features agree with the scan drawn at each tells how well each was scanned.
    """
    most = max((s.num_matches or 0 for s in compress(standings, is_copy)), default=0)
    pairs = zip(standings, is_copy, strict=True)
    return [s._replace(num_matches=most) if copied else s for s, copied in pairs]


def promote(query: Query, found: Selection, alternative: Hypothesis) -> Selection:
    """Return the selection with an alternative, refined to the end, as the best."""
    best = settle(query, alternative)
    others = (found.best, *(h for h in found.alternatives if h is not alternative))
    return Selection(best, others, max(s.ratio for s in assess_poses(query, best, others)[1:]))


def explain_doubts(panorama: Panorama, fit: FocalFit) -> tuple[str, ...]:
    """Explain how the focal length makes a pose doubtful, as warnings."""
    focal = fit.focal_length(panorama)
    assert panorama.focal_prior is not None
    source = panorama.focal_prior.source
    if fit.conflict > MOST_CONFLICT:
        lengths = f"{focal.px:.0f} px, not {focal.given_px:.0f}"
        return (f"the picture has a focal length of {lengths}: check {source}",)
    std = math.sqrt(float(np.linalg.eigvalsh(fit.pose_covariance[3:, 3:])[-1]))
    if std <= TELLING_STD:
        return ()
    found = f"focal length {focal.px:.0f} +- {focal.std_px:.0f} px"
    given = f"given {focal.given_px:.0f} +- {focal.given_std_px:.0f}"
    return (f"{found} ({given}): the position is uncertain by {std:.2f} m",)


def collect_evidence(
    query: Query, found: Selection, agreement: Agreement, fractions: tuple[float, float]
) -> Evidence:
    """Collect the evidence for the best pose, from the fractions explained and contradicted."""
    num_matches = [count_agreeing(query, h.pose) for h in (found.best, *found.alternatives)]
    return Evidence(
        score=found.best.score,
        margin=found.margin,
        agreement=agreement.value,
        explained_fraction=fractions[0],
        contradicted_fraction=fractions[1],
        seen_fraction=agreement.seen_fraction,
        num_matches=num_matches[0] if query.num_parts else None,
        alternative_matches=max(num_matches[1:], default=0) if query.num_parts else None,
    )


def is_mirrored(query: Query, best: Hypothesis) -> bool:
    """Return True if more features of the mirrored photo agree with a pose, where views also explain more.

    In a symmetric scene both are about equal. The test is skipped for a pose that explains nearly all of the
    photo, and after a first look, which has compared the mirrored photo itself.
    """
    if best.score >= ENOUGH_EXPLAINED or not query.num_parts:
        return False
    matches = match(query.keypoints.mirror(), query.scan_map.features_now(query.workers), query.workers)
    found = propose_poses(matches, None, 1, query.workers)
    num_matches = max(count_matches(query.matches, best.pose), count_agreeing(query, best.pose))
    if not found or found[0].num_matches <= num_matches:
        return False
    return refine_matches(mirror_query(query), [found[0].pose])[0].score > MIRROR_RATIO * best.score
