"""Photos of a batch that are not sure, localized together with those that were taken with them.

A photo that is sure is not searched again: its pose is where the others follow from.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from ..evidence.covariance import estimate_errors
from ..evidence.examine import complete, examine
from ..jobs.threads import Stopwatch, Workers, one_blas_thread
from ..judge.candidate import Selection
from ..judge.result import Result
from ..local_features.keypoints import Keypoints
from ..localization.judging import Found
from ..localization.localize import prepare_search
from ..localization.means import Means
from ..panorama import Panorama
from ..problem.problem import Problem
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from .beside import recall_gaussian
from .group import Grouped, localize_linked
from .links import FIRM, match_each
from .members import Member, Shot, check_photos, find_alone


class Known(NamedTuple):
    """A photo, and what is known of it."""

    take: Callable[[], Panorama | None]  # by its refined camera, if it is sure; None if it is another
    settings: CoarseToFineSettings
    result: Result
    is_open: bool  # it is not sure


@one_blas_thread()
def localize_among(
    scan_map: ScanMap, photos: Sequence[Known], workers: Workers, watch: Stopwatch
) -> dict[int, Grouped]:
    """Localize photos that are not sure with those whose pictures match theirs.

    Returns those that are found by others, by their numbers. Photos that are linked with none that is not
    sure cost no more than that is found out; no more than one of them is in memory.
    """
    keypoints = {k: find_keypoints(scan_map, photo, workers, watch) for k, photo in enumerate(photos)}
    with watch.stage("match"):
        numbers = list_asked(keypoints, {k for k, photo in enumerate(photos) if photo.is_open}, workers)
    if not numbers:
        return {}
    check_photos(len(numbers))
    again = ((k, find_again(scan_map, photos[k], workers, watch)) for k in numbers)
    members = {k: member for k, member in again if member is not None}
    settings = photos[numbers[0]].settings
    with watch.stage("refine"):
        means = Means(settings.effort, workers, watch)
        found = localize_linked(members, means, settings.demand)
    return {k: one for k, one in found.items() if photos[k].is_open and one.others}


def find_keypoints(scan_map: ScanMap, photo: Known, workers: Workers, watch: Stopwatch) -> Keypoints | None:
    """Return a photo's keypoints; None if it is not searched, or not by them."""
    panorama = photo.take()
    if panorama is None:
        return None
    problem = prepare_search(scan_map, panorama, photo.settings, watch)
    if problem is None or not problem.profile.uses_matches:
        return None
    with watch.stage("match"):
        return problem.photo.seen(workers).keypoints


def list_asked(keypoints: Mapping[int, Keypoints | None], unsure: set[int], workers: Workers) -> list[int]:
    """List photos that are not sure, and those with which they are linked by matches enough to place them."""
    given = {k: one for k, one in keypoints.items() if one is not None}
    pairs = [two for two, (mine, _) in match_each(given, workers).items() if len(mine) >= FIRM.least]
    return sorted({k for two in pairs if not unsure.isdisjoint(two) for k in two})


def find_again(scan_map: ScanMap, photo: Known, workers: Workers, watch: Stopwatch) -> Member | None:
    """Return a photo as it was found: by its result if it is sure, or else searched; None if it can't be."""
    panorama = photo.take()
    if panorama is None:
        return None
    if photo.is_open:
        return find_alone(scan_map, Shot(panorama, photo.settings), workers, watch)
    problem = prepare_search(scan_map, panorama, photo.settings, watch)
    with watch.stage("refine"):
        return None if problem is None else recall(problem, photo.result, workers)


def recall(problem: Problem, result: Result, workers: Workers) -> Member:
    """Return a photo that is sure as it was found, by its result."""
    assert result.best_pose is not None
    pose = problem.scan_map.from_world(result.best_pose)
    found = complete(problem, Selection(examine(problem, pose), ()), workers)
    errors = estimate_errors(problem, found.best, workers)
    gaussian = recall_gaussian(problem, pose, result.covariance) or errors.gaussian
    alone = replace(result, gaussian=gaussian, std_of_fit=errors.std_of_fit)
    return Member(Found(problem, found, None).forget(), alone)
