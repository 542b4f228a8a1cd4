"""The judge: the default method's only maker of confidences, and of the statuses localized and ambiguous.

All are made in `decide`. A photo alone comes here with its evidence (`judge`). Photos that help each other
decide nothing; each way hands over probabilities, or a pose with errors:
- `bundle`: a pose by all photos and the probabilities of all poses, to `judge_together`;
- `beside`: the mean with the pose by another photo to `take_pose`, a factor of probabilities to `reconsider`;
- `batch.localizer`: the focal length by all photos of a camera, an `Opinion`, to `follow_consensus`;
- `walk.results`: the probabilities of a frame's places along the path, to `decide`, its pose to `take_pose`;
- `coloring`: nothing; each photo is localized as one alone, in colours of the others.

A new way hands over as `bundle` or `beside` do. It is wired in by a method of `opened_scan.OpenedScan`, and
- of photos that are given together: by a method of `Scan`; in `cli` by an option, a `make_..._job` and
  NOT_WITH of `together`, and JOINT and `run_jointly` of `photo_run`;
- as a second look at photos of a batch: by a function in LISTINGS of `batch.localizer`, fields of its `Look`,
  a branch in `look_again`, and by `may_change` and, in `batch.results_file`, `Finished.is_second`.
"""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array
from ..confidence.alternatives import MAX_ALTERNATIVES, Hypothesis, suppress_near
from ..confidence.confidence import LOCALIZED, Standing, classify, posterior
from ..confidence.covariance import describe_errors
from ..confidence.focal_length import MOST_CONFLICT, Opinion
from ..confidence.localization import Alternative, Evidence, FocalLength, Localization
from ..confidence.occlusion import compare_occlusion, measure_agreement
from ..geometry.nearness import ONE_ANSWER
from ..geometry.pose import Pose, uniform_yaws
from ..geometry.pose_gaussian import PoseGaussian, probability_within
from ..local_features.hypotheses import propose_poses
from ..local_features.matching import match
from ..optimize.refine import DescentSettings, make_sampling_loss, refine
from ..optimize.sampling_loss import sampling_loss
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from ..views.zbuffer import visible_points
from .attempts import FIRST_BEAM
from .beam import brief_query, descend_briefly, refine_matches, refine_starts, score_briefly, score_near
from .comparison import score_pose
from .covariance import Errors, estimate_errors
from .focal_length import FocalFit, fit_focal
from .ladder import settle
from .photo import ACROSS
from .prior import contradictions
from .query import Query
from .search import search_poses
from .selection import Selection, assess_poses
from .shape import find_alike
from .sphere import SphereFit
from .verification import count_agreeing, count_each, find_copies, list_rivals

ENOUGH_EXPLAINED = 0.7  # with this score a photo is not mirrored
WORTH_ASKING = 0.2  # least probability of all poses together, for which the mirrored photo is tried
FOUND_AGAIN = 0.9  # least score of an end of a brief search, as a fraction of the pose's, to count as found
MIRROR_RATIO = 1.05  # least ratio of scores, mirrored photo to photo; in symmetric scenes it is about 1
MIRRORED = "the photo fits the scan better mirrored, left for right: turn it over and try again"
NOT_AS_CLAIMED = (
    "the panorama does not show 360 x 180 degrees with the horizon in the middle: give it as it was "
    "stitched, not cropped or stretched"
)
OTHERS = {  # corrections of a lens besides its focal length, in words
    "log_aspect": "ratio of its focal lengths",
    "center_x": "principal point",
    "center_y": "principal point",
    "radial": "distortion",
}
UNCONFIRMED = 0.1  # chosen: weight of a photo's own focal length, against the one given, in what it confirms
TELLING_STD = 0.03  # [m] of the position by the focal length: more is reported
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
LAST_STEP = 0.01  # [rad, m] of Adam and the first of L-BFGS, where they take the last descent


Fit = FocalFit | SphereFit


class Measured(NamedTuple):
    """Measurements of the best pose."""

    pose: Pose  # in the map
    errors: Errors
    loss: float
    evidence: Evidence


