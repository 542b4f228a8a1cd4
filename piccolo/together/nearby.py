"""Photos of a group that are not sure, searched once more where the others were taken.

A photo of a bare wall may be anywhere in a whole scan, but fits only few places within reach of a known one.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..geometry.pose import Pose
from ..judge.by_others import LEAST_NONE, believe_nearby
from ..judge.conclude import take_pose
from ..judge.probability import LOCALIZED
from ..judge.result import Result
from ..localization.judging import judge
from ..localization.means import Means
from ..localization.run import find, prepare_search
from ..scan_map.camera_positions import COARSE_SPACING
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array
from .members import Shot
from .optima import spread_optima

REACH = 1.0  # chosen: [m] from the nearest photo of those that were taken together


def localize_nearby(
    scan_map: ScanMap, shot: Shot, alone: Result, located: Sequence[Pose], means: Means
) -> Result | None:
    """Return the result of a photo within reach of others, whose poses in the map are known.

    None if there is no candidate place, or if the photo is not sure there either, as where the points do not
    fix its pose.
    """
    whole = prepare_search(scan_map, shot.panorama, shot.settings, means.watch)
    if whole is None:
        return None
    near = narrow_around(whole.scan_map, located)
    if len(near.sparse) == 0:
        return None
    problem = replace(whole, scan_map=near)
    demand = shot.settings.demand
    searched = find(problem, scan_map, means)
    found = judge(searched, means, demand, may_promote=False)
    if found.best_pose is None or found.gaussian is None:
        return None
    elsewhere = compute_odds_elsewhere(scan_map, alone, located)
    belief = believe_nearby(found.belief, elsewhere, len(whole.scan_map.sparse) / len(near.sparse))
    result = found.take_belief(belief, demand.min_confidence)
    if result.status != LOCALIZED:
        return None
    best = searched.selection.best
    widened = found.gaussian.blur(spread_optima(searched.problem, best, found.gaussian, means.workers))
    share = demand.accuracy.probability(widened) / demand.accuracy.probability(found.gaussian)
    belief = replace(belief, within=share * belief.within)
    result = take_pose(result, widened, scan_map).take_belief(belief, demand.min_confidence)
    return result if result.status == LOCALIZED else None


def compute_odds_elsewhere(scan_map: ScanMap, alone: Result, located: Sequence[Pose]) -> float:
    """Return the odds of a photo's places beyond reach of the others, against that none is right."""
    if alone.best_pose is None:
        return 0.0
    poses = [alone.best_pose, *(alternative.pose for alternative in alone.alternatives)]
    centers = np.array([scan_map.from_world(pose).center_world for pose in poses])
    is_beyond = measure_distances(centers, located) > REACH
    places = np.array(alone.belief.place)
    return float(places[:-1][is_beyond].sum() / max(places[-1], LEAST_NONE))


def measure_distances(centers: Array, located: Sequence[Pose]) -> Array:
    """Return the distances (N,) [m] of positions (N, 3) from the nearest of several poses."""
    offsets = centers[:, None] - [pose.center_world for pose in located]
    return np.asarray(np.linalg.norm(offsets, axis=-1).min(axis=1))


def narrow_around(scan_map: ScanMap, located: Sequence[Pose]) -> ScanMap:
    """Return the map with only those cells of the coarse grid that are within reach of poses."""
    distances = measure_distances(scan_map.centers[scan_map.sparse], located)
    return scan_map.narrow(distances <= REACH + COARSE_SPACING / 2)
