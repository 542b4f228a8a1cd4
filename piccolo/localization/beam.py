"""From starts to a few poses: successive halving on ever finer views."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..evidence.examine import examine
from ..geometry.cone import Cone
from ..geometry.nearness import DESCENDED, DESCENDING, ONE_ANSWER, Nearness, non_maximum_suppression
from ..geometry.pose import Pose
from ..judge.alternatives import Hypothesis, best_distinct, sort_by_score, suppress_near
from ..judge.candidate import Candidate
from ..optimize.channel_loss import ChannelProblem, descend_channels, score
from ..photo.panorama.local_normalization import LEVELS_PER_UNIT, ZERO_LEVEL
from ..photo.panorama.texels import Texels
from ..problem.photo_cone import find_cone, select_cells
from ..problem.problem import Problem
from ..problem.profile import Beam
from ..problem.settings import Effort
from ..problem.stages import AROUND_MIDDLE, FINE, FIRST, MIDDLE, SECOND, Stage
from ..system.arrays import Array, Int64s
from ..system.jobs.threads import Workers
from ..system.kernels.jit import F0, kernel
from ..views.candidate_views import SEARCH_VIEW, Views
from ..views.view import ViewArrays
from .ladder import climb, refine
from .search import Starts, search_poses

STARTS_A_TASK = 16  # starts that a thread takes at a time


class Ends(NamedTuple):
    """Ends of short descents, best first."""

    poses: Starts
    scores: Array  # (N,)

    @property
    def best_score(self) -> float:
        """Score of the best end; 0 if there is none."""
        return float(self.scores.max(initial=0.0))


def refine_starts(problem: Problem, starts: Starts, beam: Beam, workers: Workers) -> list[Candidate]:
    """Refine the starts by successive halving to a few distinct poses, best first."""
    coarse = keep_ends(descend_prepared(problem, starts, problem.profile.first, workers), beam.num_coarse)
    coarse = keep_ends(descend_prepared(problem, coarse, SECOND, workers), beam.num_middle)
    descend = partial(refine, problem, workers=workers)
    middle = workers.map(partial(descend, stage=MIDDLE), coarse.poses(), "descend")
    narrowed = narrow(middle, beam.num_fine)
    perturbed = workers.map(partial(descend, stage=AROUND_MIDDLE), narrowed, "descend")
    fine = workers.map(partial(descend, stage=FINE), narrow(perturbed, beam.num_fine), "descend")
    best = [end.pose for end in best_distinct(fine, beam.num_perturbed, DESCENDED)]
    ends = workers.map(partial(climb, problem, workers=workers), best, "descend")
    distinct = keep_distinct([*ends, *fine], middle, problem.method.most_found)
    kept = keep_comparable(distinct, problem.method.faint_part)

    def examine_end(end: Hypothesis) -> Candidate:
        return replace(examine(problem, end.pose), is_climbed=end.is_climbed)

    return sort_by_score(workers.map(examine_end, kept, "descend"))


def refine_matches(problem: Problem, poses: Sequence[Pose], workers: Workers) -> list[Candidate]:
    """Descend on fine cells from poses by matches; keep the better of each start and end, best first."""

    def refine_match(pose: Pose) -> Candidate:
        end = refine(problem, pose, workers, FINE).pose
        return max(examine(problem, pose), examine(problem, end), key=lambda h: h.score)

    return sort_by_score(workers.map(refine_match, poses, "descend"))


def keep_ends(ends: Ends, count: int) -> Starts:
    """Keep `count` of the ends: the best ones, and some that lie far apart (`best_and_alternatives`)."""
    poses = ends.poses
    return poses.take(best_and_alternatives(poses.R_cam_from_map, poses.center_map, count, DESCENDING))


def best_and_alternatives(rotations: Array, centers: Array, count: int, near: Nearness) -> Int64s:
    """Return the indices of `count` of the ranked poses (n, 3, 3), (n, 3), best first, in ascending order.

    Three quarters are the best poses that differ a little, a quarter the best that lie far apart.
    """
    best = non_maximum_suppression(rotations, centers, count - count // 4, near)
    apart = non_maximum_suppression(rotations, centers, count, ONE_ANSWER)
    others = apart[~np.isin(apart, best)][: count - len(best)]
    return np.sort(np.concatenate([best, others]))


def narrow(ends: Sequence[Hypothesis], count: int) -> list[Pose]:
    """Return `count` of the ends by `best_and_alternatives`, ranked by score."""
    ranked = [end.pose for end in sort_by_score(ends)]
    rotations = np.array([pose.R_cam_from_world for pose in ranked])
    centers = np.array([pose.center_world for pose in ranked])
    return [ranked[k] for k in best_and_alternatives(rotations, centers, count, DESCENDED)]


def keep_distinct(fine: Sequence[Hypothesis], middle: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """Return the best poses of fine cells, then of middle cells, by non-maximum suppression."""
    return suppress_near([*sort_by_score(fine), *sort_by_score(middle)], most, ONE_ANSWER)


def keep_comparable(ranked: Sequence[Hypothesis], faint_part: float) -> list[Hypothesis]:
    """Drop the poses that score far below the best: a full comparison could not bring them near it."""
    least = faint_part * max((one.score for one in ranked), default=0.0)
    return [one for one in ranked if one.score >= least]


def descend_briefly(problem: Problem, effort: Effort, workers: Workers) -> Ends:
    """Search at the photo's tilt, and descend a few steps."""
    starts = search_poses(problem, "known", effort, workers)
    return descend_prepared(problem, starts, problem.profile.first, workers)


