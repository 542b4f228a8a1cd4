"""The default engine in order, one line a step: one panorama in a prepared map."""

import math
from dataclasses import dataclass, replace

import numpy as np

from ..confidence.alternatives import MAX_RIVALS, Hypothesis, lead, rivals_of
from ..confidence.confidence import verdict
from ..confidence.localization import Localization
from ..confidence.score import evidence_at
from ..geometry.pose import Pose
from ..geometry.rotations import Gravity
from ..optimize.refine import refine, sampling_loss_of
from ..optimize.sampling_loss import sampling_loss
from ..optimize.settings import DescentSettings
from ..panorama import Panorama
from ..panorama.resize import shrink
from ..panorama.texels import pack_texels
from ..render.zbuffer import visible_points
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .covariance import certainty_at, disagreement_of_halves, has_bottom, points_at
from .prior import narrowed
from .query import MAX_FINISH_LOSS, Look, look_for
from .scan_map import ScanMap
from .settings import EngineSettings

SURE_SCORE, SURE_MARGIN = (
    0.25,
    0.15,
)  # with less, another look is taken
MAX_WIDTH = 4096  # [px] of the panorama that the loss is taken from: more costs seconds and tells nothing
HOPELESS_SCORE = 0.05  # of black, white and noisy pictures; views of other places have 0.1 and more
MAX_CHALLENGERS = 10  # rivals looked at
NEAR_SHARE = 0.4  # a rival with this share of the best score is refined as carefully as the best


@dataclass(frozen=True)
class Found:
    """What one look came to: the best hypothesis, and the best ones elsewhere, best first."""

    best: Hypothesis
    rivals: tuple[Hypothesis, ...]

    @property
    def margin(self) -> float:
        """Lead of the best score over the best elsewhere, or over 0."""
        return lead(self.best.score, self.rivals)

    @property
    def is_sure(self) -> bool:
        """True if no other look need be taken."""
        return self.best.score >= SURE_SCORE and self.margin >= SURE_MARGIN

    @property
    def near(self) -> list[Hypothesis]:
        """The rivals that come near the best."""
        return [h for h in self.rivals if h.score > NEAR_SHARE * self.best.score]


def find(look: Look, gravity: Gravity, watch: Stopwatch) -> Found:
    """Search, refine, and finish the best."""
    with watch.stage("search"):
        starts = look.search(gravity)
    with watch.stage("refine"):
        fine, middle = look.refine(starts)
        best = look.finish(fine[0])
    return Found(best, tuple(rivals_of(best.pose, fine, middle, MAX_CHALLENGERS)))


def challenged(look: Look, found: Found) -> Found:
    """The same, with the rivals that come near the best refined as carefully; the better of them wins."""
    near, far = found.near, found.rivals[len(found.near) :]
    finished = list(look.workers.each(lambda h: look.finish(look.polish(h)), near, "descend"))
    best, *others = sorted([found.best, *finished, *far], key=lambda h: -h.score)
    return Found(best, tuple(rivals_of(best.pose, others, count=MAX_CHALLENGERS)))


def best_found(look: Look, watch: Stopwatch) -> Found:
    """The quick look, or two where gravity is `auto`; and if that is not sure, a wider look at more poses."""
    gravity = look.settings.gravity
    looks: list[tuple[Gravity, Look]] = [("unknown" if gravity == "unknown" else "known", look)]
    if gravity == "auto":
        looks.append(("unknown", look))
    looks += [(g, replace(look, settings=look.settings.wider())) for g, _ in looks]
    best = Found(Hypothesis(Pose(np.eye(3), np.zeros(3)), -1.0), ())
    for g, how in looks:
        if how is not look and best.best.score < HOPELESS_SCORE:
            break
        found = find(how, g, watch)
        # A wider look knows more rivals: of the same pose, its margin is the one to believe.
        if found.best.score > best.best.score - MAX_FINISH_LOSS:
            best = found
        if best.is_sure:
            with watch.stage("refine"):
                best = challenged(look, best)
            if best.is_sure:
                return best
    with watch.stage("refine"):
        return challenged(look, best)


def localize(
    scan_map: ScanMap, panorama: Panorama, settings: EngineSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Where the panorama was taken: search, refine, judge."""
    allowed = narrowed(scan_map, settings.prior)
    if len(allowed.centers) == 0 or not panorama.is_valid.any():
        return Localization()
    with watch.stage("search"):
        look = look_for(panorama, allowed, settings, workers)
    found = best_found(look, watch)
    with watch.stage("refine"):
        return judged(look, panorama, found)


def judged(look: Look, panorama: Panorama, found: Found) -> Localization:
    """The verdict on what was found, in world coordinates, after the descent that the solver asks for."""
    scan_map, settings, pose = look.scan_map, look.settings, found.best.pose
    panorama = shrink(panorama, MAX_WIDTH)
    texels = pack_texels(panorama.rgb, panorama.is_valid)
    if settings.solver != "gauss-newton":
        how = DescentSettings(solver=settings.solver, step_size=0.01)
        pose = refine(scan_map.points, sampling_loss_of(texels), pose, how).pose
    loss = sampling_loss(visible_points(scan_map.points, pose.center_world), texels, pose)
    if not math.isfinite(loss):
        return Localization()
    points = points_at(look, pose)
    distance, angle = disagreement_of_halves(look, points, pose)
    evidence = evidence_at(scan_map.coarse_points, panorama, pose)
    agreements = [evidence_at(scan_map.coarse_points, panorama, h.pose).agreement for h in found.near]
    is_credible = [
        has_bottom(look, h.pose, agreement) for h, agreement in zip(found.near, agreements, strict=True)
    ]
    credible = [h for h, yes in zip(found.near, is_credible, strict=True) if yes]
    evidence = replace(
        evidence,
        score=found.best.score,
        rival_share=max([0.0, *(h.score for h in credible)]) / max(found.best.score, 1e-9),
        margin=min([found.margin, *(evidence.agreement - a for a in agreements)]),
        halves_distance=distance,
        halves_angle=angle,
    )
    certainty = certainty_at(look, points, pose)
    status, confidence = verdict(evidence, certainty, len(found.rivals) > 0, settings.min_confidence)
    reported = [*credible, *(h for h in found.rivals if not any(h is c for c in credible))][:MAX_RIVALS]
    rivals = tuple(Hypothesis(scan_map.to_world(h.pose), h.score) for h in reported)
    return Localization(status, confidence, scan_map.to_world(pose), loss, evidence, rivals, certainty)
