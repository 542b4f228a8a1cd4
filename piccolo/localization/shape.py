"""Photos in a scan without colours: the lines of a photo lie along the walls and the vertical of the scan."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..evidence.comparison import FINE_VIEW, compare
from ..geometry.nearness import ONE_ANSWER
from ..geometry.pose import Pose, multiply, uniform_yaws, yaw_rotation
from ..geometry.sphere import find_cell, pixel_rays
from ..judge.candidate import Candidate, Selection
from ..photo.panorama.gpano import attitude_of_gravity
from ..problem.problem import Problem, prepare_problem
from ..problem.profile import choose_profile
from ..problem.settings import Effort
from ..system.arrays import Array
from ..system.jobs.threads import Workers
from ..views.points_around import round_position
from .attempts import FIRST_BEAM
from .beam import refine_starts, score_starts
from .search import search_poses

NUM_TILTS = 3  # tilts that are searched in full, at most
# fraction of what the scan shows at a pose that it must show at a copy of the place too; chosen between the
# poses of panoramas of three photorealistic buildings (at most 0.42) and those in racks and hotel rooms that
# were made by a program (0.54 to 0.84)
LEAST_ALIKE = 0.5
LEVEL_SINE = np.sin(np.radians(20.0))  # of the largest angle to the horizon of lines that count as level


def is_tilt_known(problem: Problem) -> bool:
    """Return True if the camera's tilt is known, from the settings or from the photo's file."""
    gravity = problem.gravity
    return gravity == "known" or (problem.source.gpano is not None and gravity != "unknown")


def is_explained_by_edges(found: Selection, searched: Problem) -> bool:
    """Return True if a pose explains a photo by its edges.

    Only one pose may do so, unless the rotations were limited to lines along the walls.
    """
    is_alone = found.margin > searched.method.clear_margin or searched.rotations is not None
    return found.best.score > searched.profile.clear_score and is_alone


def align_lines(yaw_of_walls: float | None, axes: Sequence[Array], R_cam_from_level: Array) -> Array | None:
    """Return the rotations (4, 3, 3), camera from map, that put level lines of a photo along the walls.

    The yaw is `ScanMap.yaw_of_walls`, the axes (3,) are those of the photo's lines, R_cam_from_level (3, 3)
    is its tilt. None if the lines or the scan have no such directions.
    """
    level = np.array([axis @ R_cam_from_level for axis in axes]).reshape(-1, 3)
    level = level[np.abs(level[:, 2]) < LEVEL_SINE]
    if yaw_of_walls is None or len(level) != 4:
        return None
    yaws = -np.arctan2(level[:, 1], level[:, 0]) - yaw_of_walls
    return np.stack([multiply(R_cam_from_level, yaw_rotation(float(yaw))) for yaw in yaws])


def align_level(problem: Problem, axes: Sequence[Array], yaw_of_walls: float | None) -> Problem:
    """Return the problem at the camera's tilt: level unless the photo's file gives another."""
    rotations = align_lines(yaw_of_walls, axes, problem.photo.R_cam_from_level)
    return replace(problem, gravity="known", rotations=rotations)


def find_tilts(
    problem: Problem,
    axes: Sequence[Array],
    yaw_of_walls: float | None,
    effort: Effort,
    workers: Workers,
) -> list[Problem]:
    """Return problems with one of the axes (3,) of the photo's lines as vertical, those that fit best.

    In a building, the vertical is one of six directions of lines. Each axis is tried by a brief search.
    """
    effort = effort.brief()
    tried = []
    for axis in axes:
        x, y, z = -axis
        source = replace(problem.source, gpano=attitude_of_gravity((float(x), float(y), float(z))))
        turned = prepare_problem(source, problem.scan_map, problem.prior, problem.gravity, problem.method)
        tried.append(align_level(turned, axes, yaw_of_walls))
    scores = []
    for one in tried:
        starts = search_poses(one, "known", effort, workers)
        scores.append(score_starts(one, starts, workers))
    ranked = sorted(range(len(tried)), key=lambda k: -scores[k])
    return [tried[k] for k in ranked[:NUM_TILTS]]


def find_alike(problem: Problem, pose: Pose, effort: Effort, workers: Workers) -> list[Pose]:
    """Return poses elsewhere at which the scan looks as it does at a pose, as between racks of one kind.

    The edges of the scan that are seen from the pose are localized in the scan, as if they were a photo.
    """
    drawn = draw_scan(problem, pose, effort.num_yaws)
    starts = search_poses(drawn, "known", effort.brief(), workers)
    ends = refine_starts(drawn, starts, FIRST_BEAM, workers)
    here = compare(drawn, pose)

    def is_alike(other: Candidate) -> bool:
        is_elsewhere = not ONE_ANSWER.holds(other.pose, pose)
        return is_elsewhere and other.comparison.compute_ratio(here) >= LEAST_ALIKE

    return [end.pose for end in ends if is_alike(end)]


def draw_scan(problem: Problem, pose: Pose, num_yaws: int) -> Problem:
    """Return a problem whose photo is the scan as seen from a pose, to be searched at the pose's tilt."""
    sums = problem.averages_at(pose, round_position(pose), FINE_VIEW)
    is_shown = problem.photo.panorama.is_valid
    rays = pixel_rays(is_shown.shape[1]) @ pose.R_cam_from_world
    cells = find_cell(rays.reshape(-1, 3).astype(np.float32), FINE_VIEW.num_rings).reshape(is_shown.shape)
    counts = sums[cells, 6:7]
    rgb = np.rint(255.0 * sums[cells, 3:6] / np.maximum(counts, 1.0)).astype(np.uint8)
    is_valid = is_shown & (counts[..., 0] > 0.0)
    photo = problem.photo.take(replace(problem.photo.panorama, rgb=rgb, is_valid=is_valid))
    return replace(
        problem,
        photo=photo,
        profile=choose_profile(photo.small.valid_share, photo.is_partial, True, problem.method),
        rotations=multiply(pose.R_cam_from_world, uniform_yaws(num_yaws)),
    )
