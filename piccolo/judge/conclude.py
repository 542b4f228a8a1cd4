"""Results from the case of a photo and a belief; the status follows from the belief (`belief.decide`)."""

import math
from dataclasses import replace

from ..geometry.points import MapFrame
from ..geometry.pose_gaussian import PoseGaussian
from .belief import Belief
from .case import Case, Geometry
from .consensus import MOST_CONFLICT, Opinion
from .pose_covariance import describe_errors
from .probability import LOCALIZED
from .reasons import MIRRORED, Reason, explain
from .result import Result
from .result_parts import Alternative, FocalLength

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
TELLING_STD = 0.03  # [m] deviation of the position by the focal length: a larger one is reported


def conclude(frame: MapFrame, case: Case, belief: Belief, min_confidence: float) -> Result:
    """Return the result in the world for a case and a belief, with the reasons that rule the pose out."""
    measured = case.measured
    geometry = case.geometry
    warnings = list(map(explain, measured.contradicted))
    reasons = [contradiction.reason for contradiction in measured.contradicted]
    if case.is_mirrored:
        reasons.append(Reason.MIRRORED)
        warnings.append(MIRRORED)
    if geometry is not None and geometry.conflict > MOST_CONFLICT:
        reasons.append(Reason.SPHERE if geometry.focal_length is None else Reason.CALIBRATION)
        warnings.append(explain_conflict(geometry))
    gaussian, std_of_fit = measured.errors
    alternatives = [
        Alternative(frame.to_world(h.pose), h.score, s.num_matches)
        for h, s in zip(case.found.alternatives, case.standings[1:], strict=True)
    ]
    described = Result(
        best_pose=frame.to_world(measured.pose),
        loss=measured.loss,
        evidence=measured.evidence,
        alternatives=tuple(alternatives),
        covariance=describe_errors(gaussian, frame.R_map_from_world.T),
        cameras=() if geometry is None else geometry.cameras,
        focal_length=geometry and geometry.focal_length,
        sphere=geometry and geometry.sphere,
        gaussian=gaussian,
        std_of_fit=std_of_fit,
        standings=case.standings,
        mirrored=case.mirrored,
    )
    decided = described.take_belief(belief.rule_out(*reasons), min_confidence)
    doubts = () if geometry is None else explain_doubts(geometry, decided.status)
    return replace(decided, warnings=(*warnings, *doubts))


def follow_consensus(found: Result, consensus: Opinion, min_confidence: float) -> Result:
    """Compare a photo's given focal length with that of all photos of its camera; return its new result.

    The doubt about the given focal length, and with it the confidence, follow from `consensus`; but a photo
    that was localized with the others' focal length keeps its doubt. If `consensus` contradicts the given
    focal length, the result is ruled out, with a warning.
    """
    focal = found.focal_length
    belief = found.belief
    assert focal is not None
    if focal.others_px is None:
        share = focal.opinion.share_of_given(focal.prior_deviation) if focal.opinion else 1.0
        focal = replace(focal, doubt=share * consensus.doubt(focal.prior_deviation))
        belief = replace(belief, doubt=focal.doubt)
    revised = replace(found, focal_length=focal)
    if consensus.conflict(focal.prior_deviation) > MOST_CONFLICT:
        px = focal.given_px * math.exp(consensus.off)
        warning = contradict("the pictures of this camera have", focal, px)
        revised = replace(revised, warnings=(*revised.warnings, warning))
        belief = belief.rule_out(Reason.CAMERA)
    return revised.take_belief(belief, min_confidence)


def rule_out_mirrored(result: Result, min_confidence: float) -> Result:
    """Return the result of a photo that other photos show to be mirrored, ruled out, with a warning."""
    refused = replace(result, warnings=(*result.warnings, MIRRORED))
    return refused.take_belief(result.belief.rule_out(Reason.MIRRORED), min_confidence)


def contradict(who_has: str, focal: FocalLength, px: float) -> str:
    """Return a warning that pictures have another focal length than the one given."""
    return f"{who_has} a focal length of {px:.0f} px, not {focal.given_px:.0f}: check {focal.source}"


def take_pose(judged: Result, fused: PoseGaussian, frame: MapFrame) -> Result:
    """Return a result with another pose of the same place."""
    described = describe_errors(fused, frame.R_map_from_world.T)
    return replace(judged, best_pose=frame.to_world(fused.pose), covariance=described, gaussian=fused)


def explain_doubts(geometry: Geometry, status: str) -> tuple[str, ...]:
    """Explain which part of the sphere a photo shows, or how inexact its focal length makes the position."""
    if geometry.sphere is not None:
        return (geometry.sphere.explain(),)
    focal = geometry.focal_length
    if focal is None or status == LOCALIZED or geometry.conflict > MOST_CONFLICT:
        return ()
    if geometry.std <= TELLING_STD:
        return ()
    estimate = f"focal length {focal.px:.0f} +- {focal.std_px:.0f} px"
    given = f"given {focal.given_px:.0f} +- {focal.given_std_px:.0f}"
    return (f"{estimate} ({given}): the position is uncertain by {geometry.std:.2f} m",)


def explain_conflict(geometry: Geometry) -> str:
    """Return a warning that a photo's geometry is not the one that was given or claimed."""
    focal = geometry.focal_length
    if focal is None:
        return NOT_AS_CLAIMED
    if geometry.worst_correction in OTHERS:
        other = OTHERS[geometry.worst_correction]
        return f"the picture has another {other} than was given: check {focal.source}"
    return contradict("the picture has", focal, focal.px)
