"""Matches: a photo's features and the map's features with similar descriptors."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array32, Int8s, Int32s, Mask
from ..geometry.vectors import dot, minus, row
from ..jobs.threads import Workers
from ..kernels.jit import inline_kernel, kernel
from .feature_map import FeatureMap, project, square_gap
from .keypoints import Keypoints

NUM_MATCHED_FEATURES = 4  # features of the map that a feature of the photo is matched to, at most
NUM_LISTS = 16  # that are searched
APART = np.float32(0.3)  # [m] features of the map nearer to each other are one
FEATURES_A_TASK = 64  # features a thread takes at a time
# of the best distance to the best elsewhere, at most, of a distinct match (Lowe, "Distinctive Image Features
# from Scale-Invariant Keypoints", 2004)
DISTINCT_RATIO = 0.8
# Chosen, for the features of a map, of which more look alike than in one picture: with 0.8 here too, 34 of 48
# phone photos were localized in place of 36, and 42 right in place of 43.
DISTINCT_IN_MAP = math.sqrt(0.8)
COS_ELSEWHERE = np.float32(math.cos(math.radians(2.0)))  # of what another picture shows
LEAST_MATCH_WEIGHT = 0.5
FARTHEST_DISTANCE = np.int32(2147483647)


class Matches(NamedTuple):
    """Pairs of a feature of the photo and one of the map, in the order of the photo's features."""

    query: Int32s  # (M,) index of the photo's feature
    rays: Array32  # (M, 3) in the camera's frame
    ray_tangents: Array32  # (M, 3)
    angles: Array32  # (M,) diameter [rad]
    points: Array32  # (M, 3) [m] in the map's frame
    directions: Array32  # (M, 3) from which the map knows it, camera to point
    tangents: Array32  # (M, 3)
    sizes: Array32  # (M,) diameter [m]
    weights: Array32  # (M,) 1 of a distinct one, else LEAST_MATCH_WEIGHT

    def take(self, kept: NDArray[np.integer] | Mask) -> "Matches":
        """Return the matches at indices, or of a mask (M,)."""
        taken: list[Any] = [values[kept] for values in self]
        return Matches(*taken)


_ROWS = np.empty((0, 3), np.float32)
_NUMBERS = np.empty(0, np.float32)
NO_MATCHES = Matches(np.empty(0, np.int32), _ROWS, _ROWS, _NUMBERS, _ROWS, _ROWS, _ROWS, _NUMBERS, _NUMBERS)


@inline_kernel
def place_taken(points: Array32, f: int, total: np.int32, found: Int32s, distances: Int32s) -> int:
    """Return the index, among the features kept (K,), that feature `f` replaces; -1 if it replaces none.

    It competes with one within APART of it, and replaces that if it is nearer, `total` being its squared
    distance. If there is no such feature it replaces the last.
    """
    for k in range(len(found)):
        if found[k] < 0:
            break
        gap = minus(row(points, f), row(points, found[k]))
        if dot(gap, gap) < APART * APART:
            return k if total < distances[k] else -1
    return len(found) - 1


@inline_kernel
def put_in_order(at: int, value: int, total: np.int32, values: Int32s, totals: Int32s) -> None:
    """Replace the value at `at` by another, moved forward past all (K,) with a larger total."""
    while at > 0 and totals[at - 1] > total:
        values[at] = values[at - 1]
        totals[at] = totals[at - 1]
        at -= 1
    values[at] = value
    totals[at] = total


@kernel
def search_lists(
    descriptors: Int8s,
    probes: Int32s,
    map_descriptors: Int8s,
    list_start: Int32s,
    points: Array32,
    found: Int32s,
    distances: Int32s,
) -> None:
    """Write the nearest features (N, K) of the map, of one place only the nearest, and squared distances.

    `probes` (N, P) are the lists to search; -1 and FARTHEST_DISTANCE are written where there are fewer
    features. A nearer feature replaces only the first kept one that is close to it: of several in a row, two
    may stay.
    """
    found[:] = -1
    distances[:] = FARTHEST_DISTANCE
    for i in range(len(descriptors)):
        for p in range(probes.shape[1]):
            for f in range(list_start[probes[i, p]], list_start[probes[i, p] + 1]):
                total = square_gap(descriptors[i], map_descriptors[f])
                if total >= distances[i, -1]:
                    continue
                at = place_taken(points, f, total, found[i], distances[i])
                if at >= 0:
                    put_in_order(at, f, total, found[i], distances[i])


