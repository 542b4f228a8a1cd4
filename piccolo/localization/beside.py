"""A second look at a photo that is not sure, beside others that are.

Photos taken near each other show the same things in the same light, more alike than the scan drawn there. The
keypoints of the sure ones get their ranges from the scan, and their matches with the photo's give its pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..confidence.confidence import classify, probability_within
from ..confidence.covariance import PoseCovariance, least_constrained_direction
from ..confidence.localization import Localization
from ..geometry.pose import Array, Pose, skew
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..local_features.hypotheses import COS_EXACT, exact_pose, find_inliers, propose_poses
from ..local_features.matching import Matches
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .attempts import add_verified
from .bundle import LOOSE, ROBUST, differentiate, subtract, turn_positions, update
from .comparison import score_pose
from .localize import Found, finish
from .prior import apply_prior, contradictions
from .query import Query, prepare_query
from .selection import SURE_MATCHES
from .settings import CoarseToFineSettings
from .verdict import judge
from .verification import Located, is_near, match_beside, place_keypoints

HERE = Pose(np.eye(3), np.zeros(3))
LEAST_ERROR = 2e-3  # [rad] of a keypoint along an axis: a third of a pixel
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
        ended = finish(query, hypotheses)
        judged = judge(*ended)
        kept = list_agreeing(judged, found, ended.query.beside, scan_map)
        if not kept:
            return Localization(), ()
        result = fuse(judged, kept[0], ended, scan_map)
    certainty = max(other.picture.confidence for other in kept)
    return weaken(result, certainty, settings.min_confidence), tuple(other.name for other in kept)


def list_agreeing(
    judged: Localization, found: Sequence[Beside], matches: Sequence[Matches], scan_map: ScanMap
) -> list[Beside]:
    """List the photos whose matches (rays by the final camera) put a photo where it is by all evidence."""
    if judged.pose is None:
        return []
    own = scan_map.from_world(judged.pose)
    agreeing = []
    for other, turned in zip(found, matches, strict=True):
        exact = exact_pose(turned, own, None)
        if exact and exact.num_matches >= SURE_MATCHES and is_near(exact.pose, own):
            agreeing.append(other._replace(matches=turned, pose=exact.pose))
    return agreeing


def fuse(judged: Localization, other: Beside, ended: Found, scan_map: ScanMap) -> Localization:
    """Return a result whose pose is the weighted mean of its own and of that by the photo beside.

    If they contradict each other, their covariances grow by as much. An error of the focal length is common
    to both. How likely the place is does not change. A result that is ruled out stays as it is, and one whose
    mean would contradict the prior.
    """
    of_photo = other.picture.covariance
    if judged.pose is None or judged.covariance is None or of_photo is None or judged.confidence == 0.0:
        return judged
    common = np.zeros((6, 6)) if ended.fit is None else ended.fit.pose_covariance
    R_map_from_world = scan_map.R_map_from_world
    own = scan_map.from_world(judged.pose)
    of_own = turn_positions(judged.covariance.matrix, R_map_from_world) - common
    J = differentiate(HERE, other.pose) @ np.linalg.inv(differentiate(HERE, other.picture.located.pose))
    of_expected = J @ turn_positions(of_photo.matrix, R_map_from_world) @ J.T
    of_expected += match_covariance(other.matches, other.pose)
    step = subtract(own, other.pose)
    excess = max(float(step @ np.linalg.solve(of_own + of_expected, step)) - ROBUST, 0.0) + 1.0
    pose, covariance = update(other.pose, excess * of_expected, own, excess * of_own)
    if contradictions(scan_map, pose, ended.query.settings.prior):
        return judged
    covariance += common
    in_world = turn_positions(covariance, R_map_from_world.T)
    words = least_constrained_direction(covariance[3:, 3:], in_world[3:, 3:])
    known = PoseCovariance(0.5 * (in_world + in_world.T), words)
    gain = probability_within(known) / probability_within(judged.covariance)
    return scale(replace(judged, pose=scan_map.to_world(pose), covariance=known), gain)


def weaken(found: Localization, certainty: float, min_confidence: float) -> Localization:
    """Return a result whose evidence itself is right with a probability, and its status."""
    found = scale(found, certainty)
    others = [a.probability or 0.0 for a in found.alternatives]
    probabilities = np.array([found.confidence, *others, found.probability_none])
    return replace(found, status=classify(probabilities, min_confidence))


def scale(found: Localization, factor: float) -> Localization:
    """Return a result with the probabilities of all its poses multiplied."""
    confidence = factor * found.confidence
    others = tuple(replace(a, probability=factor * (a.probability or 0.0)) for a in found.alternatives)
    none = 1.0 - confidence - sum(a.probability or 0.0 for a in others)
    return replace(found, confidence=confidence, probability_none=none, alternatives=others)


def match_covariance(matches: Matches, pose: Pose) -> Array:
    """Return the covariance (6, 6) of a pose by its matches: turns in the camera's axes, moves in the map's.

    A ray u to a point at distance r changes by w x u - (I - u u^T) R d / r.
    """
    agreeing = find_inliers(matches, pose, COS_EXACT)
    offsets = (matches.points[agreeing] - pose.center_world) @ pose.R_cam_from_world.T
    ranges = np.linalg.norm(offsets, axis=1)
    rays = offsets / ranges[:, None]
    J = np.empty((len(rays), 3, 6))
    for k, (ray, distance) in enumerate(zip(rays, ranges, strict=True)):
        J[k, :, :3] = -skew(ray)
        J[k, :, 3:] = -(np.eye(3) - np.outer(ray, ray)) @ pose.R_cam_from_world / distance
    information = np.einsum("kai,kaj->ij", J, J)
    squares = np.square(rays - matches.rays[agreeing]).sum()
    variance = max(squares / max(2 * len(rays) - 6, 1), LEAST_ERROR**2)
    return np.asarray(variance * np.linalg.inv(information + LOOSE * np.eye(6)))


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
