"""Features of a photo and the features of the map that look alike."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel
from ..runtime.threads import Workers
from .feature_map import FeatureMap, project
from .keypoints import Keypoints

NUM_NEIGHBORS = 4  # features of the map that a feature of the photo is matched to, at most
NUM_LISTS = 16  # that are looked through
APART = np.float32(0.3)  # [m] features of the map nearer to each other are one
BATCH = 64  # features a thread takes at a time
DISTINCT_RATIO = 0.8  # of squared distances, best by second best elsewhere (Lowe)
FAR = np.int32(2147483647)


class Matches(NamedTuple):
    """Pairs of a feature of the photo and one of the map, in the order of the photo's features."""

    query: NDArray[np.int32]  # (M,) index of the photo's feature
    rays: NDArray[np.float32]  # (M, 3) in the camera's frame
    ray_tangents: NDArray[np.float32]  # (M, 3)
    angles: NDArray[np.float32]  # (M,) diameter [rad]
    points: NDArray[np.float32]  # (M, 3) [m] in the map's frame
    directions: NDArray[np.float32]  # (M, 3) from which the map knows it, camera to point
    tangents: NDArray[np.float32]  # (M, 3)
    sizes: NDArray[np.float32]  # (M,) diameter [m]
    weights: NDArray[np.float32]  # (M,) how much it tells: 1 of a distinct one


@kernel
def search_lists(descriptors, probes, map_descriptors, list_start, points, found, distances):
    """Write the nearest features (N, K) of the map, no two of which are one place, and squared distances.

    `probes` (N, P) are the lists to look through; -1 and FAR where there is no other.
    """
    num_kept = found.shape[1]
    for i in range(len(descriptors)):
        for k in range(num_kept):
            found[i, k], distances[i, k] = -1, FAR
        for p in range(probes.shape[1]):
            for f in range(list_start[probes[i, p]], list_start[probes[i, p] + 1]):
                total = np.int32(0)
                for d in range(descriptors.shape[1]):
                    gap = np.int32(descriptors[i, d]) - np.int32(map_descriptors[f, d])
                    total += gap * gap
                if total >= distances[i, num_kept - 1]:
                    continue
                # the place that it takes: that of a worse one of the same point, or the last
                at, is_new = num_kept - 1, True
                for k in range(num_kept):
                    if found[i, k] < 0:
                        break
                    g = found[i, k]
                    dx, dy, dz = (
                        points[f, 0] - points[g, 0],
                        points[f, 1] - points[g, 1],
                        points[f, 2] - points[g, 2],
                    )
                    if dx * dx + dy * dy + dz * dz < APART * APART:
                        at, is_new = k, total < distances[i, k]
                        break
                if not is_new:
                    continue
                while at > 0 and distances[i, at - 1] > total:
                    found[i, at], distances[i, at] = found[i, at - 1], distances[i, at - 1]
                    at -= 1
                found[i, at], distances[i, at] = f, total


@kernel
def nearest_lists(descriptors, middles, probes):
    """Write the indices (N, P) of the nearest middles of each descriptor, nearest first."""
    num_probes = probes.shape[1]
    best = np.empty(num_probes, np.int32)
    for i in range(len(descriptors)):
        best[:] = FAR
        for m in range(len(middles)):
            total = np.int32(0)
            for d in range(descriptors.shape[1]):
                gap = np.int32(descriptors[i, d]) - np.int32(middles[m, d])
                total += gap * gap
            if total < best[num_probes - 1]:
                at = num_probes - 1
                while at > 0 and best[at - 1] > total:
                    best[at], probes[i, at] = best[at - 1], probes[i, at - 1]
                    at -= 1
                best[at], probes[i, at] = total, m


def match(keypoints: Keypoints, feature_map: FeatureMap, workers: Workers) -> Matches:
    """The matches of a photo's keypoints, the best few of each."""
    m = feature_map
    descriptors = project(keypoints.descriptors, m.mean, m.components)
    found = np.empty((len(descriptors), NUM_NEIGHBORS + 1), np.int32)
    distances = np.empty(found.shape, np.int32)
    probes = np.empty((len(descriptors), min(NUM_LISTS, len(m.middles))), np.int32)

    def run(lo: int) -> None:
        part = slice(lo, lo + BATCH)
        nearest_lists(descriptors[part], m.middles, probes[part])
        lists = m.descriptors, m.list_start, m.points
        search_lists(descriptors[part], probes[part], *lists, found[part], distances[part])

    list(workers.map(run, range(0, len(descriptors), BATCH), "match"))
    following = np.minimum(distances[:, 1:], FAR).astype(np.float64)
    query, rank = np.nonzero(found[:, :NUM_NEIGHBORS] >= 0)
    chosen = found[query, rank]
    is_distinct = (rank == 0) & (distances[query, 0] < DISTINCT_RATIO * following[query, 0])
    weights = np.where(is_distinct, 1.0, 0.5).astype(np.float32)
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
