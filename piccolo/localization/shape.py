"""Photos in a scan without colours: the lines of a photo lie along the walls and the vertical of the scan."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..geometry.pose import Array, yaw_rotation
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..panorama.gpano import attitude_of_gravity
from ..scan_map.scan_map import ScanMap
from .brief import brief_query, score_starts
from .query import find_tilt, prepare_query
from .search import search_poses
from .selection import CLEAR_MARGIN, CLEAR_SHAPE, Selection
from .settings import CoarseToFineSettings, MethodConfig

NUM_TILTS = 3  # that are searched in full, at most
LEVEL_SINE = np.sin(np.radians(20.0))  # of the angle of level lines to the horizon, at most


class Aligned(NamedTuple):
    """A tilt of the camera, and rotations to be searched with it."""

    panorama: Panorama  # with the tilt
    settings: CoarseToFineSettings
    rotations: Array  # (N, 3, 3) camera from map, that put the photo's lines along the walls; N = 4 or 0


def is_tilt_known(panorama: Panorama, settings: CoarseToFineSettings) -> bool:
    """Return True if the settings, or the photo, say how the camera was tilted."""
    return settings.gravity == "known" or (panorama.gpano is not None and settings.gravity != "unknown")


def is_explained(found: Selection, searched: Aligned) -> bool:
    """Return True if a pose explains a photo by its edges: one alone, unless lines lie along the walls."""
    is_alone = found.margin > CLEAR_MARGIN or len(searched.rotations) > 0
    return found.best.score > CLEAR_SHAPE and is_alone


def align_lines(yaw_of_walls: float | None, axes: Sequence[Array], R_cam_from_level: Array) -> Array:
    """Return the rotations (4, 3, 3), camera from map, that put level lines of a photo along the walls.

    The yaw is `ScanMap.yaw_of_walls`, the axes (3,) are those of the photo's lines, R_cam_from_level (3, 3)
    is its tilt. (0, 3, 3) if the lines or the scan have no such directions.
    """
    level = np.array([axis @ R_cam_from_level for axis in axes]).reshape(-1, 3)
    level = level[np.abs(level[:, 2]) < LEVEL_SINE]
    if yaw_of_walls is None or len(level) != 4:
        return np.empty((0, 3, 3))
    yaws = -np.arctan2(level[:, 1], level[:, 0]) - yaw_of_walls
    return np.stack([R_cam_from_level @ yaw_rotation(float(yaw)) for yaw in yaws])


def align_level(
    yaw_of_walls: float | None, panorama: Panorama, axes: Sequence[Array], settings: CoarseToFineSettings
) -> Aligned:
    """Return the known tilt of a camera, level unless the photo says another."""
    known = replace(settings, gravity="known")
    R_cam_from_level, _ = find_tilt(panorama)
    return Aligned(panorama, known, align_lines(yaw_of_walls, axes, R_cam_from_level))


def find_tilts(
    scan_map: ScanMap,
    yaw_of_walls: float | None,
    panorama: Panorama,
    axes: Sequence[Array],
    settings: CoarseToFineSettings,
    workers: Workers,
    method: MethodConfig,
) -> list[Aligned]:
    """Return the tilts with one of the axes (3,) of the photo's lines as vertical, those that fit best.

    In a building the vertical is one of six directions of lines. Each is searched briefly.
    """
    tried = []
    for axis in axes:
        tilted = replace(panorama, gpano=attitude_of_gravity(tuple((-axis).tolist())))
        tried.append(align_level(yaw_of_walls, tilted, axes, settings))
    scores = []
    for one in tried:
        query = prepare_query(one.panorama, scan_map, one.settings, workers, method, one.rotations)
        brief = brief_query(query)
        scores.append(score_starts(brief, search_poses(brief, "known")))
    ranked = sorted(range(len(tried)), key=lambda k: -scores[k])
    return [tried[k] for k in ranked[:NUM_TILTS]]