def judge(query: Query, found: Selection, fit: Fit | None = None, may_promote: bool = True) -> Localization:
    """Return the result for the best pose of a photo by itself.

    `fit` is the fitted focal length, if the photo's is not exact. If `may_promote`, a copy of the best pose's
    place that turns out likelier becomes the best.
    """
    measured = measure(query, found, fit)
    if measured is None:
        return Localization()
    reported, is_copy = list_reported(query, found)
    standings = credit_copies(assess_poses(query, found.best, reported), is_copy)
    within = probability_within(measured.errors.gaussian)
    probabilities = posterior(standings, measured.errors.std_of_fit, within)
    likeliest = int(probabilities[:-1].argmax())
    if likeliest and is_copy[likeliest] and may_promote:
        best = settle(query, reported[likeliest - 1])
        others = (found.best, *(h for h in found.alternatives if h is not reported[likeliest - 1]))
        ratios = [s.ratio for s in assess_poses(query, best, others)[1:]]
        found = Selection(best, others, max(ratios))
        fit = fit_focal(query, found.best.pose, is_first=False) if isinstance(fit, FocalFit) else fit
        return judge(query, found, fit, may_promote=False)
    fit = doubt_alone(fit, measured.errors.gaussian)
    if isinstance(fit, FocalFit) and fit.of_difference is not None:
        measured = measured._replace(errors=measured.errors.widen(fit.of_difference))
    return conclude(query, replace(found, alternatives=reported), fit, measured, standings, probabilities)


def doubt_alone(fit: Fit | None, gaussian: PoseGaussian | None) -> Fit | None:
    """Return the fit of a photo by itself, doubted more where the photo does not confirm what was given.

    If what was given says nothing, the pose is only as exact as by the photo's own focal length. Both doubts
    are about the same wrong claims: the greater one counts.
    """
    if not isinstance(fit, FocalFit) or fit.of_picture is None or gaussian is None:
        return fit
    missed = 1.0 - probability_within(gaussian.widen(fit.of_picture))
    return fit._replace(doubt=max(fit.doubt, UNCONFIRMED * missed))


def judge_together(
    query: Query, found: Selection, fit: Fit | None, gaussian: PoseGaussian, probabilities: Array
) -> Localization:
    """Return the result of a photo whose pose is what it and others say together.

    `gaussian` is that pose in the map; `found.best` has the same pose. `probabilities` (K + 1,) are of it, of
    each alternative and of none, by all photos together, each that the pose is within 0.1 m. The doubt about
    a focal length is not in them. What the photo itself rules out stays so.
    """
    measured = measure(query, found, fit)
    if measured is None:
        return Localization()
    standings = assess_poses(query, found.best, found.alternatives)
    errors = measured.errors._replace(gaussian=gaussian)
    measured = measured._replace(pose=gaussian.pose, errors=errors)
    return conclude(query, found, fit, measured, standings, probabilities)


def conclude(
    query: Query,
    found: Selection,
    fit: Fit | None,
    measured: Measured,
    standings: Sequence[Standing],
    probabilities: Array,
) -> Localization:
    """Return the result for measurements and probabilities, if nothing rules the pose out."""
    scan_map = query.scan_map
    least = query.settings.min_confidence
    if fit is not None:  # no pose is surer than what it rests on
        poses = (1.0 - fit.doubt) * probabilities[:-1]
        probabilities = np.append(poses, 1.0 - poses.sum())
    warnings = contradictions(scan_map, measured.pose, query.settings.prior)
    if probabilities[-1] < 1.0 - WORTH_ASKING and is_mirrored(query, found.best):
        warnings += (MIRRORED,)
    gaussian, std_of_fit = measured.errors
    alternatives = [
        Alternative(scan_map.to_world(h.pose), h.score, s.num_matches)
        for h, s in zip(found.alternatives, standings[1:], strict=True)
    ]
    described = Localization(
        pose=scan_map.to_world(measured.pose),
        loss=measured.loss,
        evidence=measured.evidence,
        alternatives=tuple(alternatives),
        covariance=describe_errors(gaussian, scan_map.R_map_from_world.T),
        warnings=warnings,
        cameras=() if fit is None else query.given.cameras,
        focal_length=fit.focal_length(query.given) if isinstance(fit, FocalFit) else None,
        sphere=fit.describe() if isinstance(fit, SphereFit) and not fit.is_claimed else None,
        is_ruled_out=bool(warnings) or (fit is not None and fit.conflict > MOST_CONFLICT),
        gaussian=gaussian,
        std_of_fit=std_of_fit,
        standings=tuple(standings),
    )
    decided = decide(described, probabilities, least)
    if decided.sphere is not None:
        return replace(decided, warnings=(*warnings, decided.sphere.explain()))
    if fit is None or decided.status == LOCALIZED:
        return decided
    return replace(decided, warnings=warnings + explain_doubts(query.given, fit))


def decide(found: Localization, probabilities: Array, min_confidence: float) -> Localization:
    """Return a result with the probabilities (K + 1,) of its pose, its alternatives and none, and its status.

    What is ruled out stays so, whatever the probabilities are.
    """
    p = np.append(np.zeros(len(probabilities) - 1), 1.0) if found.is_ruled_out else probabilities
    others = tuple(replace(a, probability=float(q)) for a, q in zip(found.alternatives, p[1:-1], strict=True))
    return replace(
        found,
        status=classify(p, min_confidence),
        confidence=float(p[0]),
        probability_none=float(p[-1]),
        alternatives=others,
    )


