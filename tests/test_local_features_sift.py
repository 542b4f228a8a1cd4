"""SIFT: twin, places and sizes that are known, pictures turned, small and without any."""

import functools

import naive_sift
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from piccolo.local_features.scale_space import find_extremes
from piccolo.local_features.sift import DESCRIPTOR_SIZE, describe_octave, find_sift, make_room
from piccolo.system.kernels.jit import HALF

PER_RADIAN = 6.0  # [px] that differences of angles, and of the logarithms of sizes, are worth
SHAPE = (44, 60)


@functools.lru_cache
def _picture():
    """A picture of spots of all sizes."""
    rng = np.random.default_rng(4)
    total = np.zeros(SHAPE)
    for blur in (1.0, 2.0, 4.0, 8.0):
        noise = ndimage.gaussian_filter(rng.normal(size=SHAPE), blur)
        total += noise / noise.std()
    return np.clip(128.0 + 25.0 * total, 0.0, 255.0).astype(np.uint8)


def _find(picture):
    return find_sift(picture, np.full_like(picture, 255))


def _as_vectors(keypoints):
    x, y, size, angle = np.asarray(keypoints, float).T
    turn = PER_RADIAN * np.cos(angle), PER_RADIAN * np.sin(angle)
    return np.stack([x, y, PER_RADIAN * np.log(size), *turn], axis=1)


def _pairs(own, other, most_off):
    """Indices of keypoints that are the same but for `most_off`."""
    distance, nearest = cKDTree(_as_vectors(other)).query(_as_vectors(own))
    same = np.flatnonzero(distance < most_off)
    return same, nearest[same]


def test_keypoints_equal_their_twin():
    own, descriptors = _find(_picture())
    twin, of_twin = naive_sift.find_sift(_picture())
    assert len(twin) > 40
    assert abs(len(own) - len(twin)) <= 0.05 * len(twin)
    same, of_same = _pairs(own, twin, 0.1)
    assert len(same) >= 0.95 * len(twin)
    assert len(np.unique(of_same)) == len(same)
    np.testing.assert_allclose(own[same, :2], twin[of_same, :2], atol=0.02)
    off = descriptors[same] - of_twin[of_same]
    assert np.abs(off).mean() < 1.0


@pytest.mark.parametrize("sigma", [1.8, 2.5, 4.0])
def test_a_spot_has_its_place_and_size(sigma):
    y, x = np.indices((64, 64))
    center = 31.3, 29.6
    spot = np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / (2.0 * sigma**2))
    keypoints, _ = _find(np.rint(200.0 * spot + 20.0).astype(np.uint8))
    nearest = np.argmin(np.hypot(*(keypoints[:, :2] - center).T))
    np.testing.assert_allclose(keypoints[nearest, :2], center, atol=0.05)
    # differences of Gaussians of sigmas s and k s are extreme at sqrt(k) s = sigma of the spot
    factor = 2.0 ** (1.0 / 6.0)
    np.testing.assert_allclose(keypoints[nearest, 2], 2.0 * sigma / factor, rtol=0.03)


def test_a_picture_turned_by_a_quarter_has_the_keypoints_turned():
    picture = _picture()
    own, descriptors = _find(picture)
    turned, of_turned = _find(np.ascontiguousarray(np.rot90(picture)))
    back = turned.copy()
    back[:, 0] = picture.shape[1] - 1.0 - turned[:, 1]
    back[:, 1] = turned[:, 0]
    back[:, 3] = turned[:, 3] + np.pi / 2.0
    same, of_same = _pairs(own, back, 0.5)
    assert len(same) > 0.8 * len(own)
    assert np.abs(descriptors[same].astype(float) - of_turned[of_same]).mean() < 4.0


def test_only_what_is_shown_has_keypoints():
    shown = np.zeros(SHAPE, np.uint8)
    shown[:, 30:] = 1
    whole, of_whole = _find(_picture())
    keypoints, descriptors = find_sift(_picture(), shown)
    kept = np.rint(whole[:, 0]) >= 30.0
    assert 0 < kept.sum() < len(whole)
    np.testing.assert_array_equal(keypoints, whole[kept])
    np.testing.assert_array_equal(descriptors, of_whole[kept])


@pytest.mark.parametrize("shape", [(1, 1), (7, 40), (8, 8), (9, 31), (64, 64)])
def test_pictures_without_room_or_content_have_none(shape):
    keypoints, descriptors = _find(np.full(shape, 77, np.uint8))
    assert keypoints.shape == (0, 4)
    assert descriptors.shape == (0, DESCRIPTOR_SIZE)
    assert descriptors.dtype == np.uint8


def test_no_more_is_written_than_there_is_room_for():
    images = next(naive_sift.make_octaves(_picture()))[0].astype(np.float32)
    shown = np.ones(SHAPE, np.uint8)
    places = np.full((1000, 3), -1.0, np.float32)
    count = find_extremes(images, HALF, shown, places)
    assert 5 < count < len(places)
    assert find_extremes(images, HALF, shown, places[:5].copy()) == 5
    keypoints = np.full((3, 4), -1.0, np.float32)
    descriptors = np.zeros((3, DESCRIPTOR_SIZE), np.uint8)
    room = make_room(images.shape[2])
    assert describe_octave(images, places[:count], HALF, room, keypoints, descriptors) == 3
    np.testing.assert_allclose(keypoints, _find(_picture())[0][:3], atol=0.02)


def test_keypoints_of_noise_are_within_the_picture():
    noise = np.random.default_rng(2).integers(0, 2, (48, 80)).astype(np.uint8) * np.uint8(255)
    keypoints, descriptors = _find(noise)
    assert len(keypoints) == len(descriptors) > 10
    assert np.isfinite(keypoints).all()
    assert (keypoints[:, :2] >= 0.0).all()
    assert (keypoints[:, :2] <= [79.0, 47.0]).all()
