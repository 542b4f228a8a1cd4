"""The paper's method: poses on a grid in free space are scored, the diverse best refined, one selected."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from ..evidence.occlusion import compare_occlusion, measure_agreement
from ..geometry.nearness import Nearness
from ..geometry.points import LocalCloud, PackedPoints
from ..geometry.pose import Gravity, Pose, uniform_rotations, uniform_yaws
from ..geometry.sphere import solid_angles
from ..judge.alternatives import Hypothesis, alternative_poses, best_distinct
from ..judge.belief import Belief, make_belief
from ..judge.probability import LEAST_LOGIT_SCORE
from ..judge.result import Result, nothing_found
from ..judge.result_parts import Alternative, Evidence
from ..photo.panorama import Panorama
from ..photo.panorama.panorama import shrink
from ..photo.panorama.texels import pack_texels
from ..scan_map.camera_positions import MIN_CLEARANCE
from ..system.arguments import MIN_CONFIDENCE, check_confidence, check_fields
from ..system.arrays import Array, Array32, Mask
from ..system.errors import InputError
from ..system.jobs.threads import Stopwatch, Workers
from ..views.zbuffer import is_free_space, render_view, visible_points
from .paper_descent import DescentSettings, Loss, Refined, make_sampling_loss, refine_by_solver

# A rough guide, as this preset has no covariance, and too few alternatives to notice places that repeat. The
# weights are those of the margin and the log of the agreement, learnt in scans without such places.
PAPER_BIAS = -0.20
PAPER_WEIGHTS = (6.37, 2.51)
PROBE_WIDTH = 48  # cells of 7.5 degrees for the two tests
Initialization = Literal["two-stage", "loss-only"]


@dataclass(frozen=True)
class PaperSettings(DescentSettings):
    """Algorithm 1 of the paper; the defaults are ours where it gives none."""

    gravity: Gravity = "known"  # known: the camera is upright, only its yaw is searched
    num_translations: int = 50  # [N_t] positions on a uniform grid over the cloud's box, all in free space
    num_rotations: int = 0  # [N_r] 0 for the paper's: 8 yaws if gravity is known, else 32 rotations of SO(3)
    initialization: Initialization = "two-stage"  # loss-only: K2 poses by the loss, without histograms
    num_by_loss: int = 50  # [K1] poses kept by the loss
    num_by_histogram: int = 6  # [K2] poses kept by the colour histograms, and refined
    grid_margin: float = 0.0  # share of the box left out of the grid on each side
    histogram_bins: int = 8  # a channel
    histogram_width: int = 256  # [px] of the views and of the panorama that are compared
    min_distance: float = 0.3  # poses closer than this [m] and `min_angle_deg` are one: the better is kept
    min_angle_deg: float = 15.0
    max_points: int = 1_000_000  # of a larger cloud, this many are taken, evenly in space
    min_confidence: float = MIN_CONFIDENCE  # below it a pose is not called localized
    seed: int = 0  # repeated in the result; this preset draws nothing at random

    def __post_init__(self) -> None:
        check_fields(self)
        counts = ("num_translations", "num_by_loss", "num_by_histogram", "num_iterations", "num_culls")
        for name in (*counts, "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: found {getattr(self, name)}, wanted at least 1")
        if self.num_rotations < 0:
            found = f"found {self.num_rotations}"
            raise InputError(f"num_rotations: {found}, wanted 1 or more, or 0 for the paper's")
        if self.gravity == "auto":
            raise InputError("gravity: found auto, wanted known or unknown with the preset paper")
        if not 0.0 <= self.grid_margin < 0.5:
            raise InputError(f"grid_margin: found {self.grid_margin}, wanted 0 to below 0.5")
        check_confidence(self.min_confidence)
        if not 2 <= self.histogram_bins <= 64:
            raise InputError(f"histogram_bins: found {self.histogram_bins}, wanted 2 to 64")

    @property
    def effective_num_rotations(self) -> int:
        """N_r with the paper's default filled in."""
        return self.num_rotations or (8 if self.gravity == "known" else 32)

    def to_json(self) -> dict[str, object]:
        """Return the settings as they took effect."""
        return {"preset": "paper", **asdict(self), "num_rotations": self.effective_num_rotations}

    def make_loss(self, panorama: Panorama) -> Loss:
        """Return the loss of poses of a panorama."""
        return make_sampling_loss(pack_texels(panorama.rgb, panorama.is_valid))


