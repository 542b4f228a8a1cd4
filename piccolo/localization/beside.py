"""A second look at a photo that is not sure, beside others that are.

Photos taken near each other show the same things in the same light, more alike than the scan drawn there. The
keypoints of the sure ones get their ranges from the scan, and their matches with the photo's give its pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..confidence.confidence import classify, posterior
from ..confidence.covariance import PoseCovariance, least_constrained_direction
from ..confidence.localization import Localization
from ..geometry.pose import Array, Pose, skew
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..local_features.hypotheses import find_inliers, propose_poses
from ..local_features.matching import Matches
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .attempts import add_verified
from .bundle import differentiate, turn_positions, update
from .comparison import score_pose
from .localize import finish
from .prior import apply_prior
from .query import Query, prepare_query
from .selection import SURE_MATCHES
from .settings import CoarseToFineSettings
from .verdict import judge
from .verification import COS_AGREE, Located, is_near, match_beside, place_keypoints

HERE = Pose(np.eye(3), np.zeros(3))
MOST_BESIDE = 3  # photos that a photo is compared with, those with the most matches


class Picture(NamedTuple):
    """A photo that is sure."""

    located: Located
    confidence: float  # of its pose
    covariance: PoseCovariance | None  # of its pose, in the world


class Beside(NamedTuple):
    """A photo that shows what another shows."""

    name: str
    picture: Picture
    matches: Matches
    pose: Pose  # of the other, by the matches


@one_blas_thread
def locate(
    scan_map: ScanMap, panorama: Panorama, pose: Pose, settings: CoarseToFineSettings, workers: Workers
) -> Located:
    """Return the keypoints of a photo whose pose in the map is known."""
    return place_keypoints(prepare_query(panorama, scan_map, settings, workers), pose)


@one_blas_thread
def localize_beside(
    scan_map: ScanMap,
    panorama: Panorama,
    known: Sequence[Pose],
    pictures: Mapping[str, Picture],
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
) -> tuple[Localization, tuple[str, ...]]:
    """Localize a photo of a part of the sphere by others that are sure, given by their names.

    `known` are poses in the map that were found for it alone. Returns the result and the names of those that
    show the same; without any the result is empty. It is no surer than the surest of them.
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
        result = fuse(judge(*finish(query, hypotheses)), found[0], scan_map)
    certainty = max(other.picture.confidence for other in found)
    return weaken(result, certainty, settings.min_confidence), tuple(other.name for other in found)


def fuse(found: Localization, other: Beside, scan_map: ScanMap) -> Localization:
    """Return a result whose pose is the weighted mean of its own and of that by the photo beside.

    It stays as it is if the two are not of one place, or if its own is ruled out.
    """
    is_ruled_out = found.confidence == 0.0
    if found.pose is None or is_ruled_out or found.covariance is None or other.picture.covariance is None:
        return found
    own = scan_map.from_world(found.pose)
    if not is_near(own, other.pose):
        return found
    R_map_from_world = scan_map.R_map_from_world
    of_own = turn_positions(found.covariance.matrix, R_map_from_world)
    of_picture = turn_positions(other.picture.covariance.matrix, R_map_from_world)
    J = differentiate(HERE, other.pose) @ np.linalg.inv(differentiate(HERE, other.picture.located.pose))
    of_expected = J @ of_picture @ J.T + match_covariance(other.matches, other.pose)
    pose, covariance = update(other.pose, of_expected, own, of_own)
    in_world = turn_positions(covariance, R_map_from_world.T)
    words = least_constrained_direction(covariance[3:, 3:], in_world[3:, 3:])
    known = PoseCovariance(0.5 * (in_world + in_world.T), words)
    probabilities = posterior(found.standings, known)
    others = zip(found.alternatives, probabilities[1:-1], strict=True)
    return replace(
        found,
        confidence=float(probabilities[0]),
        probability_none=float(probabilities[-1]),
        pose=scan_map.to_world(pose),
        alternatives=tuple(replace(a, probability=float(p)) for a, p in others),
        covariance=known,
    )


def weaken(found: Localization, certainty: float, min_confidence: float) -> Localization:
    """Return a result whose evidence itself is right with a probability."""
    none = 1.0 - certainty * (1.0 - (1.0 if found.probability_none is None else found.probability_none))
    confidence = certainty * found.confidence
    others = tuple(replace(a, probability=certainty * (a.probability or 0.0)) for a in found.alternatives)
    probabilities = np.array([confidence, *(a.probability or 0.0 for a in others), none])
    status = classify(probabilities, min_confidence)
    return replace(found, status=status, confidence=confidence, probability_none=none, alternatives=others)


def match_covariance(matches: Matches, pose: Pose) -> Array:
    """Return the covariance (6, 6) of a pose by its matches: turns in the camera's axes, moves in the map's.

    A ray u to a point at distance r changes by w x u - (I - u u^T) R d / r.
    """
    agreeing = find_inliers(matches, pose, COS_AGREE)
    offsets = (matches.points[agreeing] - pose.center_world) @ pose.R_cam_from_world.T
    ranges = np.linalg.norm(offsets, axis=1)[:, None, None]
    rays = offsets / ranges[:, 0]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    turns = np.array([-skew(ray) for ray in rays])
    J = np.concatenate([turns, -across @ pose.R_cam_from_world / ranges], axis=2).reshape(-1, 6)
    squares = np.square(rays - matches.rays[agreeing]).sum(axis=1)
    return np.asarray(0.5 * squares.mean() * np.linalg.pinv(J.T @ J))


def find_beside(query: Query, pictures: Mapping[str, Picture]) -> list[Beside]:
    """Find the photos that show what a photo shows, those with the most matches first."""
    compared = query.workers.map(partial(match_picture, query), list(pictures.items()), "match")
    found = [pair for pair in compared if pair]
    ranked = sorted(found, key=lambda pair: -pair[1])
    return [other for other, _ in ranked[:MOST_BESIDE]]


def match_picture(query: Query, named: tuple[str, Picture]) -> tuple[Beside, int] | None:
    """Match a photo with another, given with its name; None if fewer agree than a sure pose has.

    Returns also the number of those that agree.
    """
    name, picture = named
    matches = match_beside(query, picture.located)
    found = propose_poses(matches, None, 1, query.workers) if len(matches.query) >= SURE_MATCHES else []
    if not found or found[0].num_matches < SURE_MATCHES:
        return None
    return Beside(name, picture, matches, found[0].pose), found[0].num_matches
