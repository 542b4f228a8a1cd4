"""A mirrored photo, left for right: if it fits the scan better, the photo was turned over.

The scan shows a mirror image nowhere, so that it fits by chance alone. If it fits nearly as well as the photo
itself, that one may fit by chance too: it is a decoy (Elias and Gygi, 2007).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..evidence.examine import count_agreeing
from ..geometry.nearness import ONE_ANSWER
from ..geometry.pose import Pose, multiply, uniform_yaws
from ..judge.candidate import Candidate
from ..problem.method import Method
from ..problem.photo_images import MIRROR
from ..problem.problem import Problem
from ..problem.settings import Effort
from ..system.arrays import Array
from ..system.jobs.threads import Workers
from .attempts import FIRST_BEAM
from .beam import Ends, descend_briefly, refine_starts
from .search import search_poses

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def find_mirrored(problem: Problem, best: Candidate, effort: Effort, workers: Workers) -> Candidate | None:
    """Return the best pose of the mirrored photo; None if it explains far less than the photo's own best.

    The mirrored photo is not searched if the photo is explained well and has many matches, if the scan has no
    colours, and if the pose is by whole views alone, as the first look has then compared both. One of a part
    of the sphere with few matches is searched as the photo was too, at any tilt of a camera held about level:
    a wrong pose may have another tilt than the mirrored photo at its right one.
    """
    method = problem.method
    if is_explained(method, best) or not problem.profile.uses_matches:
        return None
    mirrored = problem.mirror()
    found = search_mirrored(problem, mirrored, best.pose, effort, workers)
    is_doubtful = problem.profile.is_narrow and (best.num_matches or 0) < method.sure_matches
    if is_doubtful and not is_decoy(method, found, best):
        found = search_level(mirrored, effort, workers)
    return count_agreeing(mirrored, found[0], workers) if is_decoy(method, found, best) else None


def is_decoy(method: Method, found: Sequence[Candidate], best: Candidate) -> bool:
    """Return True if the best pose of the mirrored photo explains nearly as much as the photo's own."""
    return bool(found) and found[0].score >= method.decoy_ratio * best.score


def search_level(mirrored: Problem, effort: Effort, workers: Workers) -> list[Candidate]:
    """Return poses of a mirrored photo at its known tilt, else at those of a camera held about level."""
    tilts = "known" if mirrored.photo.has_tilt else mirrored.profile.default_tilt
    starts = search_poses(mirrored, tilts, effort, workers)
    return refine_starts(mirrored, starts, mirrored.profile.beam, workers)


def is_explained(method: Method, best: Candidate) -> bool:
    """Return True if a pose explains a photo so well that it is not mirrored.

    A score alone is not enough: a thin wall seen from behind explains much of a mirrored photo of its front.
    """
    return best.score >= method.enough_explained and (best.num_matches or 0) >= method.enough_matches


def search_mirrored(
    problem: Problem, mirrored: Problem, pose: Pose, effort: Effort, workers: Workers
) -> list[Candidate]:
    """Return poses of the mirrored photo, best first, by whole views.

    A wall or a ceiling seen from behind fits the mirrored photo, so that this has the tilt of the photo's own
    pose, or that tilt upside down. The search is brief if a brief search of the photo as it is ends, with the
    best of its scores, at the photo's own pose.
    """
    turned = replace(mirrored, rotations=list_mirrored(pose.R_cam_from_world, effort.num_yaws))
    own = replace(problem, rotations=multiply(pose.R_cam_from_world, uniform_yaws(effort.num_yaws)))
    own_ends = descend_briefly(own, effort.brief(), workers)
    if not is_found_again(own_ends, pose):
        starts = search_poses(turned, "known", effort, workers)
        return refine_starts(turned, starts, problem.profile.beam, workers)
    ends = descend_briefly(turned, effort.brief(), workers)
    if ends.best_score < problem.method.decoy_ratio * own_ends.best_score:
        return []
    return refine_starts(turned, ends.poses, FIRST_BEAM, workers)


def list_mirrored(R_cam_from_map: Array, num_yaws: int) -> Array:
    """Return rotations (2 N, 3, 3) of a mirrored photo: at the tilt of a pose, and at that upside down."""
    yaws = uniform_yaws(num_yaws)
    tilt = multiply(multiply(MIRROR, R_cam_from_map), MIRROR)
    return multiply(tilt, np.concatenate([yaws, multiply(UPSIDE_DOWN, yaws)]))


def is_found_again(ends: Ends, pose: Pose) -> bool:
    """Return True if the best end of a brief search is near a pose."""
    best = ends.poses.take(ends.scores.argsort()[-1:]).poses()
    return any(ONE_ANSWER.holds(end, pose) for end in best)