def reconsider(found: Localization, factor: float, min_confidence: float) -> Localization:
    """Return a result with the probabilities of all its poses multiplied by a factor, and its status."""
    poses = factor * np.array([found.confidence, *(a.probability or 0.0 for a in found.alternatives)])
    return decide(found, np.append(poses, 1.0 - poses.sum()), min_confidence)


def follow_consensus(found: Localization, consensus: Opinion, min_confidence: float) -> Localization:
    """Return a photo's result, its given focal length compared with that of all photos of its camera.

    The doubt about what was given, and with it the confidence, follow from `consensus`. The doubt of a photo
    that was localized with the others' focal length stays. If `consensus` contradicts what was given, every
    result is ruled out, with a warning.
    """
    focal = found.focal_length
    assert focal is not None
    doubt = focal.doubt
    if focal.others_px is None:
        share = focal.opinion.share_of_given(focal.prior_deviation) if focal.opinion else 1.0
        doubt = share * consensus.doubt(focal.prior_deviation)
    is_contradicted = consensus.conflict(focal.prior_deviation) > MOST_CONFLICT
    factor = (1.0 - doubt) / (1.0 - focal.doubt)
    told = replace(found, focal_length=replace(focal, doubt=doubt), is_ruled_out=is_contradicted)
    if is_contradicted:
        px = focal.given_px * math.exp(consensus.off)
        told = replace(told, warnings=(contradict("the pictures of this camera have", focal, px),))
    return reconsider(told, factor, min_confidence)


def contradict(who_has: str, focal: FocalLength, px: float) -> str:
    """Return a warning that pictures have another focal length than the one given."""
    return f"{who_has} a focal length of {px:.0f} px, not {focal.given_px:.0f}: check {focal.source}"


def take_pose(judged: Localization, fused: PoseGaussian, scan_map: ScanMap) -> Localization:
    """Return a result with another pose of the same place."""
    described = describe_errors(fused, scan_map.R_map_from_world.T)
    return replace(judged, pose=scan_map.to_world(fused.pose), covariance=described, gaussian=fused)


def measure(query: Query, found: Selection, fit: Fit | None) -> Measured | None:
    """Measure how well the best pose explains a photo, and how well the photo fixes the pose.

    The pose is that of `estimate_errors`, the loss is taken there; the evidence is that of the best pose.
    None if there is no pose, or no point is visible from it.
    """
    if found.best.score < 0.0:
        return None
    settings = query.settings
    pose = found.best.pose
    points, coarse = query.surroundings_at(pose)
    if settings.solver != "gauss-newton":
        descent = DescentSettings(solver=settings.solver, step_size=LAST_STEP)
        pose = refine(points, make_sampling_loss(query.colors()), pose, descent).pose

    def find_end() -> tuple[Errors, Pose, float]:
        """Return the errors, the pose that they are of, and the loss there."""
        errors = estimate_errors(query, pose)
        end = errors.gaussian.pose if errors.gaussian else pose
        return errors, end, sampling_loss(visible_points(points, end.center_world), query.colors(), end)

    measures: list[Callable[[], Any]] = [
        find_end,  # takes longest
        lambda: compare_occlusion(points, query.given, pose).fractions(),
        lambda: measure_agreement(coarse, query.photo.panorama, pose),
    ]
    (errors, end, loss), fractions, agreement = query.workers.map(operator.call, measures, "evaluate")
    if not math.isfinite(loss):
        return None
    errors = errors.widen(fit.pose_covariance) if fit else errors
    num_matches = count_each(query, found.best, found.alternatives)
    evidence = Evidence(
        score=found.best.score,
        margin=found.margin,
        agreement=agreement.value,
        explained_fraction=fractions[0],
        contradicted_fraction=fractions[1],
        seen_fraction=agreement.seen_fraction,
        num_matches=num_matches[0] if query.uses_matches else None,
        alternative_matches=max(num_matches[1:], default=0) if query.uses_matches else None,
    )
    return Measured(end, errors, loss, evidence)


def list_reported(query: Query, found: Selection) -> tuple[tuple[Hypothesis, ...], list[bool]]:
    """Return the alternatives to report, and as `list_copies` which poses are copies, the best pose first.

    In a scan without colours copies are searched. They are reported before other poses.
    """
    if query.evidence != "shape":
        reported = found.alternatives[:MAX_ALTERNATIVES]
        return reported, list_copies(query, found.best, reported)
    copies = [score_pose(query, pose) for pose in find_alike(query, found.best.pose)]
    reported = tuple(suppress_near([*copies, *found.alternatives], MAX_ALTERNATIVES, ONE_ANSWER))
    return reported, [True, *(k < len(copies) for k in range(len(reported)))]


