"""Photos of a group that are not sure, searched once more where the others were taken.

What a bare wall shows is no place in a whole scan, but one of few within reach of a place that is known.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..geometry.pose import Pose
from ..judge.by_others import believe_nearby
from ..judge.probability import LOCALIZED
from ..judge.result import Result
from ..localization.judging import judge
from ..localization.localize import find, prepare_search
from ..localization.means import Means
from ..scan_map.camera_positions import COARSE_SPACING
from ..scan_map.scan_map import ScanMap
from .members import Shot

REACH = 1.0  # chosen: [m] of a photo that is taken with others, from the nearest of these


def localize_nearby(
    scan_map: ScanMap, shot: Shot, alone: Result, located: Sequence[Pose], means: Means
) -> Result | None:
    """Return the result of a photo within reach of others, whose poses in the map are known.

    None if there is no place, or it is not sure there either, as where its points do not fix it.
    """
    whole = prepare_search(scan_map, shot.panorama, shot.settings, means.watch)
    if whole is None:
        return None
    near = narrow_around(whole.scan_map, located)
    if len(near.sparse) == 0:
        return None
    problem = replace(whole, scan_map=near).without_map_features()
    demand = shot.settings.demand
    found = judge(find(problem, scan_map, means), means, demand, may_promote=False)
    if found.best_pose is None or found.gaussian is None:
        return None
    belief = believe_nearby(found.belief, alone.belief, len(whole.scan_map.sparse) / len(near.sparse))
    result = found.take_belief(belief, demand.min_confidence)
    return result if result.status == LOCALIZED else None


def narrow_around(scan_map: ScanMap, located: Sequence[Pose]) -> ScanMap:
    """Return the map with only those cells of the coarse grid that are within reach of poses."""
    offsets = scan_map.centers[scan_map.sparse][:, None] - [pose.center_world for pose in located]
    distances = np.linalg.norm(offsets, axis=-1).min(axis=1)
    return scan_map.narrow(distances <= REACH + COARSE_SPACING / 2)
