import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, are_same, yaw_rotation
from piccolo.optimize.refine import sampling_loss_of
from piccolo.panorama.resize import shrink
from piccolo.panorama.texels import pack_texels
from piccolo.paper.search import Scored, histogram_distance, keep_diverse, losses_at

AT = np.array([1.0, 2.0, 1.5])


def _scored(x, yaw_deg, score):
    return Scored(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


def test_poses_are_the_same_only_if_near_and_turned_alike():
    a, b, c = (_scored(x, yaw, 0).pose for x, yaw in ((0, 0), (0.2, 10), (0.2, 20)))
    assert are_same(a, b, 0.3, np.radians(15))
    assert not are_same(a, c, 0.3, np.radians(15))
    assert not are_same(a, b, 0.1, np.radians(15))


def test_diverse_best_are_kept_and_infinite_scores_are_not():
    candidates = [
        _scored(0, 0, 0.3),
        _scored(0.1, 0, 0.1),
        _scored(2, 0, 0.2),
        _scored(4, 0, np.inf),
        _scored(6, 0, 0.4),
    ]
    kept = keep_diverse(candidates, 3, 0.3, np.radians(15))
    assert [k.score for k in kept] == [0.1, 0.2, 0.4]
    assert len(keep_diverse(candidates, 1, 0.3, np.radians(15))) == 1


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


def test_true_rotation_has_the_smallest_loss(scene):
    points, panorama, true_pose = scene
    turns = np.stack(
        [yaw_rotation(a) @ true_pose.R_cam_from_world for a in np.radians([0, 45, 90, 180, 270])]
    )
    scored = losses_at(points, sampling_loss_of(pack_texels(panorama.rgb)), true_pose.center_world, turns)
    assert np.argmin([s.score for s in scored]) == 0


def test_histograms_agree_best_at_the_true_place(scene):
    points, panorama, true_pose = scene
    small = shrink(panorama, 128)
    elsewhere = Pose(true_pose.R_cam_from_world, -true_pose.center_world)
    assert histogram_distance(points, small, true_pose, 8) < 0.25
    assert histogram_distance(points, small, true_pose, 8) < histogram_distance(points, small, elsewhere, 8)
