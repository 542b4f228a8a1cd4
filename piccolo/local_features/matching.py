"""Matches: a photo's features and the map's features with similar descriptors."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Pose, rotate_points
from ..system.arrays import Array32, Int32s, Mask
from ..system.kernels.jit import kernel
from .keypoints import Keypoints

# largest ratio of the descriptors' distance of a distinct match to the least distance to a feature elsewhere
# (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", 2004)
DISTINCT_RATIO = 0.8
COS_ELSEWHERE = np.float32(math.cos(math.radians(2.0)))  # features of a picture farther apart are elsewhere


class Located(NamedTuple):
    """Keypoints of a picture whose pose in the map is known, and the ranges of the points that they show."""

    keypoints: Keypoints
    ranges: Array32  # (N,) [m]
    pose: Pose


class Matches(NamedTuple):
    """Pairs of a feature of the photo and one of the map, in the order of the photo's features."""

    query: Int32s  # (M,) index of the photo's feature
    rays: Array32  # (M, 3) unit, in the camera's frame
    ray_tangents: Array32  # (M, 3) unit, in the camera's frame
    angles: Array32  # (M,) diameter of the photo's keypoint [rad]
    points: Array32  # (M, 3) [m] in the map's frame
    directions: Array32  # (M, 3) unit, in the map's frame, from the camera of the map's picture to the point
    tangents: Array32  # (M, 3) unit, in the map's frame
    sizes: Array32  # (M,) diameter of the map's keypoint at the point [m]

    def take(self, kept: NDArray[np.integer] | Mask) -> "Matches":
        """Return the matches at indices, or where a mask (M,) is True."""
        taken: list[Any] = [values[kept] for values in self]
        return Matches(*taken)


_ROWS = np.empty((0, 3), np.float32)
_NUMBERS = np.empty(0, np.float32)
NO_MATCHES = Matches(np.empty(0, np.int32), _ROWS, _ROWS, _NUMBERS, _ROWS, _ROWS, _ROWS, _NUMBERS)


def is_distinct(squares: NDArray[np.number], elsewhere: NDArray[np.number], ratio: float) -> Mask:
    """Return a mask (N,) of the matches that are distinct, by Lowe's test of the ratio of two distances.

    `squares` (N,) are the squared distances of the matches, `elsewhere` (N,) the least squared distances to
    features elsewhere in the picture.
    """
    return np.asarray(squares < ratio**2 * elsewhere)


def match_pictures(own: Keypoints, others: Keypoints) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Match each feature with the most similar of the others, unless one elsewhere is nearly as similar.

    Return the indices (M,) of the features that have a match, and of their matches. Squared distances of
    8-bit descriptors are whole numbers, exact in float32 by any matrix product.
    """
    if not len(own.rays) or not len(others.rays):
        nothing = np.empty(0, np.intp)
        return nothing, nothing
    a = own.descriptors.astype(np.float32)
    b = others.descriptors.astype(np.float32)
    distances = a @ (np.float32(-2.0) * b).T
    distances += (b * b).sum(axis=1)
    nearest = distances.argmin(axis=1)
    best = distances[np.arange(len(a)), nearest]
    elsewhere = np.empty(len(a), np.float32)
    find_elsewhere(distances, np.ascontiguousarray(others.rays.T), nearest, elsewhere)
    own_squares = (a * a).sum(axis=1)
    is_matched = is_distinct(best + own_squares, elsewhere + own_squares, DISTINCT_RATIO)
    return np.flatnonzero(is_matched), nearest[is_matched]


def match_located(own: Keypoints, picture: Located) -> Matches:
    """Match keypoints of a photo with those of a picture whose pose in the map is known."""
    mine, theirs = match_pictures(own, picture.keypoints)
    return pair(own, mine, picture, theirs)


def pair(own: Keypoints, mine: NDArray[np.intp], picture: Located, theirs: NDArray[np.intp]) -> Matches:
    """Return the matches of a photo's keypoints at indices (M,) with a picture's at indices (M,)."""
    others, ranges, pose = picture
    R_map_from_cam = pose.R_cam_from_world.T
    directions = rotate_points(others.rays[theirs].astype(np.float64), R_map_from_cam)
    tangents = rotate_points(others.tangents[theirs].astype(np.float64), R_map_from_cam)
    return Matches(
        mine.astype(np.int32),
        own.rays[mine],
        own.tangents[mine],
        own.sizes[mine],
        (pose.center_world + directions * ranges[theirs, None]).astype(np.float32),
        directions.astype(np.float32),
        tangents.astype(np.float32),
        others.sizes[theirs] * ranges[theirs],
    )


@kernel
def find_elsewhere(distances: Array32, rays: Array32, nearest: NDArray[np.intp], elsewhere: Array32) -> None:
    """Write the least distance (N,) of each row (N, M), without columns whose rays are near the nearest's.

    `rays` (3, M) are unit directions, `nearest` (N,) the column with the least distance of each row.
    """
    x, y, z = rays
    for i in range(len(nearest)):
        k = nearest[i]
        row = distances[i]
        least = np.float32(np.inf)
        for j in range(len(row)):
            is_apart = x[k] * x[j] + y[k] * y[j] + z[k] * z[j] <= COS_ELSEWHERE
            least = min(least, row[j] if is_apart else np.float32(np.inf))
        elsewhere[i] = least


def join_matches(parts: Sequence[Matches], counts: Sequence[int]) -> Matches:
    """Join matches of a photo's parts, which have `counts` features; these are numbered part after part."""
    first = np.repeat(np.cumsum([0, *counts])[:-1], [len(part.query) for part in parts])
    query, *others = (np.concatenate(values) for values in zip(NO_MATCHES, *parts, strict=True))
    return Matches(query + first.astype(np.int32), *others)


def merge_matches(parts: Sequence[Matches]) -> Matches:
    """Merge matches of the same photo with several pictures, in the order of the photo's features."""
    merged: list[Any] = [np.concatenate(values) for values in zip(*parts, strict=True)]
    return Matches(*merged).take(np.argsort(merged[0], kind="stable"))