@kernel
def nearest_lists(descriptors: Int8s, middles: Int8s, probes: Int32s) -> None:
    """Write the indices (N, P) of the middles nearest to each descriptor, nearest first."""
    best = np.empty(probes.shape[1], np.int32)
    for i in range(len(descriptors)):
        best[:] = FARTHEST_DISTANCE
        for m in range(len(middles)):
            total = square_gap(descriptors[i], middles[m])
            if total < best[-1]:
                put_in_order(len(best) - 1, m, total, probes[i], best)


def is_distinct(squares: NDArray[np.number], elsewhere: NDArray[np.number], ratio: float) -> Mask:
    """Return which matches (N,) are distinct, by a ratio of distances (Lowe).

    Given are the squared distances of the best matches, and of the best elsewhere.
    """
    return np.asarray(squares < ratio**2 * elsewhere)


def match(keypoints: Keypoints, feature_map: FeatureMap, workers: Workers) -> Matches:
    """Match a photo's keypoints to the map's features, each to the best few."""
    m = feature_map
    descriptors = project(keypoints.descriptors, m.mean, m.components)
    found = np.empty((len(descriptors), NUM_MATCHED_FEATURES + 1), np.int32)
    distances = np.empty(found.shape, np.int32)
    probes = np.empty((len(descriptors), min(NUM_LISTS, len(m.middles))), np.int32)

    def run(lo: int) -> None:
        part = slice(lo, lo + FEATURES_A_TASK)
        own = descriptors[part]
        lists = probes[part]
        nearest_lists(own, m.middles, lists)
        search_lists(own, lists, m.descriptors, m.list_start, m.points, found[part], distances[part])

    list(workers.map(run, range(0, len(descriptors), FEATURES_A_TASK), "match"))
    query, rank = np.nonzero(found[:, :NUM_MATCHED_FEATURES] >= 0)
    chosen = found[query, rank]
    is_sure = (rank == 0) & is_distinct(distances[query, 0], distances[query, 1], DISTINCT_IN_MAP)
    weights = np.where(is_sure, 1.0, LEAST_MATCH_WEIGHT).astype(np.float32)
    return Matches(
        query.astype(np.int32),
        keypoints.rays[query],
        keypoints.tangents[query],
        keypoints.sizes[query],
        m.points[chosen],
        m.directions[chosen].astype(np.float32) / np.float32(127.0),
        m.tangents[chosen].astype(np.float32) / np.float32(127.0),
        m.sizes[chosen],
        weights,
    )


def match_pictures(own: Keypoints, others: Keypoints) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Match each feature with the most similar one, unless another elsewhere is nearly as similar.

    Squared distances of 8-bit descriptors are whole numbers, exact in float32 by any matrix product.
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


@kernel
def find_elsewhere(distances: Array32, rays: Array32, nearest: NDArray[np.intp], elsewhere: Array32) -> None:
    """Write the least distance (N,) of each row (N, M) but to those with rays (3, M) near the nearest's."""
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
    """Join the matches of a photo's parts; the features, `counts` of them, are numbered part after part."""
    first = np.repeat(np.cumsum([0, *counts])[:-1], [len(part.query) for part in parts])
    query, *others = (np.concatenate(values) for values in zip(NO_MATCHES, *parts, strict=True))
    return Matches(query + first.astype(np.int32), *others)


def merge_matches(parts: Sequence[Matches]) -> Matches:
    """Merge matches of the same features of a photo with different points."""
    merged: list[Any] = [np.concatenate(values) for values in zip(*parts, strict=True)]
    return Matches(*merged).take(np.argsort(merged[0], kind="stable"))
