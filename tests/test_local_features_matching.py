"""Matches with the map's features, and of two pictures: each with the most similar one."""

import math

import numpy as np
import pytest

from piccolo.geometry.sphere import pixel_rays
from piccolo.local_features import matching
from piccolo.local_features.keypoints import Keypoints
from piccolo.local_features.matching import is_distinct

TIER = "scene"


def test_a_ratio_is_one_of_distances_though_squares_are_given():
    squares = np.array([63.9, 64.0, 79.9, 80.1, 81.0]) ** 2
    elsewhere = np.full(5, 100.0**2)
    assert is_distinct(squares, elsewhere, 0.8).tolist() == [True, True, True, False, False]


def test_the_least_distance_elsewhere_is_that_of_a_plain_search():
    rng = np.random.default_rng(5)
    rays = rng.normal(size=(40, 3)).astype(np.float32) * [1.0, 0.03, 0.03] + [1.0, 0.0, 0.0]
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    distances = rng.integers(0, 1000, (30, 40)).astype(np.float32)
    nearest = distances.argmin(axis=1)
    found = np.empty(30, np.float32)
    matching.find_elsewhere(distances, np.ascontiguousarray(rays.T), nearest, found)
    cosines = rays[nearest].astype(np.float64) @ rays.astype(np.float64).T
    expected = np.where(cosines > math.cos(math.radians(2.0)), np.inf, distances).min(axis=1)
    np.testing.assert_array_equal(found, expected)
    assert (expected > distances.min(axis=1)).any()


def _keypoints(rays, descriptors):
    rays = np.asarray(rays, np.float32)
    return Keypoints(rays, np.zeros_like(rays), np.ones(len(rays), np.float32), descriptors)


def _match_one_by_one(own, drawn):
    """By the angle [rad] to the best match, which of the others are elsewhere."""
    found = []
    for k, descriptor in enumerate(own.descriptors.astype(float)):
        distances = np.linalg.norm(drawn.descriptors - descriptor, axis=1)
        best = int(np.argmin(distances))
        cosines = drawn.rays.astype(float) @ drawn.rays[best].astype(float)
        others = distances[np.arccos(np.clip(cosines, -1, 1)) > math.radians(2.0)]
        if distances[best] < 0.8 * others.min(initial=math.inf):
            found.append((k, best))
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_pictures_are_matched_as_their_twin(seed):
    """Half of the features are seen again; of these some look like another one next to them, or elsewhere."""
    rng = np.random.default_rng(seed)
    descriptors = rng.integers(0, 60, (120, 128)).astype(np.uint8)
    rays = pixel_rays(256).reshape(-1, 3)[rng.permutation(128 * 256)[:120]]
    rays[:20] = rays[20:40] + rng.normal(0.0, 0.005, (20, 3))  # within two degrees
    descriptors[:40] = np.concatenate([descriptors[20:40]] * 2)
    descriptors[40:60] = descriptors[60:80]  # elsewhere
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    noise = rng.integers(0, 12, (90, 128)).astype(np.uint8)
    unknown = rng.integers(0, 60, (60, 128)).astype(np.uint8)
    own = _keypoints(np.zeros((150, 3)), np.concatenate([descriptors[:90] + noise, unknown]))
    drawn = _keypoints(rays, descriptors)
    mine, theirs = matching.match_pictures(own, drawn)
    assert list(zip(mine, theirs, strict=True)) == _match_one_by_one(own, drawn)
    assert set(range(40)) | set(range(80, 90)) <= set(mine)
    assert not set(range(40, 80)) & set(mine)
    assert len(mine) < 100


def test_without_features_nothing_matches_and_a_lone_one_is_distinct():
    rng = np.random.default_rng(0)
    own = _keypoints(np.eye(3), rng.integers(0, 60, (3, 128)).astype(np.uint8))
    nothing = own.take(np.empty(0, np.int64))
    for a, b in ((own, nothing), (nothing, own), (nothing, nothing)):
        assert [len(found) for found in matching.match_pictures(a, b)] == [0, 0]
    mine, theirs = matching.match_pictures(own, own.take(np.array([1])))
    assert (mine.tolist(), theirs.tolist()) == ([0, 1, 2], [0, 0, 0])