def box_grid(low: Array, high: Array, num_cells: int) -> Array:
    """Return centres (M, 3) of near-cubic cells that fill a box, M near `num_cells`, one an axis at least."""
    size = np.maximum(high - low, 1e-3)
    edge = (size.prod() / num_cells) ** (1.0 / 3.0)
    for _ in range(3):  # an axis shorter than the edge gets one cell: the others share the number
        is_long = size > edge
        if is_long.any():
            edge = (size[is_long].prod() / num_cells) ** (1.0 / is_long.sum())
    counts = np.maximum(np.round(size / edge), 1).astype(int)
    axes = [low[k] + size[k] * (np.arange(counts[k]) + 0.5) / counts[k] for k in range(3)]
    return np.column_stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


def farthest_point_sampling(positions: Array, count: int) -> Array:
    """Return at most `count` positions (N, 3), in order, each chosen farthest from those chosen before."""
    if len(positions) <= count:
        return positions
    chosen = [0]
    distance = np.linalg.norm(positions - positions[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return np.asarray(positions[np.sort(chosen)])


def free_grid(points: PackedPoints, num_translations: int, margin: float) -> Array:
    """Return camera positions (M, 3) in free space on a uniform grid over the box, M <= num_translations.

    The box is that of the points, made smaller by `margin` of its size on every side. The grid is refined
    until enough of its positions are free, and thinned out evenly if they are too many. Empty if none is
    free.
    """
    low = np.array([points.x.min(), points.y.min(), points.z.min()], dtype=np.float64)
    high = np.array([points.x.max(), points.y.max(), points.z.max()], dtype=np.float64)
    inset = margin * (high - low)
    low += inset
    high -= inset
    probed = points.take(slice(None, None, max(1, len(points) // 200_000)))  # evenly in space
    free = np.empty((0, 3))
    for growth in (1.0, 1.5, 2.25, 3.4, 5.0, 7.6, 11.4, 17.0, 26.0):
        grid = box_grid(low, high, round(num_translations * growth))
        free = grid[[is_free_space(probed, center, PROBE_WIDTH, MIN_CLEARANCE) for center in grid]]
        if len(free) >= num_translations:
            break
    return farthest_point_sampling(free, num_translations)


def color_histogram(rgb: Array32, counts: Mask, bins: int) -> Array:
    """Return the fraction (bins ** 3,) of the solid angle in each colour, of an image (H, W, 3) in [0, 1].

    Only pixels of `counts` (H, W) are counted; all zero if there is none.
    """
    level = np.minimum((rgb * bins).astype(np.int64), bins - 1)
    index = (level[..., 0] * bins + level[..., 1]) * bins + level[..., 2]
    weights = counts * solid_angles(rgb.shape[1])[:, None]
    histogram = np.bincount(index.ravel(), weights.ravel(), minlength=bins**3)
    return np.asarray(histogram / max(histogram.sum(), 1e-12))


def histogram_similarity(points: PackedPoints, panorama: Panorama, pose: Pose, bins: int) -> float:
    """Return the histogram intersection [0, 1] of panorama and cloud at `pose`, where both show something.

    It is the overlap of two histograms that each sum to 1 (Swain and Ballard, 1991).
    """
    view = render_view(points, pose, panorama.rgb.shape[1])
    counts = view.is_seen & panorama.is_valid
    of_cloud = color_histogram(view.rgb, counts, bins)
    of_panorama = color_histogram(panorama.rgb.astype(np.float32) / 255.0, counts, bins)
    return float(np.minimum(of_cloud, of_panorama).sum())


@dataclass(frozen=True)
class PaperMap(LocalCloud):
    """The paper's map, prepared once per cloud."""

    positions: Array  # (M, 3) starts in free space, relative to origin_world [m]
    scan_sha256: str = ""  # of the files or arrays that it was made from, in hexadecimal digits


def prepare_by_paper(cloud: LocalCloud, settings: PaperSettings) -> PaperMap:
    """Prepare everything that does not depend on the panorama."""
    points = cloud.points.subsample(settings.max_points)
    positions = free_grid(points, settings.num_translations, settings.grid_margin)
    return PaperMap(cloud.R_map_from_world, cloud.origin_world, points, cloud.warnings, positions)


def search(
    paper_map: PaperMap, panorama: Panorama, loss: Loss, settings: PaperSettings, workers: Workers
) -> list[Hypothesis]:
    """Select the K2 poses to descend from, of all N_t positions with all N_r rotations."""
    points = paper_map.points
    is_level = settings.gravity == "known"
    rotations = (uniform_yaws if is_level else uniform_rotations)(settings.effective_num_rotations)

    def losses(center_world: Array) -> list[Hypothesis]:
        visible = visible_points(points, center_world) if settings.use_visibility else points
        poses = [Pose(R_cam_from_world, center_world) for R_cam_from_world in rotations]
        hypotheses = [Hypothesis(pose, -loss.value(visible, pose)) for pose in poses]
        return [h for h in hypotheses if np.isfinite(h.score)]

    scored = [h for batch in workers.map(losses, list(paper_map.positions), "search") for h in batch]
    near = Nearness(settings.min_distance, math.radians(settings.min_angle_deg))
    if settings.initialization == "loss-only":
        return best_distinct(scored, settings.num_by_histogram, near)
    by_loss = best_distinct(scored, settings.num_by_loss, near)
    small = shrink(panorama, settings.histogram_width)

    def rescore(h: Hypothesis) -> Hypothesis:
        return Hypothesis(h.pose, histogram_similarity(points, small, h.pose, settings.histogram_bins))

    by_histogram = list(workers.map(rescore, by_loss, "compare colours"))
    return best_distinct(by_histogram, settings.num_by_histogram, near)


def localize_by_paper(
    paper_map: PaperMap, panorama: Panorama, settings: PaperSettings, workers: Workers, watch: Stopwatch
) -> Result:
    """Localize by Algorithm 1 of the paper: search, refine, select; then evaluate the selected pose."""
    points = paper_map.points
    loss = settings.make_loss(panorama)
    with watch.stage("search"):
        starts = search(paper_map, panorama, loss, settings, workers)
    with watch.stage("refine"):
        refined = list(
            workers.map(lambda s: refine_by_solver(points, loss, s.pose, settings), starts, "refine")
        )
        best = min(refined, key=lambda r: r.loss, default=None)
    if best is None or not np.isfinite(best.loss):
        return nothing_found()
    with watch.stage("refine"):
        evidence, others = evaluate_best(points, panorama, best, refined)
    found = Result(
        best_pose=paper_map.to_world(best.pose),
        loss=best.loss,
        evidence=evidence,
        alternatives=tuple(Alternative(paper_map.to_world(h.pose), h.score) for h in others),
    )
    return found.take_belief(believe_roughly(evidence, len(others)), settings.min_confidence)


def believe_roughly(evidence: Evidence, num_others: int) -> Belief:
    """Return a rough belief in the best pose and in the others.

    The others share equally the confidence that the best one loses by their scores.
    """
    best = paper_confidence(evidence)
    alone = paper_confidence(replace(evidence, margin=1.0))
    return make_belief([best, *[(alone - best) / max(num_others, 1)] * num_others])


def evaluate_best(
    points: PackedPoints, panorama: Panorama, best: Refined, refined: list[Refined]
) -> tuple[Evidence, list[Hypothesis]]:
    """Return the evidence at the best pose, and the alternatives, best first."""
    at_pose = measure_agreement(points, panorama, best.pose)
    others = [Hypothesis(r.pose, measure_agreement(points, panorama, r.pose).score) for r in refined]
    others = alternative_poses(Hypothesis(best.pose, at_pose.score), others)
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
    features = evidence.margin, math.log(max(evidence.agreement, LEAST_LOGIT_SCORE))
    logit = PAPER_BIAS + sum(w * f for w, f in zip(PAPER_WEIGHTS, features, strict=True))
    return 1.0 / (1.0 + math.exp(-min(max(logit, -30.0), 30.0)))
