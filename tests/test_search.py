import numpy as np
import pytest
import rooms

from piccolo.coarse_to_fine.scan_map import SEARCH_VIEW, prepare_map
from piccolo.coarse_to_fine.search import (
    best_poses,
    correlate_pairs,
    pick_distinct,
    score_poses,
    score_poses_wide,
    turn_panorama,
)
from piccolo.geometry.pose import angle_between
from piccolo.geometry.rotations import uniform_rotations, uniform_yaws
from piccolo.geometry.sphere_grid import make_grid
from piccolo.panorama import Panorama
from piccolo.panorama.local_normalization import Scale, comparable, normalized_channels, sample_channels
from piccolo.panorama.resize import resize
from piccolo.runtime.threads import Workers

SCALE = Scale(128, 7.5, SEARCH_VIEW.sigma_deg)


@pytest.fixture(scope="module")
def scan_map():
    return prepare_map(rooms.room(1)[1], Workers(2))


def _levels(texels):
    """Channels (H, W, 3) less the zero level, and validity (H, W), of packed texels."""
    inner = texels.rgbx.reshape(-1, texels.width + 2)[1:-1, 1:-1]
    channels = np.stack([(inner >> shift) & 255 for shift in (0, 8, 16)], axis=-1) - 127.5
    return channels, inner >> 24 == 1


def test_channels_forget_exposure_and_white_balance():
    panorama = rooms.scene(1)[1]
    darker = Panorama((panorama.rgb * np.array([0.7, 0.6, 0.5])).astype(np.uint8), panorama.is_valid)
    a, b = (_levels(normalized_channels(resize(p, 128), 7.5, 22.0))[0][..., 0] for p in (panorama, darker))
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.95


def test_what_is_masked_does_not_bleed():
    panorama = rooms.scene(1)[1]
    is_valid = panorama.is_valid.copy()
    is_valid[200:] = False
    black, white = panorama.rgb.copy(), panorama.rgb.copy()
    black[200:], white[200:] = 0, 255
    (a, valid), (b, _) = (_levels(comparable(Panorama(rgb, is_valid), [SCALE])[0]) for rgb in (black, white))
    np.testing.assert_array_equal(a[valid], b[valid])
    assert valid.mean() == pytest.approx(200 / 256, abs=0.02)


def test_images_of_every_scale_have_their_width():
    images = comparable(rooms.scene(1)[1], [Scale(1024, 0.0, 10.0), Scale(256, 0.0, 10.0), SCALE])
    assert [i.width for i in images] == [1024, 256, 128]


def test_samples_along_turned_directions_equal_the_pixels():
    texels = normalized_channels(resize(rooms.scene(1)[1], 128), 7.5, 22.0)
    channels, _ = _levels(texels)
    direction = np.array([[np.cos(0.3), 0.0, np.sin(0.3)]], dtype=np.float32)
    rotation = uniform_yaws(8)[3].astype(np.float32)
    samples, validity = np.empty((1, 3, 1), np.float32), np.empty((1, 1), np.float32)
    sample_channels(texels.rgbx, 128, direction, rotation[None], samples, validity)
    x, y, z = rotation @ direction[0]
    u, v = (0.5 - np.arctan2(y, x) / (2 * np.pi)) * 128, (0.5 - np.arcsin(z) / np.pi) * 64
    near = channels[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2].reshape(-1, 3)
    assert validity[0, 0] == 1
    assert (samples[0, :, 0] >= near.min(axis=0) - 1e-3).all()
    assert (samples[0, :, 0] <= near.max(axis=0) + 1e-3).all()


def test_scores_equal_correlations_one_by_one(scan_map):
    rng = np.random.default_rng(0)
    rotations = uniform_rotations(50)
    samples, validity = turn_panorama(comparable(rooms.scene(1)[1], [SCALE])[0], rotations)
    validity[:, rng.random(validity.shape[1]) < 0.2] = 0
    samples *= validity[:, None]
    scores = score_poses(scan_map, samples, validity)
    area = make_grid(24).solid_angle
    candidate, rotation = rng.integers(0, len(scores), 40), rng.integers(0, 50, 40)
    pairs = np.empty(40, np.float32)
    correlate_pairs(scan_map.features, scan_map.is_seen, area, samples, validity, candidate, rotation, pairs)
    np.testing.assert_allclose(scores[candidate, rotation], pairs, atol=1e-4)
    for c, r, score in zip(candidate[:5], rotation[:5], pairs[:5], strict=True):
        w = area * scan_map.is_seen[c] * validity[r]
        f, s = scan_map.features[c].astype(float), samples[r].astype(float)
        twin = (w * f * s).sum() / np.sqrt((w * f * f).sum() * (w * s * s).sum())
        assert score == pytest.approx(twin, abs=1e-4)


@pytest.mark.parametrize("is_wide", [False, True])
def test_best_score_is_near_the_true_pose(scan_map, is_wide):
    _, panorama, true_pose = rooms.scene(1)
    rotations = uniform_rotations(2000) if is_wide else uniform_yaws(48)
    samples, validity = turn_panorama(comparable(panorama, [SCALE])[0], rotations)
    scores = (score_poses_wide if is_wide else score_poses)(scan_map, samples, validity)
    candidate, rotation, values = best_poses(scores, 200)
    centers = scan_map.centers[scan_map.sparse] if is_wide else scan_map.centers
    assert (np.diff(values) <= 0).all()
    near = [
        np.linalg.norm(centers[c] - true_pose.center_world) < 0.8
        and np.degrees(angle_between(rotations[r], true_pose.R_cam_from_world)) < 25
        for c, r in zip(candidate, rotation, strict=True)
    ]
    assert any(near[: 100 if is_wide else 10])


def test_best_poses_are_the_largest_in_order():
    scores = np.random.default_rng(1).normal(size=(400, 600)).astype(np.float32)
    candidate, rotation, values = best_poses(scores, 100)
    np.testing.assert_array_equal(values, np.sort(scores.ravel())[::-1][:100])
    np.testing.assert_array_equal(scores[candidate, rotation], values)


def test_distinct_poses_are_the_first_of_their_neighbourhood():
    centers = np.array([[0.0, 0, 0], [0.1, 0, 0], [2, 0, 0], [0.1, 0, 0]])
    rotations = np.stack([uniform_yaws(36)[k] for k in (0, 1, 0, 9)])
    assert pick_distinct(rotations, centers, 9, 0.5, 20.0).tolist() == [0, 2, 3]
    assert pick_distinct(rotations, centers, 2, 0.5, 20.0).tolist() == [0, 2]
