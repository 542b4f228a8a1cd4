"""The paper's method in order, one line a step."""

import math
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..cloud.soa import LocalCloud, PackedPoints, pack_points
from ..cloud.stream import Cloud
from ..confidence.alternatives import Hypothesis, alternative_poses
from ..confidence.confidence import AMBIGUOUS, LEAST_SCORE, LOCALIZED, NOT_LOCALIZED
from ..confidence.localization import Alternative, Evidence, Localization
from ..confidence.occlusion import compare_occlusion, measure_agreement
from ..geometry.rotations import uniform_rotations, uniform_yaws
from ..jobs.threads import Stopwatch, Workers
from ..optimize.refine import Loss, Refined, make_sampling_loss, refine
from ..panorama import Panorama
from ..panorama.model import shrink
from ..panorama.texels import pack_texels
from .photometric import make_photometric_loss
from .search import free_grid, search
from .settings import PaperSettings

# No covariance is known here, and too few alternatives to tell places that repeat: a rough guide, by margin
# and log of the agreement, learnt without such places.
PAPER_BIAS = -0.20
PAPER_WEIGHTS = (6.37, 2.51)


@dataclass(frozen=True)
class PaperMap(LocalCloud):
    """The paper's map, prepared once per cloud."""

    positions: Array  # (M, 3) starts in free space, relative to origin_world [m]
    scan_sha256: str = ""  # of the files or arrays that it was made from, in hexadecimal digits


def prepare(cloud: Cloud, settings: PaperSettings) -> PaperMap:
    """Prepare everything that does not depend on the panorama."""
    points = pack_points(cloud.points, cloud.colors).subsample(settings.max_points)
    positions = free_grid(points, settings.num_translations, settings.grid_margin)
    return PaperMap(points, np.eye(3), cloud.origin_world, cloud.warnings, positions)


def make_loss(panorama: Panorama, settings: PaperSettings) -> Loss:
    """Return the loss that the settings select."""
    if settings.loss == "photometric":
        return make_photometric_loss(shrink(panorama, settings.photometric_width))
    return make_sampling_loss(pack_texels(panorama.rgb, panorama.is_valid))


def localize(
    paper_map: PaperMap, panorama: Panorama, settings: PaperSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Localize by Algorithm 1 of the paper: search, refine, select; then evaluate the selected pose."""
    points = paper_map.points
    known = settings.gravity == "known"
    rotations = (uniform_yaws if known else uniform_rotations)(settings.effective_num_rotations)
    loss = make_loss(panorama, settings)
    with watch.stage("search"):
        starts = search(points, panorama, loss, paper_map.positions, rotations, settings, workers)
    with watch.stage("refine"):
        refined = list(workers.map(lambda s: refine(points, loss, s.pose, settings), starts, "refine"))
        best = min(refined, key=lambda r: r.loss, default=None)
    if best is None or not np.isfinite(best.loss):
        return Localization()
    with watch.stage("refine"):
        evidence, others = evaluate(points, panorama, best, refined)
    confidence = paper_confidence(evidence)
    alone = paper_confidence(replace(evidence, margin=1.0))
    otherwise = AMBIGUOUS if others and alone >= settings.min_confidence else NOT_LOCALIZED
    status = LOCALIZED if confidence >= settings.min_confidence else otherwise
    in_world = tuple(Alternative(paper_map.to_world(h.pose), h.score) for h in others)
    pose = paper_map.to_world(best.pose)
    return Localization(status, confidence, None, pose, best.loss, evidence, in_world)


def evaluate(
    points: PackedPoints, panorama: Panorama, best: Refined, refined: list[Refined]
) -> tuple[Evidence, list[Hypothesis]]:
    """Return the evidence at the best pose, and the alternatives, best first."""
    at_pose = measure_agreement(points, panorama, best.pose)
    others = [Hypothesis(r.pose, measure_agreement(points, panorama, r.pose).score) for r in refined]
    others = alternative_poses(best.pose, others)
    explained, contradicted = compare_occlusion(points, panorama, best.pose).fractions()
    evidence = Evidence(
        score=at_pose.score,
        margin=at_pose.score - max([0.0, *(h.score for h in others)]),
        agreement=at_pose.value,
        explained_fraction=explained,
        contradicted_fraction=contradicted,
        seen_fraction=at_pose.seen_fraction,
    )
    return evidence, others


def paper_confidence(evidence: Evidence) -> float:
    """Return a rough, uncalibrated probability that a pose of the preset paper is right."""
    features = evidence.margin, math.log(max(evidence.agreement, LEAST_SCORE))
    logit = PAPER_BIAS + sum(w * f for w, f in zip(PAPER_WEIGHTS, features, strict=True))
    return 1.0 / (1.0 + math.exp(-min(max(logit, -30.0), 30.0)))
