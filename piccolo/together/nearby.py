"""Photos of a group that are not sure, searched once more where the others were taken.

A photo of a bare wall may be anywhere in a whole scan, but fits only few places within reach of a known one.
Where enough photos are sure, they also tell where somebody stands who took them (`at_spot`).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from ..evidence.examine import examine
from ..geometry.nearness import ONE_IN_BUNDLE
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian
from ..judge.belief import make_belief
from ..judge.by_others import (
    LEAST_NONE,
    MISSED,
    MISSED_TURNED,
    Prospect,
    believe_exact,
    believe_nearby,
    local_share,
    weigh_stray,
)
from ..judge.probability import Mirrored, posterior
from ..judge.result import Result
from ..judge.selection import assess, credit_copies
from ..localization.copies import list_reported
from ..localization.judging import Found, decide_case, gather_case, try_mirrored
from ..localization.means import Means
from ..localization.run import find, prepare_search
from ..problem.accuracy import Demand
from ..scan_map.camera_positions import COARSE_SPACING
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array
from .at_spot import Held, Nearby, fits_mirrored, hold_at_spots
from .bundle import EVEN_ODDS
from .members import Shot
from .spot import find_spots

TAKEN_ELSEWHERE = "the photo fits best where none of the others was taken: with them it is less sure"
REACH = 1.0  # chosen: [m] from the nearest photo of those that were taken together
AS_BEFORE = REACH / 2  # chosen: [m] from the others near which a photo was searched: it is not searched again


class Witness(NamedTuple):
    """A photo that is sure of its place: others of its group are searched near it."""

    gaussian: PoseGaussian  # in the map, as the photo tells it
    probability: float  # of that place


class Searched(NamedTuple):
    """Poses of a photo near others, kept for a further look: more of the others may be known then."""

    found: Found
    others: Sequence[Pose]
    gain: float  # places where the photo may have been taken in the whole scan, as a multiple of those near

    def forget(self) -> "Searched":
        """Return the poses without the images and matches, which take memory."""
        return self._replace(found=self.found.forget())

    def covers(self, others: Sequence[Pose]) -> bool:
        """Return True if others were taken about where the photo has been searched."""
        centers = np.array([pose.center_world for pose in others])
        return bool((measure_distances(centers, self.others) <= AS_BEFORE).all())


class FoundNearby(NamedTuple):
    """A photo near others."""

    result: Result
    odds: float  # of its places there, if it was taken there
    found: Found
    held: Held  # the pose of the result
    nearby: Nearby

    def fits_mirrored(self, means: Means) -> bool:
        """Return True if the photo fits the spots of the others better mirrored."""
        return fits_mirrored(self.found, self.held, self.nearby, means)


def search_nearby(
    scan_map: ScanMap, shot: Shot, others: Sequence[Pose], means: Means, before: Searched | None = None
) -> Searched | None:
    """Search a photo within reach of others; None if there is no place to search.

    It is not searched again if it was searched there `before`.
    """
    if before is not None and before.covers(others):
        return before
    whole = prepare_search(scan_map, shot.panorama, shot.settings, means.watch)
    if whole is None:
        return None
    near = narrow_around(whole.scan_map, others)
    if len(near.sparse) == 0:
        return None
    few_places = replace(whole, scan_map=near, profile=whole.profile.near_others())
    found = find(few_places, scan_map, means)
    gain = len(whole.scan_map.sparse) / len(near.sparse)
    return Searched(found.confirm() if shot.is_confirmed else found, others, gain)


def localize_nearby(
    scan_map: ScanMap,
    searched: Searched,
    alone: Result,
    located: Sequence[Witness],
    means: Means,
    demand: Demand,
) -> FoundNearby | None:
    """Return the result of a photo within reach of others, of which it is known where they were taken.

    None if there is no candidate place, or if it is not likelier than not, or the photo no surer than alone.
    """
    elsewhere = compute_odds_elsewhere(scan_map, alone, take_poses(located))
    found = look_nearby(searched, alone, elsewhere, located, means, demand)
    if found is None or found.result.belief.best_place <= EVEN_ODDS:
        return None
    return found if found.result.confidence > alone.confidence and not found.fits_mirrored(means) else None


def doubt_stray(
    scan_map: ScanMap,
    shot: Shot,
    alone: Result,
    located: Sequence[Witness],
    num_strays: int,
    means: Means,
) -> Result:
    """Return the result of a photo that is sure by itself, but elsewhere than where others were taken.

    It is that near the others, if this is likelier. `num_strays` other photos are sure elsewhere too.
    """
    poses = take_poses(located)
    demand = shot.settings.demand
    elsewhere = compute_odds_elsewhere(scan_map, alone, poses)
    searched = search_nearby(scan_map, shot, poses, means)
    found = searched and look_nearby(searched, alone, elsewhere, located, means, demand)
    odds = 0.0 if found is None else found.odds
    near, far = weigh_stray(odds, elsewhere, len(located), num_strays)
    if found is not None and near > far and not found.fits_mirrored(means):
        return found.result
    belief = alone.belief.scale(min(1.0, far / alone.belief.best_place))
    doubted = alone.take_belief(belief, demand.min_confidence)
    return replace(doubted, warnings=(*doubted.warnings, TAKEN_ELSEWHERE))


def look_nearby(
    searched: Searched,
    alone: Result,
    elsewhere: float,
    located: Sequence[Witness],
    means: Means,
    demand: Demand,
) -> FoundNearby | None:
    """Judge a photo that was searched within reach of others; None if there is no candidate place.

    `elsewhere` are the odds of its places beyond reach, as of `compute_odds_elsewhere`.
    """
    if searched.found.selection.best.score < 0.0:
        return None
    num_near = len(searched.found.problem.scan_map.sparse)
    nearby = Nearby(find_spots([one.gaussian for one in located]), num_near, demand.accuracy)
    found, held = hold_at_spots(keep_near(searched.found, take_poses(located)), nearby, means)
    prospect = Prospect(elsewhere, searched.gain, find_trust(located, held.candidate.pose))
    mirrored = recall_mirrored(found, alone, held.candidate.pose)
    judged = judge_nearby(found, held, prospect, mirrored, means, demand)
    return None if judged is None else FoundNearby(*judged, found, held, nearby)


def keep_near(found: Found, located: Sequence[Pose]) -> Found:
    """Keep the poses of a photo within reach of others; all if none is: some were found by features."""
    centers = np.array([one.pose.center_world for one in found.selection.candidates])
    is_near = measure_distances(centers, located) <= REACH + COARSE_SPACING
    near = list(compress(found.selection.candidates, is_near))
    return found._replace(selection=found.selection.take(near)) if near else found


def find_trust(located: Sequence[Witness], pose: Pose) -> float:
    """Return the probability of the place of the surest witness within reach of a pose; 0 without one."""
    near = [one for one in located if one.gaussian.pose.distance(pose) <= REACH + COARSE_SPACING]
    return max((one.probability for one in near), default=0.0)


def take_poses(located: Sequence[Witness]) -> list[Pose]:
    """Return the poses without their errors."""
    return [one.gaussian.pose for one in located]


def recall_mirrored(found: Found, alone: Result, pose: Pose) -> Mirrored | None:
    """Return the evidence for the mirrored photo by the photo alone, if that was found at the same place.

    The mirrored photo was searched in the whole scan then; it need not have been taken near the others.
    """
    if alone.best_pose is None:
        return None
    is_same = ONE_IN_BUNDLE.holds(found.problem.scan_map.from_world(alone.best_pose), pose)
    return alone.mirrored if is_same else None


def judge_nearby(
    found: Found,
    held: Held,
    prospect: Prospect,
    mirrored: Mirrored | None,
    means: Means,
    demand: Demand,
) -> tuple[Result, float] | None:
    """Return the result of a photo for the best of its poses near others; None if nothing fixes it.

    `mirrored` is the evidence for the mirrored photo, if that is known. Return also the odds of the photo's
    places there, if it was taken there.
    """
    if held.gaussian is None:
        return None
    problem, selection, fit = found
    reported, is_copy = list_reported(problem, selection, means.effort, means.workers)
    standings = credit_copies(assess(problem.profile, reported), is_copy)
    near = make_belief(posterior(standings, held.std_of_fit, problem.method)[:-1])
    there = examine(problem, held.gaussian.pose)
    at_pose = Found(problem, reported.take([there, *reported.alternatives]), fit)
    case = gather_case(at_pose, held.gaussian, means)
    if case is None:
        return None
    case = case._replace(mirrored=mirrored)
    case = try_mirrored(problem, case, believe_nearby(near, prospect), means)
    near = make_belief(posterior(standings, held.std_of_fit, problem.method, mirrored=case.mirrored)[:-1])
    odds = near.place[0] / max(near.place[-1], LEAST_NONE) / math.exp(held.candidate.log_by_others)
    local = local_share(odds, MISSED_TURNED if held.is_turned else MISSED)
    within = believe_exact(held.shares, held.exact, local)
    belief = replace(believe_nearby(near, prospect), within=within)
    result = decide_case(problem, case, belief, means, demand.min_confidence)
    return result, prospect.gain * (1.0 - near.place[-1]) / max(near.place[-1], LEAST_NONE)


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
