"""A second look at a photo that is not sure, beside others that are.

Photos taken near each other show the same things in the same light, more alike than the scan drawn there. The
keypoints of the sure ones get their ranges from the scan, and their matches with the photo's give its pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from ..confidence.localization import Localization
from ..geometry.pose import Pose
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..local_features.hypotheses import propose_poses
from ..local_features.matching import Matches
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .attempts import CHANCE_MATCHES, add_verified
from .comparison import score_pose
from .localize import finish
from .prior import apply_prior
from .query import Query, prepare_query
from .settings import CoarseToFineSettings
from .verdict import judge
from .verification import Located, locate_keypoints, match_beside

MOST_BESIDE = 3  # photos that a photo is compared with, those with the most matches


class Beside(NamedTuple):
    """A photo that shows what another shows."""

    name: str
    matches: Matches
    pose: Pose  # of the other, by the matches
    num_matches: int  # that agree with it


@one_blas_thread
def locate(
    scan_map: ScanMap, panorama: Panorama, pose: Pose, settings: CoarseToFineSettings, workers: Workers
) -> Located:
    """Return the keypoints of a photo whose pose in the map is known."""
    return locate_keypoints(prepare_query(panorama, scan_map, settings, workers), pose)


@one_blas_thread
def localize_beside(
    scan_map: ScanMap,
    panorama: Panorama,
    known: Sequence[Pose],
    pictures: Mapping[str, Located],
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
) -> tuple[Localization, tuple[str, ...]]:
    """Localize a photo of a part of the sphere by others that are sure, given by their names.

    `known` are poses in the map that were found for it alone. Returns the result and the names of those that
    show the same; without any the result is empty.
    """
    allowed_map = apply_prior(scan_map, settings.prior)
    with watch.stage("match"):
        query = prepare_query(panorama, allowed_map, settings, workers)
        is_asked = query.photo.is_partial and query.num_parts > 0 and len(allowed_map.sparse) > 0
        found = find_beside(query, pictures) if is_asked else []
    if not found:
        return Localization(), ()
    with watch.stage("refine"):
        query = replace(query, beside=tuple(other.matches for other in found))
        poses = [*known, *(other.pose for other in found)]
        hypotheses = add_verified(query, [score_pose(query, pose) for pose in poses])
        return judge(*finish(query, hypotheses)), tuple(other.name for other in found)


def find_beside(query: Query, pictures: Mapping[str, Located]) -> list[Beside]:
    """Find the photos that show what a photo shows, those with the most matches first."""
    compared = query.workers.map(partial(match_picture, query), list(pictures.items()), "match")
    found = sorted((other for other in compared if other), key=lambda other: -other.num_matches)
    return found[:MOST_BESIDE]


def match_picture(query: Query, picture: tuple[str, Located]) -> Beside | None:
    """Match a photo with another, given by its name; None if no more agree than by chance."""
    name, located = picture
    matches = match_beside(query, located)
    if len(matches.query) <= CHANCE_MATCHES:
        return None
    found = propose_poses(matches, None, 1, query.workers)
    if not found or found[0].num_matches <= CHANCE_MATCHES:
        return None
    return Beside(name, matches, *found[0])
