"""Keypoints of a sphere: they turn with it, come once, and lie where the picture is valid."""

import functools

import cv2
import numpy as np
import rooms
from scipy.spatial import cKDTree

from piccolo.geometry.pose import yaw_rotation
from piccolo.geometry.sphere import pixel_rays
from piccolo.local_features.keypoints import find_keypoints, join_keypoints
from piccolo.local_features.perspective_view import VIEWS_DEG, add_margin, cover_sphere
from piccolo.local_features.scale_space import CONTRAST
from piccolo.local_features.sift import DESCRIPTOR_SIZE, find_sift
from piccolo.system.jobs.threads import Workers

WIDTH = rooms.WIDTH
PIXEL = 2.0 * np.pi / WIDTH  # [rad]
VIEWS = cover_sphere(WIDTH)


@functools.lru_cache
def _gray():
    return cv2.cvtColor(rooms.query(1).rgb, cv2.COLOR_RGB2GRAY)


@functools.lru_cache
def _found(shift=0):
    """The keypoints of a room's photo turned by some pixels."""
    gray = np.ascontiguousarray(np.roll(_gray(), shift, axis=1))
    return find_keypoints(gray, np.ones(gray.shape, bool), VIEWS, Workers(2))


def test_rays_and_tangents_are_unit_and_orthogonal():
    found = _found()
    assert len(found.rays) > 300
    for directions in (found.rays, found.tangents):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(found.rays * found.tangents, axis=1), 0.0, atol=1e-5)
    assert found.descriptors.shape == (len(found.rays), DESCRIPTOR_SIZE)
    # square roots of shares that add up to one, but for SIFT's own rounding
    np.testing.assert_allclose((found.descriptors / 255.0).__pow__(2).sum(axis=1), 1.0, atol=0.05)
    assert PIXEL < found.sizes.min() < found.sizes.max() < 1.0


def test_turning_the_sphere_turns_the_keypoints():
    """By half a turn the views fall on each other; by other angles most keypoints are found again."""
    for shift, least, most_off in ((WIDTH // 2, 0.97, 0.1), (37, 0.6, 0.7)):
        own, turned = _found(), _found(shift)
        R = yaw_rotation(shift * PIXEL)
        back, tangents = turned.rays @ R, turned.tangents @ R
        forward = own.rays @ R.T
        assert (cKDTree(turned.rays).query(forward)[0] < most_off * PIXEL).mean() > least
        wrong_way = own.rays @ R
        distance, nearest = cKDTree(own.rays).query(back)
        is_same = distance < most_off * PIXEL
        assert is_same.mean() > least
        if shift == 37:
            assert (cKDTree(turned.rays).query(wrong_way)[0] < most_off * PIXEL).mean() < 0.3
        cosines = np.sum(tangents[is_same] * own.tangents[nearest[is_same]], axis=1)
        assert np.median(cosines) > np.cos(np.radians(8.0))
        ratios = turned.sizes[is_same] / own.sizes[nearest[is_same]]
        np.testing.assert_allclose(np.median(ratios), 1, atol=0.05)


def test_keypoints_of_a_view_are_those_of_opencv():
    view = VIEWS[0]
    picture = view.cut(add_margin(_gray()))
    detector = cv2.SIFT.create(contrastThreshold=float(CONTRAST), enable_precise_upscale=True)
    expected = np.array([(*k.pt, k.size, np.radians(k.angle)) for k in detector.detect(picture)])
    found, _ = find_sift(picture, np.ones_like(picture))
    places = [np.stack([x, y, 6.0 * np.log(size)], axis=1) for x, y, size, _ in (found.T, expected.T)]
    distance, nearest = cKDTree(places[0]).query(places[1])
    assert len(expected) > 50
    assert abs(len(found) - len(expected)) <= 0.05 * len(expected)
    assert (distance < 0.1).mean() > 0.97
    alike = np.cos(found[nearest, 3] - expected[:, 3])
    assert np.median(alike) > np.cos(0.02)


def test_what_views_share_counts_once():
    """No two keypoints of the same place, size and tangent are of different views."""
    found = _found()
    middles = VIEWS[0].middles
    assert len(middles) == len(VIEWS_DEG) == 20
    own = np.argmax(found.rays @ middles.T, axis=1)
    assert len(np.unique(own)) > 10
    values = np.concatenate([found.rays / PIXEL, 3.0 * found.tangents], axis=1)
    pairs = cKDTree(values).query_pairs(0.7, output_type="ndarray")
    is_alike = np.abs(np.log(found.sizes[pairs[:, 0]] / found.sizes[pairs[:, 1]])) < 0.1
    of_two_views = own[pairs[:, 0]] != own[pairs[:, 1]]
    assert not (is_alike & of_two_views).any()


def test_parts_of_the_views_find_what_all_find():
    gray = _gray()
    whole = _found()
    is_valid = np.ones(gray.shape, bool)
    halves = [find_keypoints(gray, is_valid, VIEWS[k::2], Workers(2)) for k in range(2)]
    assert min(len(half.rays) for half in halves) > 0.3 * len(whole.rays)
    joined = join_keypoints(halves)
    by_ray = [np.lexsort((found.sizes, *found.rays.T)) for found in (joined, whole)]
    for own, other in zip(joined.take(by_ray[0]), whole.take(by_ray[1]), strict=True):
        np.testing.assert_array_equal(np.sort(own, axis=0), np.sort(other, axis=0))


def test_masked_areas_have_none():
    is_valid = np.ones((WIDTH // 2, WIDTH), bool)
    is_valid[:, 100:300] = False
    is_valid[150:] = False
    found = find_keypoints(_gray(), is_valid, VIEWS)
    _, nearest = cKDTree(pixel_rays(WIDTH).reshape(-1, 3)).query(found.rays)
    assert len(found.rays) > 50
    assert is_valid.ravel()[nearest].all()
    nothing = find_keypoints(_gray(), np.zeros_like(is_valid), VIEWS)
    assert [len(values) for values in nothing] == [0, 0, 0, 0]
    flat = find_keypoints(np.full_like(_gray(), 128), np.ones_like(is_valid), VIEWS)
    assert flat.descriptors.shape == (0, DESCRIPTOR_SIZE)
    assert flat.descriptors.dtype == np.uint8


def test_same_bits_for_any_number_of_threads():
    alone = find_keypoints(_gray(), np.ones(_gray().shape, bool), VIEWS, Workers(1))
    for own, other in zip(_found(), alone, strict=True):
        np.testing.assert_array_equal(own, other)


def test_keypoints_turned_over_are_those_of_the_picture_turned_over():
    gray = np.ascontiguousarray(_gray()[:, ::-1])
    expected = find_keypoints(gray, np.ones(gray.shape, bool), VIEWS, Workers(2))
    found = _found().mirror()
    distance, nearest = cKDTree(np.hstack([expected.rays, expected.tangents])).query(
        np.hstack([found.rays, found.tangents])
    )
    is_same = distance < 0.01
    assert is_same.mean() > 0.75
    np.testing.assert_allclose(found.sizes[is_same], expected.sizes[nearest[is_same]], rtol=0.05)
    off = found.descriptors[is_same].astype(int) - expected.descriptors[nearest[is_same]]
    assert np.abs(off).mean() < 1.0