def list_copies(query: Query, best: Hypothesis, others: Sequence[Hypothesis]) -> list[bool]:
    """Return True for the best pose and for copies of its place; of a photo without matches there False."""
    if not query.uses_matches:
        return [False] * (1 + len(others))
    rivals = [h.pose for h in list_rivals(query, best, others)]
    copies = compress(rivals, find_copies(query, best.pose, rivals))
    keys = {pose.key for pose in (best.pose, *copies)}
    return [h.pose.key in keys for h in (best, *others)]


def credit_copies(standings: Sequence[Standing], is_copy: Sequence[bool]) -> list[Standing]:
    """Give every copy of a place the greatest number of matches among the copies.

    How many agree tells how well a copy was scanned, not which of them it is. So do edges: in a scan without
    colours every copy has the best pose's evidence.
    """
    if standings[0].evidence == "shape":
        best = standings[0]
        credited = [best._replace(log_prior=s.log_prior) for s in standings]
        return [c if copied else s for c, s, copied in zip(credited, standings, is_copy, strict=True)]
    most = max((s.num_matches or 0 for s in compress(standings, is_copy)), default=0)
    pairs = zip(standings, is_copy, strict=True)
    return [s._replace(num_matches=most) if copied else s for s, copied in pairs]


def explain_doubts(panorama: Panorama, fit: Fit) -> tuple[str, ...]:
    """Explain how the photo's geometry makes a pose doubtful, as warnings."""
    if isinstance(fit, SphereFit):
        return (NOT_AS_CLAIMED,) if fit.conflict > MOST_CONFLICT else ()
    focal = fit.focal_length(panorama)
    if fit.conflict > MOST_CONFLICT:
        return (explain_conflict(fit.contradicted, focal),)
    std = math.sqrt(float(np.linalg.eigvalsh(fit.pose_covariance[3:, 3:])[-1]))
    if std <= TELLING_STD:
        return ()
    found = f"focal length {focal.px:.0f} +- {focal.std_px:.0f} px"
    given = f"given {focal.given_px:.0f} +- {focal.given_std_px:.0f}"
    return (f"{found} ({given}): the position is uncertain by {std:.2f} m",)


def explain_conflict(correction: str, focal: FocalLength) -> str:
    """Return a warning that a photo's geometry is not as it was given."""
    if correction in OTHERS:
        return f"the picture has another {OTHERS[correction]} than was given: check {focal.source}"
    return contradict("the picture has", focal, focal.px)


def is_mirrored(query: Query, best: Hypothesis) -> bool:
    """Return True if the mirrored photo has a pose that explains more, and with which more features agree.

    In a symmetric scene both are about equal. Not tested are scores of ENOUGH_EXPLAINED, scans without
    colours, and poses by whole views alone: the first look has compared these with the mirrored photo.
    """
    if best.score >= ENOUGH_EXPLAINED or not query.uses_matches:
        return False
    mirrored = query.mirror()
    found = search_mirrored(query, mirrored, best.pose)
    if not found or found[0].score <= MIRROR_RATIO * best.score:
        return False
    return count_agreeing(mirrored, found[0].pose) > count_agreeing(query, best.pose)


def search_mirrored(query: Query, mirrored: Query, pose: Pose) -> list[Hypothesis]:
    """Return poses of the mirrored photo, best first, by what found the photo's own: features, or views.

    A wall or a ceiling seen from behind fits the mirrored photo: its tilt is that of the pose found, or that
    upside down. The search is brief if a brief one finds the photo's own pose.
    """
    if query.features:
        matches = match(query.keypoints.mirror(), query.scan_map.features_now(query.workers), query.workers)
        return refine_matches(mirrored, [f.pose for f in propose_poses(matches, 1, query.workers)])
    yaws = uniform_yaws(query.settings.num_yaws)
    tilt = ACROSS @ pose.R_cam_from_world @ ACROSS
    asked = mirrored.with_rotations(tilt @ np.concatenate([yaws, UPSIDE_DOWN @ yaws]))
    own = brief_query(query.with_rotations(pose.R_cam_from_world @ yaws))
    own_score = score_near(query, pose)
    if score_briefly(own) < FOUND_AGAIN * own_score:
        return refine_starts(asked, search_poses(asked, "known"), query.beam)
    asked = brief_query(asked)
    ends = descend_briefly(asked)
    return refine_starts(asked, ends.poses, FIRST_BEAM) if ends.best_score > own_score else []
