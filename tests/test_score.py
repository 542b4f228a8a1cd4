import numpy as np
import pytest
import rooms
from rooms import as_panorama

from piccolo.confidence.score import Agreement, agreement_at
from piccolo.geometry.pose import step
from piccolo.panorama import Panorama


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


def test_true_pose_scores_high_and_explains_most_of_the_panorama(scene):
    points, panorama, true_pose = scene
    assert agreement_at(points, panorama, true_pose).score > 0.5
    for delta in ([0, 0, 1.0, 0, 0, 0], [0, 0, 0, 1.0, 0.5, 0]):
        assert agreement_at(points, panorama, step(true_pose, np.array(delta))).score < 0.25
    points, panorama, true_pose = scene
    right = agreement_at(points, panorama, true_pose)
    wrong = agreement_at(points, panorama, step(true_pose, np.array([0, 0, 1.0, 0, 0, 0])))
    assert right.correlation > 0.5 > wrong.correlation
    assert 0.9 < right.seen_fraction <= 1.0


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_wall_can_not_win(scene, level):
    points, panorama, true_pose = scene
    blank = as_panorama(np.full_like(panorama.rgb, level))
    assert abs(agreement_at(points, blank, true_pose).score) < 0.05


def test_exposure_and_white_balance_change_little(scene):
    points, panorama, true_pose = scene
    darker = as_panorama((panorama.rgb * np.array([0.6, 0.5, 0.4])).astype(np.uint8))
    difference = np.diff([agreement_at(points, p, true_pose).score for p in (panorama, darker)])
    assert abs(difference) < 0.12


def test_mostly_masked_panorama_is_charged(scene):
    points, panorama, true_pose = scene
    is_valid = np.zeros(panorama.rgb.shape[:2], dtype=bool)
    is_valid[120:136] = True
    narrow = agreement_at(points, Panorama(panorama.rgb, is_valid), true_pose)
    assert narrow.seen_fraction < 0.15
    assert narrow.value < 0.25


def test_score_and_value_charge_a_view_of_which_little_is_seen():
    for seen, value, score in ((0.25, 0.3, 0.3), (0.64, 0.6, 0.48), (1.0, 0.6, 0.6)):
        agreement = Agreement(correlation=0.6, seen_fraction=seen)
        assert (agreement.value, agreement.score) == (pytest.approx(value), pytest.approx(score))
