"""Verify poses by view synthesis: draw the scan at a pose, and match the photo with that picture.

A photo may look like many places. Only at the right one do its local features lie where those of the drawn
scan lie. After Torii et al., "24/7 Place Recognition by View Synthesis" (CVPR 2015), and InLoc's
verification of poses (Taira et al., CVPR 2018). In a walk, a photo is matched with neighbouring frames too.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from ..geometry.nearness import CONFIRMED
from ..geometry.pose import Pose, exp_so3, log_so3, multiply, rotate_points
from ..geometry.pose_gaussian import LOOSE, differentiate_rays
from ..geometry.sphere import compute_indices
from ..judge.candidate import Candidate, Drawn
from ..local_features.hypotheses import COS_EXACT, LEAST_MATCHES, count_inliers, exact_pose, find_inliers
from ..local_features.keypoints import Keypoints, find_in_view, join_keypoints
from ..local_features.matching import (
    NO_MATCHES,
    Located,
    Matches,
    match_located,
    match_pictures,
    merge_matches,
    pair,
)
from ..local_features.perspective_view import PerspectiveView, add_margin
from ..problem.method import Method
from ..problem.problem import Problem
from ..system.arrays import Array, Array32, Bytes
from ..system.jobs.threads import Workers
from ..views.view_image import ViewImage, render_gray
from .occlusion import EXPLAINED, occlusion_mask

PLACE = 0.1  # [m] the scan is drawn at positions on a grid of this spacing
TURN = 0.05  # [rad] and at rotation vectors on a grid of this spacing
DRAWN_AROUND = 12  # [px] drawn beyond the photo's edge, which moves when the pose is refined
LEAST_ERROR = 2e-3  # [rad] of a keypoint along an axis: a third of a pixel
# factor on the covariance by matches with the drawn scan, whose errors are not independent; measured on 76
# crops of three scenes
DRAWN_INFLATION = 4.0


class Verified(NamedTuple):
    """A pose refined on the matches near it, and the number that agree with it."""

    pose: Pose
    num_matches: int


def verify(problem: Problem, pose: Pose, drawn: Matches) -> Verified:
    """Find the pose near a pose with which most matches agree, and count these.

    It is fitted to all matches: with the scan drawn there, and with each of the photos beside. The count is
    the largest among these pictures, each counted by itself. A photo beside whose pose is wrong misleads this
    photo.
    """
    pictures = [drawn, *problem.beside]
    found = exact_pose(merge_matches(pictures), pose)
    if found is None:
        return Verified(pose, 0)
    cos_agree = problem.method.cos_agree
    return Verified(found.pose, max(count_inliers(matches, found.pose, cos_agree) for matches in pictures))


def place_by_matches(method: Method, pose: Pose, matches: Matches) -> tuple[Pose, Array] | None:
    """Return the pose near another with which most matches with the drawn scan agree, and its covariance.

    None if no more matches agree than by chance. The covariance (6, 6) is as of `PoseGaussian`. The farther
    away the surfaces, the less exact is a position by matches: where they are farther than in rooms, the pose
    may lie farther from the other in proportion.
    """
    found = exact_pose(matches, pose)
    if found is None or found.num_matches <= method.chance_matches:
        return None
    points = matches.points[find_inliers(matches, found.pose, COS_EXACT)]
    ranges = np.linalg.norm(points - found.pose.center_world, axis=1)
    if not CONFIRMED.at(float(np.median(ranges))).holds(found.pose, pose):
        return None
    return found.pose, DRAWN_INFLATION * match_covariance(matches, found.pose)


def match_covariance(matches: Matches, pose: Pose) -> Array:
    """Return the covariance (6, 6) of a pose by its matches, as of `PoseGaussian`."""
    agreeing = find_inliers(matches, pose, COS_EXACT)
    rays, J = differentiate_rays(matches.points[agreeing], pose)
    information = np.einsum("kai,kaj->ij", J, J)
    squares = np.square(rays - matches.rays[agreeing]).sum()
    variance = max(squares / max(2 * len(rays) - 6, 1), LEAST_ERROR**2)
    return np.asarray(variance * np.linalg.inv(information + LOOSE * np.eye(6)))


def draw_near(problem: Problem, pose: Pose, known: Drawn | None, workers: Workers) -> Drawn:
    """Match the photo's features with the scan drawn near a pose, on a grid of poses.

    `known` was drawn near another pose: it is returned if both poses have the same pose of the grid. For a
    photo without features nothing is drawn.
    """
    key, drawn_at = round_pose(pose)
    if known is not None and known.key == key:
        return known
    keypoints = problem.photo.features(workers).keypoints
    if len(keypoints.rays) == 0:
        return Drawn(key, Located(keypoints, keypoints.sizes, drawn_at), NO_MATCHES)
    picture = find_all_drawn(problem, drawn_at, workers)
    return Drawn(key, picture, match_located(keypoints, picture))


def match_again(problem: Problem, known: Drawn, workers: Workers) -> Drawn | None:
    """Match the photo's features with the scan that was drawn for the same photo with another calibration.

    None if it was not drawn, as the photo had no features then.
    """
    if len(known.picture.keypoints.rays) == 0:
        return None
    keypoints = problem.photo.features(workers).keypoints
    return known._replace(matches=match_located(keypoints, known.picture))


def round_pose(pose: Pose) -> tuple[bytes, Pose]:
    """Return the nearest pose of the grid on which the scan is drawn, and its key."""
    place = np.rint(pose.center_world / PLACE)
    turn = np.rint(log_so3(pose.R_cam_from_world) / TURN)
    key = np.concatenate([place, turn]).astype(np.int64).tobytes()
    return key, Pose(exp_so3(turn * TURN), place * PLACE)


def find_all_drawn(problem: Problem, pose: Pose, workers: Workers) -> Located:
    """Draw the scan as the photo would show it at a pose in the map; return the keypoints of the drawing."""
    parts = workers.map(partial(find_drawn, problem, pose), problem.photo.features(workers).views, "draw")
    ranges = np.concatenate([ranges for _, ranges in parts])
    return Located(join_keypoints([keypoints for keypoints, _ in parts]), ranges, pose)


def find_copies(
    problem: Problem, one: Candidate, others: Sequence[Candidate], workers: Workers
) -> list[bool]:
    """Return True for each of the other candidates at which the scan looks as it does at one of them.

    Rooms of one kind look so. The scan drawn near the one pose is matched with the scan drawn near the other.
    """
    if not others:
        return []
    drawn = draw_near(problem, one.pose, one.drawn, workers).picture
    drawn_from_one = drawn.pose @ one.pose.inverse()

    def is_copy(other: Candidate) -> bool:
        picture = draw_near(problem, other.pose, other.drawn, workers).picture
        expected = drawn_from_one @ other.pose
        found = exact_pose(match_located(drawn.keypoints, picture), expected)
        return found is not None and CONFIRMED.holds(found.pose, expected)

    return workers.map(is_copy, others, "compare places")


def find_ranges(problem: Problem, pose: Pose, workers: Workers) -> Array32:
    """Return the ranges (N,) [m] of a photo's keypoints, from the scan, if it was taken at a pose in the map.

    Keypoints on things that the scan does not show, as people and moved furniture, have the range 0.
    """
    views, keypoints = problem.photo.features(workers)
    panorama = problem.photo.panorama
    mask = occlusion_mask(problem.surroundings_at(pose)[0], panorama, pose)
    ranges = np.zeros(len(keypoints.rays), np.float32)
    for view in views:
        shown = view.find_own(keypoints.rays)
        ranges[shown] = draw(problem, pose, view)[0].ranges[view.project(keypoints.rays[shown])]
    is_explained = mask[compute_indices(keypoints.rays, mask.shape[1])] == EXPLAINED
    return np.where(is_explained, ranges, np.float32(0.0))


def place_keypoints(problem: Problem, pose: Pose, workers: Workers) -> Located:
    """Return the keypoints of a photo that was taken at a pose in the map, if the scan gives them a range."""
    ranges = find_ranges(problem, pose, workers)
    is_seen = np.flatnonzero(ranges > 0.0)
    return Located(problem.photo.features(workers).keypoints.take(is_seen), ranges[is_seen], pose)


def match_beside(problem: Problem, other: Located, workers: Workers) -> Matches:
    """Match a photo's features with those of another photo.

    Keypoints that both have in the same direction are left out: they may be carried along, as dirt on a lens
    is. No matches are returned if the mirrored photo has more.
    """
    own = problem.photo.features(workers).keypoints
    mine, theirs = match_pictures(own, other.keypoints)
    if len(mine) < LEAST_MATCHES or len(match_pictures(own.mirror(), other.keypoints)[0]) > len(mine):
        return NO_MATCHES
    matches = pair(own, mine, other, theirs)
    rays_of_other = rotate_points(matches.directions.astype(np.float64), other.pose.R_cam_from_world)
    return matches.take(np.sum(rays_of_other * matches.rays, axis=1) < problem.method.cos_agree)


def draw(problem: Problem, pose: Pose, view: PerspectiveView) -> tuple[ViewImage, Bytes]:
    """Draw the scan as a view of a photo would show it at a pose, a little larger; return also its mask."""
    mask = view.cut_mask(add_margin(problem.photo.panorama.is_valid))
    shown = cv2.dilate(mask, np.ones((2 * DRAWN_AROUND + 1,) * 2, np.uint8))
    turned = Pose(multiply(view.R_sphere_from_view.T, pose.R_cam_from_world), pose.center_world)
    return render_gray(problem.scan_map.octree, turned, shown > 0, view.focal), np.asarray(shown, np.uint8)


def find_drawn(problem: Problem, pose: Pose, view: PerspectiveView) -> tuple[Keypoints, Array32]:
    """Draw the scan as a view would show it at a pose; return its keypoints, and their ranges (N,) [m]."""
    image, shown = draw(problem, pose, view)
    found = find_in_view(image.gray, np.where(image.is_filled, shown, np.uint8(0)), view)
    ranges = image.ranges[view.project(found.rays)]
    is_seen = np.flatnonzero(ranges > 0.0)
    return found.take(is_seen), ranges[is_seen]
