import numpy as np
import pytest
import rooms
from rooms import as_panorama

from piccolo.confidence.score import agreement_at
from piccolo.geometry.pose import step
from piccolo.panorama import Panorama


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


def test_true_pose_scores_high_and_wrong_ones_low(scene):
    points, panorama, true_pose = scene
    assert agreement_at(points, panorama, true_pose).score > 0.5
    for delta in ([0, 0, 1.0, 0, 0, 0], [0, 0, 0, 1.0, 0.5, 0]):
        assert agreement_at(points, panorama, step(true_pose, np.array(delta))).score < 0.25


def test_right_pose_explains_most_of_the_panorama(scene):
    points, panorama, true_pose = scene
    right = agreement_at(points, panorama, true_pose)
    wrong = agreement_at(points, panorama, step(true_pose, np.array([0, 0, 1.0, 0, 0, 0])))
    assert right.explained_fraction > 0.8 > wrong.explained_fraction
    assert right.inlier_share > wrong.inlier_share
    assert right.residual_p20 < 0.5 * wrong.residual_p20
    assert right.explained_fraction <= right.inlier_share <= 1.0  # not all is seen


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_wall_can_not_win(scene, level):
    points, panorama, true_pose = scene
    blank = as_panorama(np.full_like(panorama.rgb, level))
    assert abs(agreement_at(points, blank, true_pose).score) < 0.05


def test_exposure_and_white_balance_change_little(scene):
    points, panorama, true_pose = scene
    darker = as_panorama((panorama.rgb * np.array([0.6, 0.5, 0.4])).astype(np.uint8))
    difference = (
        agreement_at(points, darker, true_pose).score - agreement_at(points, panorama, true_pose).score
    )
    assert abs(difference) < 0.12


def test_mostly_masked_panorama_is_charged(scene):
    points, panorama, true_pose = scene
    is_valid = np.zeros(panorama.rgb.shape[:2], dtype=bool)
    is_valid[120:136] = True
    narrow = agreement_at(points, Panorama(panorama.rgb, is_valid), true_pose)
    assert narrow.seen_fraction < 0.15
    assert narrow.score < 0.25


def test_local_contrast_forgets_gain_and_offset_but_not_pattern():
    pattern = np.random.default_rng(0).normal(size=(1, 48, 96)).astype(np.float32)
    everywhere = np.ones((48, 96), dtype=bool)
    a, b = local_contrast(pattern, everywhere), local_contrast(3.0 * pattern + 5.0, everywhere)
    np.testing.assert_allclose(a, b, atol=0.1)
    assert a.std() > 0.7
