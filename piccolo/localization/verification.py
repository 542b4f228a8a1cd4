"""Verify poses by view synthesis: draw the scan at a pose, and match the photo with that picture.

A narrow photo looks like many places. Only at the right one do its local features lie where those of the
drawn scan lie. After Torii et al., "24/7 Place Recognition by View Synthesis" (CVPR 2015), and InLoc's
verification of poses (Taira et al., CVPR 2018).
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array, Pose, exp_so3, log_so3, rotate_points
from ..geometry.sphere import compute_indices
from ..local_features.hypotheses import count_matches, descend_matches
from ..local_features.keypoints import Keypoints, find_keypoints, join_keypoints
from ..local_features.view_image import render_gray
from .query import Query

PLACE = 0.1  # [m] the scan is drawn at positions on a grid of this spacing
TURN = 0.05  # [rad] and at rotation vectors on one of this
AROUND = 12  # [px] around the photo that are drawn too: it moves when the pose is refined
DISTINCT_RATIO = 0.8  # of the best distance to the second best elsewhere, at most (Lowe, 2004)
COS_ELSEWHERE = math.cos(math.radians(2.0))
REFINED_WITHIN = (4.0, 1.5, 0.8)  # [deg] matches that the pose is refined with, round by round
AGREE = math.radians(0.5)  # matches with a smaller error agree
SCALE = math.radians(0.3)  # of the loss
NEAR = 0.3  # [m] matches with which a pose moves farther are another pose's
NEAR_TURN = math.radians(5.0)
LEAST_PAIRS = 4  # with which a pose is refined
REFINEMENTS = 8  # steps
TOLERANCE = 1e-7  # [rad + m] a shorter step ends the descent


class Pairs(NamedTuple):
    """Features of the photo, and the points of the scan drawn at a pose that look like them."""

    rays: Array  # (M, 3) in the camera's frame
    points: Array  # (M, 3) [m] in the map


class Verified(NamedTuple):
    """A pose refined on the matches with the scan drawn near it, and the number that agree with it."""

    pose: Pose
    num_matches: int


def count_agreeing(query: Query, pose: Pose) -> int:
    """Count the photo's local features that agree with a pose.

    Features of a photo of a part of the sphere are matched with the scan drawn at the pose, those of others
    with the map's features.
    """
    if not (query.photo.is_partial and query.num_halves):
        return count_matches(query.matches, pose)
    verified = verify(query, pose)
    return verified.num_matches if is_near(verified.pose, pose) else 0


def verify(query: Query, pose: Pose) -> Verified:
    """Refine a pose on the matches with the scan drawn near it, and count those that agree."""
    pairs = pairs_near(query, pose)
    R = pose.R_cam_from_world.copy()
    t = pose.center_world.copy()
    for limit in REFINED_WITHIN:
        fits = compute_errors(pairs, R, t) < math.radians(limit)
        if fits.sum() >= LEAST_PAIRS:
            descend_matches((pairs.rays[fits], pairs.points[fits], SCALE), REFINEMENTS, TOLERANCE, R, t)
    agreeing = pairs.rays[compute_errors(pairs, R, t) < AGREE]
    return Verified(Pose(R, t), len(np.unique(agreeing, axis=0)))


def is_near(pose: Pose, other: Pose) -> bool:
    """Return True if two poses are so near each other that they are one place."""
    turn = np.linalg.norm(log_so3(pose.R_cam_from_world @ other.R_cam_from_world.T))
    return bool(turn < NEAR_TURN and math.dist(pose.center_world, other.center_world) < NEAR)


def compute_errors(pairs: Pairs, R_cam_from_map: Array, center_map: Array) -> Array:
    """Return the angles (M,) [rad] between the rays and the points seen from a pose."""
    rays = rotate_points(pairs.points - center_map, R_cam_from_map)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    return np.asarray(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(rays - pairs.rays, axis=1), 0.0, 1.0)))


def pairs_near(query: Query, pose: Pose) -> Pairs:
    """Return the matches with the scan drawn near a pose, on a grid of poses; cached by the grid."""
    place = np.rint(pose.center_world / PLACE)
    turn = np.rint(log_so3(pose.R_cam_from_world) / TURN)
    key = np.concatenate([place, turn]).astype(np.int64).tobytes()
    if key not in query.cache.pairs:
        query.cache.pairs[key] = match_drawn(query, Pose(exp_so3(turn * TURN), place * PLACE))
    pairs: Pairs = query.cache.pairs[key]
    return pairs


def match_drawn(query: Query, pose: Pose) -> Pairs:
    """Draw the scan at a pose in the map, and match the photo's features with those of the picture."""
    is_valid = query.photo.panorama.is_valid
    is_drawn = cv2.dilate(is_valid.view(np.uint8), np.ones((2 * AROUND + 1,) * 2, np.uint8)) > 0
    image = render_gray(query.scan_map.octree, pose, is_drawn)
    drawn = find_keypoints(image.gray, image.is_filled & is_drawn)
    ranges = image.ranges[compute_indices(drawn.rays, is_valid.shape[1])]
    is_seen = np.flatnonzero(ranges > 0.0)
    drawn = drawn.take(is_seen)
    own = join_keypoints([half().keypoints for half in query.features])
    mine, theirs = match_pictures(own, drawn)
    offsets = drawn.rays[theirs].astype(np.float64) * ranges[is_seen][theirs, None]
    points = pose.center_world + rotate_points(offsets, pose.R_cam_from_world.T)
    return Pairs(own.rays[mine].astype(np.float64), points)


def match_pictures(own: Keypoints, drawn: Keypoints) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Match each feature with the most similar one, unless another elsewhere is nearly as similar.

    Squared distances of 8-bit descriptors are whole numbers, exact in float32.
    """
    if not len(own.rays) or not len(drawn.rays):
        nothing = np.empty(0, np.intp)
        return nothing, nothing
    a = own.descriptors.astype(np.float32)
    b = drawn.descriptors.astype(np.float32)
    distances = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2.0 * (a @ b.T)
    nearest = distances.argmin(axis=1)
    best = distances[np.arange(len(a)), nearest]
    is_same = drawn.rays[nearest] @ drawn.rays.T > COS_ELSEWHERE
    distances[is_same] = np.inf
    is_distinct = best < DISTINCT_RATIO**2 * distances.min(axis=1)
    return np.flatnonzero(is_distinct), nearest[is_distinct]
