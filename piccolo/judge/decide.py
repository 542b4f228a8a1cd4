"""The only maker of confidences, and of the statuses localized and ambiguous: all are made in `decide`."""

import math
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..confidence.confidence import LOCALIZED, classify
from ..confidence.covariance import describe_errors
from ..confidence.focal_length import MOST_CONFLICT, Opinion
from ..confidence.localization import Alternative, FocalLength, Localization
from ..geometry.pose_gaussian import PoseGaussian
from ..scan_map.scan_map import ScanMap
from .case import Case, Geometry

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
TELLING_STD = 0.03  # [m] of the position by the focal length: more is reported


def doubt_given(probabilities: Array, geometry: Geometry | None) -> Array:
    """Return probabilities (K + 1,) less by the doubt about what was given: no pose is surer than that."""
    if geometry is None:
        return probabilities
    poses = (1.0 - geometry.doubt) * probabilities[:-1]
    return np.append(poses, 1.0 - poses.sum())


def conclude(scan_map: ScanMap, case: Case, probabilities: Array, min_confidence: float) -> Localization:
    """Return the result in the world for a case and probabilities, if nothing rules the pose out."""
    measured = case.measured
    geometry = case.geometry
    warnings = measured.contradicted + ((MIRRORED,) if case.is_mirrored else ())
    gaussian, std_of_fit = measured.errors
    alternatives = [
        Alternative(scan_map.to_world(h.pose), h.score, s.num_matches)
        for h, s in zip(case.found.alternatives, case.standings[1:], strict=True)
    ]
    described = Localization(
        pose=scan_map.to_world(measured.pose),
        loss=measured.loss,
        evidence=measured.evidence,
        alternatives=tuple(alternatives),
        covariance=describe_errors(gaussian, scan_map.R_map_from_world.T),
        warnings=warnings,
        cameras=() if geometry is None else geometry.cameras,
        focal_length=geometry and geometry.focal_length,
        sphere=geometry and geometry.sphere,
        is_ruled_out=bool(warnings) or (geometry is not None and geometry.conflict > MOST_CONFLICT),
        gaussian=gaussian,
        std_of_fit=std_of_fit,
        standings=case.standings,
    )
    decided = decide(described, probabilities, min_confidence)
    if decided.sphere is not None:
        return replace(decided, warnings=(*warnings, decided.sphere.explain()))
    if geometry is None or decided.status == LOCALIZED:
        return decided
    return replace(decided, warnings=warnings + explain_doubts(geometry))


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


def explain_doubts(geometry: Geometry) -> tuple[str, ...]:
    """Explain how the photo's geometry makes a pose doubtful, as warnings."""
    focal = geometry.focal_length
    if focal is None:
        return (NOT_AS_CLAIMED,) if geometry.conflict > MOST_CONFLICT else ()
    if geometry.conflict > MOST_CONFLICT:
        return (explain_conflict(geometry.contradicted, focal),)
    if geometry.std <= TELLING_STD:
        return ()
    found = f"focal length {focal.px:.0f} +- {focal.std_px:.0f} px"
    given = f"given {focal.given_px:.0f} +- {focal.given_std_px:.0f}"
    return (f"{found} ({given}): the position is uncertain by {geometry.std:.2f} m",)


def explain_conflict(correction: str, focal: FocalLength) -> str:
    """Return a warning that a photo's geometry is not as it was given."""
    if correction in OTHERS:
        return f"the picture has another {OTHERS[correction]} than was given: check {focal.source}"
    return contradict("the picture has", focal, focal.px)
