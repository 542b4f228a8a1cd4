"""Matches with the map's features, and of two pictures: lists against all, and places that count once."""

import dataclasses
import math

import naive
import numpy as np
import pytest
import rooms
from scipy.spatial import cKDTree

from piccolo.geometry.sphere import pixel_rays
from piccolo.jobs.threads import Workers
from piccolo.local_features import feature_map, matching
from piccolo.local_features.keypoints import Keypoints
from piccolo.local_features.matching import (
    DISTINCT_IN_MAP,
    FARTHEST_DISTANCE,
    NUM_MATCHED_FEATURES,
    is_distinct,
    match,
    nearest_lists,
    search_lists,
)
from piccolo.localization.attempts import join_features

TIER = "scene"


def _descriptors(rng, count):
    return rng.integers(-127, 128, (count, feature_map.NUM_COMPONENTS)).astype(np.int8)


def _centers():
    """Two places in a room, with what is seen from them."""
    centers = rooms.scan_map(1).centers
    return centers[[len(centers) // 3, 2 * len(centers) // 3]]


def test_lists_equal_a_search_of_all_where_all_are_looked_through():
    rng = np.random.default_rng(6)
    places = rng.integers(40, size=300)  # 40 places a metre apart, each seen about 7 times
    points = np.stack([places, 0 * places, 0 * places], axis=1) + rng.uniform(-0.08, 0.08, (300, 3))
    in_map, descriptors = _descriptors(rng, 300), _descriptors(rng, 25)
    in_map[::3] = np.clip(
        descriptors[rng.integers(25, size=100)].astype(int)
        + rng.integers(-9, 10, (100, feature_map.NUM_COMPONENTS)),
        -127,
        127,
    )
    start = np.array([0, 100, 100, 180, 300], np.int32)
    probes = np.stack([rng.permutation(4) for _ in range(25)]).astype(np.int32)
    found, distances = np.empty((25, 5), np.int32), np.empty((25, 5), np.int32)
    search_lists(descriptors, probes, in_map, start, points.astype(np.float32), found, distances)
    expected, nearest = naive.nearest_places(descriptors, in_map, places, 5)
    np.testing.assert_array_equal(distances, expected)
    np.testing.assert_array_equal(places[found], nearest)
    squares = ((in_map[found].astype(int) - descriptors[:, None].astype(int)) ** 2).sum(axis=2)
    np.testing.assert_array_equal(distances, squares)
    search_lists(descriptors, probes[:, :1], in_map, start, points.astype(np.float32), found, distances)
    of_list = probes[:, :1] == 1  # that is empty
    assert (found[of_list[:, 0]] == -1).all()
    assert (distances[of_list[:, 0]] == FARTHEST_DISTANCE).all()
    lists = np.searchsorted(start, found, side="right") - 1
    assert ((lists == probes[:, :1]) | (found < 0)).all()


def test_a_ratio_is_one_of_distances_though_squares_are_given():
    squares = np.array([63.9, 64.0, 79.9, 80.1, 81.0]) ** 2
    elsewhere = np.full(5, 100.0**2)
    assert is_distinct(squares, elsewhere, 0.8).tolist() == [True, True, True, False, False]
    counts = np.array([3, 4, 39_999, 40_000])  # of whole numbers, a fifth less is not enough
    others = np.array([5, 5, 50_000, 50_000])
    assert is_distinct(counts, others, DISTINCT_IN_MAP).tolist() == [True, False, True, False]


def test_nearest_lists_and_middles_by_brute_force():
    rng = np.random.default_rng(7)
    descriptors, middles = _descriptors(rng, 90), _descriptors(rng, 30)
    squares = ((descriptors[:, None].astype(int) - middles[None].astype(int)) ** 2).sum(axis=2)
    probes = np.empty((90, 6), np.int32)
    nearest_lists(descriptors, middles, probes)
    np.testing.assert_array_equal(probes, np.argsort(squares, axis=1, kind="stable")[:, :6])
    nearest = feature_map.find_nearest(descriptors, middles)
    np.testing.assert_array_equal(nearest, squares.argmin(axis=1))


def test_components_keep_distances_and_middles_are_of_clusters(monkeypatch):
    rng = np.random.default_rng(8)
    axes = rng.normal(size=(10, 128))
    values = np.clip(np.rint(120 + 4 * rng.normal(size=(500, 10)) @ axes), 0, 255).astype(np.uint8)
    mean, components = feature_map.principal_components(values)
    np.testing.assert_allclose(mean, values.mean(axis=0), atol=0.5)
    gram = components[:, :8].T.astype(float) @ components[:, :8] / 127**2
    np.testing.assert_allclose(gram, np.eye(8), atol=0.03)
    projected = feature_map.project(values, mean, components).astype(float)
    monkeypatch.setattr(feature_map, "DESCRIPTORS_AT_ONCE", 7)
    np.testing.assert_array_equal(feature_map.project(values, mean, components), projected)
    gaps = np.linalg.norm(values[:-1].astype(float) - values[1:], axis=1)
    is_unclipped = np.abs(projected).max(axis=1) < 127
    both = is_unclipped[:-1] & is_unclipped[1:]
    assert both.sum() > 200
    found = np.linalg.norm(projected[:-1] - projected[1:], axis=1)
    np.testing.assert_allclose(found[both], gaps[both], rtol=0.05)
    clusters = np.repeat(_descriptors(rng, 3) // 2, 50, axis=0)
    noisy = (clusters + rng.integers(-2, 3, clusters.shape)).astype(np.int8)
    middles = feature_map.list_middles(noisy, 3)
    distance = np.abs(middles[:, None].astype(int) - clusters[::50].astype(int)).max(axis=2)
    assert (np.sort(distance.min(axis=1)) <= 2).all()


def test_the_maps_features_lie_on_its_surfaces_and_in_one_list_each():
    found, octree = rooms.scan_map(1).local_features, rooms.scan_map(1).octree
    leaves = octree.level(octree.leaf_size)[:, :3]
    distance = cKDTree(leaves).query(found.points)[0]
    assert len(found.points) > 1000
    assert np.median(distance) < 0.02
    assert (distance < 0.06).mean() > 0.95
    start = found.list_start
    assert start[0] == 0
    assert start[-1] == len(found.points) == len(found.descriptors)
    assert (np.diff(start) >= 0).all()
    assert abs(len(found.middles) * feature_map.LIST_SIZE - len(found.points)) < feature_map.LIST_SIZE
    nearest = feature_map.find_nearest(found.descriptors, found.middles)
    np.testing.assert_array_equal(nearest, np.repeat(np.arange(len(found.middles)), np.diff(start)))
    for directions in (found.directions, found.tangents):
        np.testing.assert_allclose(np.linalg.norm(directions / 127.0, axis=1), 1.0, atol=0.01)
    across = np.sum(found.directions.astype(float) * found.tangents, axis=1) / 127**2
    assert np.abs(across).max() < 0.02


def test_same_bits_for_any_number_of_threads_and_none_where_nothing_is():
    octree = rooms.scan_map(1).octree
    one, two = (feature_map.make_feature_map(octree, _centers(), Workers(k)) for k in (1, 2))
    for own, other in zip(one, two, strict=True):
        assert own.dtype == other.dtype
        np.testing.assert_array_equal(own, other)
    assert len(one.points) > 300
    nothing = feature_map.make_feature_map(octree, np.empty((0, 3)), Workers())
    assert [len(values) for values in nothing] == [0, 0, 0, 0, 0, 0, 0, 128, 128, 1, 2]
    gray = octree._replace(nodes=np.where(np.arange(6) < 3, octree.nodes, np.float32(128 / 255)))
    flat = feature_map.make_feature_map(gray, _centers(), Workers())
    assert len(flat.points) < 5  # at the edges of what was scanned
    found = rooms.scan_map(1).local_features
    some = Keypoints(
        *(np.ones((5, n), t) for n, t in ((3, "f4"), (3, "f4"))), np.ones(5, "f4"), np.ones((5, 128), "u1")
    )
    assert len(match(some, nothing, Workers()).query) == 0
    assert len(match(some.take(np.arange(0)), found, Workers()).query) == 0


@pytest.fixture(scope="module")
def matches():
    return join_features(rooms.ask(rooms.scene(1)[1], rooms.scan_map(1)), rooms.WORKERS)[1]


def test_matches_of_halves_are_those_of_the_whole_numbered_on():
    problem = rooms.ask(rooms.scene(1)[1], rooms.scan_map(1))
    halves = [half(rooms.WORKERS) for half in problem.features]
    keypoints, joined = join_features(problem, rooms.WORKERS)
    assert len(joined.query) == sum(len(half.matches.query) for half in halves)
    np.testing.assert_array_equal(keypoints.rays[joined.query], joined.rays)
    own = match(keypoints, rooms.scan_map(1).local_features, Workers(1))
    for values, others in zip(joined, own, strict=True):
        assert values.dtype == others.dtype
        np.testing.assert_array_equal(values, others)
    half = dataclasses.replace(problem, features=problem.features[:1])
    assert join_features(half, rooms.WORKERS)[1].query.tolist() == halves[0].matches.query.tolist()
    keypoints, none = join_features(problem.by_views(), rooms.WORKERS)
    assert len(none.query) == len(keypoints.rays) == 0


def test_matches_come_in_the_photos_order_the_distinct_ones_weigh_most(matches):
    assert (np.diff(matches.query) >= 0).all()
    counts = np.bincount(matches.query)
    assert counts.max() == NUM_MATCHED_FEATURES
    is_distinct = matches.weights == 1.0
    assert set(np.unique(matches.weights)) == {0.5, 1.0}
    assert (np.bincount(matches.query[is_distinct]) <= 1).all()
    true_pose = rooms.scene(1)[2]
    rays = (matches.points - true_pose.center_world) @ true_pose.R_cam_from_world.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    is_right = np.sum(rays * matches.rays, axis=1) > np.cos(np.radians(2.0))
    assert is_right[is_distinct].mean() > 3 * is_right[~is_distinct].mean()
    assert is_right.sum() > 30
    tangents = matches.tangents @ true_pose.R_cam_from_world.T
    assert np.median(np.sum(tangents * matches.ray_tangents, axis=1)[is_right]) > 0.9
    ranges = np.linalg.norm(matches.points - true_pose.center_world, axis=1)
    assert abs(np.log(np.median((matches.sizes / (matches.angles * ranges))[is_right]))) < 0.2


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
