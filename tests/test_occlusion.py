"""What of a photo the scan explains: made rooms, photos with occluders whose place is known."""

import cv2
import numpy as np
import pytest
import rooms

from piccolo.evidence import occlusion
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.geometry.sphere import pixel_rays, solid_angles
from piccolo.photo.panorama import Panorama

SEEDS = (1, 2, 3, 4, 5)


def _areas(shape):
    return np.broadcast_to(solid_angles(shape[1])[:, None], shape)


def _caps(rng, width, fraction, radius_deg=(8.0, 30.0)):
    """Round occluders near the horizon that hide a fraction of the sphere: mask (H, W), and a number each."""
    rays = pixel_rays(width)
    number = np.zeros((width // 2, width), int)
    while (_areas(number.shape) * (number > 0)).sum() < fraction * 4.0 * np.pi:
        axis = rng.normal(size=3) * [1.0, 1.0, 0.4]
        cosine = np.cos(np.radians(rng.uniform(*radius_deg)))
        number[(rays @ axis / np.linalg.norm(axis) > cosine) & (number == 0)] = number.max() + 1
    return number


def _occluded(panorama, number, rng, contrast):
    """The photo with coloured surfaces, each with a pattern of its own, where there is a number."""
    rgb = panorama.rgb.copy()
    (height, width) = number.shape
    for n in range(1, number.max() + 1):
        pattern = rng.integers(30, 226, 3) + rng.normal(0.0, contrast, (12, 24, 3))
        texture = pattern.clip(0, 255).astype(np.uint8)
        image = cv2.resize(texture, (width, height), interpolation=cv2.INTER_CUBIC)
        rgb[number == n] = image[number == n]
    return rooms.as_panorama(rgb)


def _intersection_over_union(found, true):
    areas = _areas(true.shape)
    return (areas * (found & true)).sum() / (areas * (found | true)).sum()


@pytest.mark.parametrize("contrast", [15.0, 60.0])
def test_occluders_are_where_the_mask_is_white(contrast):
    overlaps = []
    for seed in SEEDS:
        points, panorama, pose = rooms.scene(seed)
        for fraction in (0.2, 0.3, 0.4):
            rng = np.random.default_rng([seed, int(100 * fraction)])
            number = _caps(rng, rooms.WIDTH, fraction)
            photo = _occluded(panorama, number, rng, contrast)
            mask = occlusion.occlusion_mask(points, photo, pose)
            was_scanned = mask != occlusion.NOT_SCANNED
            is_contradicted = mask == occlusion.CONTRADICTED_LEVEL
            overlaps.append(_intersection_over_union(is_contradicted, (number > 0) & was_scanned))
            explained, contradicted = occlusion.compare_occlusion(points, photo, pose).fractions()
            assert contradicted / (explained + contradicted) == pytest.approx(fraction, abs=0.15)
            assert explained + contradicted <= 1.0
    assert np.median(overlaps) >= 0.75
    assert min(overlaps) >= 0.45


@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0), (0.6, 0.5, 0.4), (1.25, 1.0, 0.8)])
def test_an_unchanged_room_contradicts_nothing_whatever_the_exposure(gains):
    for seed in SEEDS:
        points, panorama, pose = rooms.scene(seed)
        photo = rooms.as_panorama((panorama.rgb * np.array(gains)).clip(0, 255).astype(np.uint8))
        explained, contradicted = occlusion.compare_occlusion(points, photo, pose).fractions()
        assert contradicted < 0.02
        assert explained > 0.75


def test_turning_the_camera_turns_the_mask():
    """The seam is no edge, and the mask is in the photo's own frame."""
    points, panorama, pose = rooms.scene(2)
    rng = np.random.default_rng(0)
    quarter = rooms.WIDTH // 4
    photo = _occluded(panorama, _caps(rng, rooms.WIDTH, 0.2), rng, 40.0)
    turned = rooms.as_panorama(np.roll(photo.rgb, quarter, axis=1))
    R = exp_so3(np.array([0.0, 0.0, -np.pi / 2.0])) @ pose.R_cam_from_world
    masks = [
        np.roll(occlusion.occlusion_mask(points, photo, pose), quarter, axis=1),
        occlusion.occlusion_mask(points, turned, Pose(R, pose.center_world)),
    ]
    assert np.mean(masks[0] != masks[1]) < 0.01


def test_what_was_not_scanned_or_not_photographed_is_grey():
    points, panorama, pose = rooms.scene(3)
    directions = np.stack([points.x, points.y, points.z], axis=1) - pose.center_world
    ahead = directions @ pose.R_cam_from_world[0] / np.linalg.norm(directions, axis=1)
    half = points.take(np.nonzero(ahead > 0.0)[0])
    is_valid = np.ones(panorama.rgb.shape[:2], bool)
    is_valid[:, :256] = False  # the left half of the image centre, and behind it on that side
    photo = Panorama(panorama.rgb, is_valid)
    mask = occlusion.occlusion_mask(half, photo, pose)
    assert mask.shape == panorama.rgb.shape[:2]
    assert set(np.unique(mask)) <= {occlusion.EXPLAINED, occlusion.NOT_SCANNED, occlusion.CONTRADICTED_LEVEL}
    assert (mask[:, :256] == occlusion.NOT_SCANNED).all()
    forward = pixel_rays(rooms.WIDTH)[..., 0]
    assert np.mean(mask[forward < -0.1] == occlusion.NOT_SCANNED) > 0.99
    assert np.mean(mask[(forward > 0.1) & is_valid] == occlusion.EXPLAINED) > 0.9
    explained, contradicted = occlusion.compare_occlusion(half, photo, pose).fractions()
    assert 0.4 < explained < 0.52
    assert contradicted < 0.02


def test_nothing_in_common_is_neither_explained_nor_contradicted():
    points, panorama, pose = rooms.scene(1)
    hidden = Panorama(panorama.rgb, np.zeros(panorama.rgb.shape[:2], bool))
    nothing = occlusion.compare_occlusion(points, hidden, pose)
    assert nothing.fractions() == (0.0, 0.0)
    assert not nothing.is_compared.any()


def test_squared_differences_are_as_their_formula_says():
    """Beyond a range in the photo's contrast, less where the photo or the scan is flat; nothing is unseen."""
    rng = np.random.default_rng(0)
    shape = (20, 30, 3)
    channels, means = rng.random(shape), rng.random((2, *shape))
    per_deviation = 1.0 / rng.uniform(0.01, 0.5, (2, *shape))
    low, high = np.sort(rng.normal(0.0, 1.0, (2, *shape)), axis=0)
    low[:, :5], high[:, :5] = 9.0, -9.0  # as where nothing of the scan is seen
    value = (channels - means[0]) * per_deviation[0]
    outside = np.maximum(np.maximum(low - value, value - high), 0.0)
    variance = 1.0 / per_deviation.min(axis=0) ** 2
    outside *= np.sqrt(variance / (variance + occlusion.FLAT_VARIANCE))
    expected = (outside**2).sum(axis=2)
    statistics = (np.concatenate([m, d], axis=2) for m, d in zip(means, per_deviation, strict=True))
    squares = np.empty(shape[:2], np.float32)
    occlusion.write_squares(*(a.astype(np.float32) for a in (channels, *statistics, low, high)), squares)
    np.testing.assert_allclose(squares, expected, rtol=1e-4, atol=1e-4)
    assert np.median(squares) > 0.0
