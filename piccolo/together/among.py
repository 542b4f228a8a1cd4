"""Photos of a batch that are not sure, localized together with those that were taken with them.

A photo that is sure is not searched again: the poses of the others follow from its pose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from ..evidence.covariance import estimate_pose_errors
from ..evidence.examine import complete, examine
from ..judge.candidate import Selection
from ..judge.probability import LOCALIZED
from ..judge.reasons import Reason
from ..judge.result import Result
from ..judge.selection import assess
from ..local_features.keypoints import Keypoints
from ..localization.judging import Found, gather_mirrored
from ..localization.means import Means
from ..localization.run import prepare_search
from ..photo.panorama import Panorama
from ..problem.problem import Problem
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.jobs.threads import Stopwatch, Workers, one_blas_thread
from .beside import recall_gaussian
from .group import NUM_ANCHORS, localize_linked
from .links import FIRM, WEAK, Placed, find_links, match_each, spread
from .members import Grouped, Member, Shot, check_photos, find_alone


class Known(NamedTuple):
    """A photo with its result so far."""

    take: Callable[
        [], Panorama | None
    ]  # reads it, if it is sure with its refined camera; None if it has changed
    settings: CoarseToFineSettings
    result: Result
    is_open: bool  # the photo is not sure


@one_blas_thread()
def localize_among(
    scan_map: ScanMap, photos: Sequence[Known], workers: Workers, watch: Stopwatch
) -> dict[int, Grouped]:
    """Localize photos that are not sure with those whose pictures match theirs.

    Returns the results of those that were found by others, by their numbers. A photo that is not sure is
    searched again if its matches with others give it any pose.
    """
    keypoints = {k: list_keypoints(scan_map, photo, workers, watch) for k, photo in enumerate(photos)}
    with watch.stage("match"):
        numbers = list_matched(keypoints, {k for k, photo in enumerate(photos) if photo.is_open}, workers)
    if not numbers:
        return {}
    check_photos(len(numbers))
    known = ((k, recall_found(scan_map, photos[k], workers, watch)) for k in numbers)
    members = {k: member for k, member in known if member is not None}
    with watch.stage("match"):
        placed = list_placed(members, {k for k in members if photos[k].is_open}, workers)
    if not placed:
        return {}
    settings = photos[numbers[0]].settings
    means = Means(settings.effort, workers, watch)
    for k in [k for k in members if photos[k].is_open]:
        member = search_again(scan_map, photos[k], means) if k in placed else None
        if member is None:
            del members[k]
        else:
            members[k] = member
    with watch.stage("refine"):
        found = localize_linked(compare_sure(members, means), means, settings.demand)
    return {k: one for k, one in found.items() if photos[k].is_open and one.others}


def list_keypoints(scan_map: ScanMap, photo: Known, workers: Workers, watch: Stopwatch) -> Keypoints | None:
    """Return a photo's keypoints; None if the photo can't be searched, or is searched without keypoints."""
    panorama = photo.take()
    if panorama is None:
        return None
    problem = prepare_search(scan_map, panorama, photo.settings, watch)
    if problem is None or not problem.profile.uses_matches:
        return None
    with watch.stage("match"):
        return problem.photo.features(workers).keypoints


def list_matched(keypoints: Mapping[int, Keypoints | None], unsure: set[int], workers: Workers) -> list[int]:
    """List photos that are not sure, and those to which they have enough matches to be placed by them."""
    given = {k: one for k, one in keypoints.items() if one is not None}
    pairs = [two for two, (mine, _) in match_each(given, workers).items() if len(mine) >= FIRM.least]
    return sorted({k for two in pairs if not unsure.isdisjoint(two) for k in two})


def recall_found(scan_map: ScanMap, photo: Known, workers: Workers, watch: Stopwatch) -> Member | None:
    """Return a photo as it was found, from its result; None if its file has changed, or it has no pose."""
    panorama = photo.take()
    result = photo.result
    problem = panorama and prepare_search(scan_map, panorama, photo.settings, watch)
    if not isinstance(problem, Problem) or result.best_pose is None:
        return None
    with watch.stage("refine"):
        known = [result.best_pose, *(alternative.pose for alternative in result.alternatives)]
        best, *others = [examine(problem, scan_map.from_world(pose)) for pose in known]
        found = complete(problem, Selection(best, tuple(others)), workers)
        errors = estimate_pose_errors(problem, found.best, workers)
        gaussian = recall_gaussian(problem, best.pose, result.covariance) or errors.gaussian
        alone = replace(result, gaussian=gaussian, std_of_fit=errors.std_of_fit)
        return Member(Found(problem, found, None).forget(), alone)


def compare_sure(members: Mapping[int, Member], means: Means) -> dict[int, Member]:
    """Return photos, the sure ones with the evidence that results do not keep, if one was mirrored."""
    if not any(Reason.MIRRORED in one.alone.belief.ruled_out for one in members.values()):
        return dict(members)
    lacking = [k for k, one in members.items() if one.alone.status == LOCALIZED and not one.alone.mirrored]
    return {**members, **{k: compare_mirror(members[k], means) for k in lacking}}


def compare_mirror(member: Member, means: Means) -> Member:
    """Return a photo with the evidence for its poses, and for the mirrored photo."""
    problem, selection, _ = member.found
    standings = tuple(assess(problem.profile, selection))
    mirrored = gather_mirrored(problem, selection.best, means)
    return replace(member, alone=replace(member.alone, standings=standings, mirrored=mirrored))


def search_again(scan_map: ScanMap, photo: Known, means: Means) -> Member | None:
    """Search a photo again by itself; None if its file has changed."""
    panorama = photo.take()
    if panorama is None:
        return None
    return find_alone(scan_map, Shot(panorama, photo.settings), means.workers, means.watch)


def list_placed(members: Mapping[int, Member], unsure: set[int], workers: Workers) -> set[int]:
    """List the unsure photos whose poses follow from those of sure photos, or from each other's own poses."""
    links = find_links({k: member.found.problem for k, member in members.items()}, workers)

    def place(number: int, rank: int = 0) -> Placed:
        return links.place(number, members[number].own_poses[rank][0].pose)

    firmly = spread(links, {k: place(k) for k in members if k not in unsure}, members, FIRM)
    placed = set(spread(links, firmly, members, WEAK)) & unsure
    for k in sorted(unsure - placed):
        for rank in range(min(len(members[k].own_poses), NUM_ANCHORS)):
            found = spread(links, {k: place(k, rank)}, unsure, FIRM)
            placed |= found.keys() if len(found) > 1 else set()
    return placed