def score_briefly(problem: Problem, effort: Effort, workers: Workers) -> float:
    """Return the best score of a brief search."""
    return descend_briefly(problem, effort, workers).best_score


def score_mirror(problem: Problem, effort: Effort, workers: Workers) -> float:
    """Return the best score of a brief search with the photo mirrored."""
    return score_briefly(problem.mirror(), effort.brief(problem.method.scored_starts), workers)


def score_near(problem: Problem, pose: Pose, workers: Workers) -> float:
    """Return the score a few steps from a pose, on the prepared view of the candidate nearest to it."""
    distances = np.linalg.norm(problem.scan_map.centers - pose.center_world, axis=1)
    nearest = np.array([distances.argmin()])
    start = Starts(pose.R_cam_from_world[None], pose.center_world[None], nearest)
    return descend_prepared(problem, start, problem.profile.first, workers).best_score


def score_starts(problem: Problem, starts: Starts, workers: Workers) -> float:
    """Return the best score after short descents from the best starts."""
    best = starts.take(np.arange(min(problem.method.scored_starts, len(starts.candidate))))
    return descend_prepared(problem, best, FIRST, workers).best_score


@kernel
def descend_starts(
    views: Views,
    view: ViewArrays,
    image: Texels,
    scale: float,
    num_iterations: int,
    tolerance: float,
    cone: Cone,
    row: Int64s,
    R_cam_from_map: Array,
    center_map: Array,
    scores: Array,
) -> None:
    """Descend from each start, (n, 3, 3) and (n, 3) in place, on the cells of its row (n,) of the views.

    Cells outside of the cone around what the photo shows, as seen from the start, are left out.
    """
    centers, offsets, unit, features, is_seen = views
    solid_angle = view.solid_angle
    blocks = view.blocks
    texels = image.rgbx
    width = image.width
    R = R_cam_from_map
    t = center_map
    n = len(solid_angle)
    room = np.empty(3 * n, np.float32)
    more_room = np.empty(3 * n, np.float32)
    weights = np.empty(n, np.float32)
    own_blocks = np.empty(n, np.int32)
    kept = np.empty(n, np.int64)
    for k in range(len(row)):
        c = row[k]
        for i in range(3):
            t[k, i] -= centers[c, i]
        num = select_cells(offsets[c], unit[c], cone, R[k], t[k], kept)
        points = room[: 3 * num].reshape(3, num)
        levels = more_room[: 3 * num].reshape(3, num)
        for i in range(3):
            for m in range(num):
                points[i, m] = np.float32(offsets[c, i, kept[m]]) * unit[c]
                levels[i, m] = np.float32(features[c, i, kept[m]]) + np.float32(ZERO_LEVEL)
        for m in range(num):
            weights[m] = solid_angle[kept[m]] if is_seen[c, kept[m]] else F0
            own_blocks[m] = blocks[kept[m]]
        problem = ChannelProblem(points, levels, weights[:num], texels, width, scale)
        descend_channels(problem, num_iterations, tolerance, R[k], t[k])
        scores[k] = score(points, levels, weights[:num], own_blocks[:num], texels, width, R[k], t[k])
        for i in range(3):
            t[k, i] += centers[c, i]


def descend_prepared(problem: Problem, starts: Starts, stage: Stage, workers: Workers) -> Ends:
    """Descend from each start on its candidate's prepared view."""
    R = starts.R_cam_from_map.copy()
    t = starts.center_map.copy()
    scores = np.empty(len(t))
    row, views = problem.scan_map.views.at(starts.candidate, workers)
    view = SEARCH_VIEW.arrays
    image = problem.photo.image(stage.image)
    limits = stage.limits
    scale = limits.loss_scale * LEVELS_PER_UNIT
    cone = find_cone(image)

    def run(lo: int) -> None:
        part = slice(lo, lo + STARTS_A_TASK)
        descend_starts(
            views,
            view,
            image,
            scale,
            limits.num_iterations,
            limits.tolerance,
            cone,
            row[part],
            R[part],
            t[part],
            scores[part],
        )

    workers.map(run, range(0, len(t), STARTS_A_TASK), "descend")
    order = np.argsort(-scores, kind="stable")
    return Ends(Starts(R, t, starts.candidate).take(order), scores[order])
