import math

import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.geometry.rotations import uniform_yaws
from piccolo.optimize.refine import Loss, sampling_loss_of
from piccolo.panorama.model import shrink
from piccolo.panorama.texels import pack_texels
from piccolo.paper.search import histogram_similarity, losses_at

AT = np.array([1.0, 2.0, 1.5])


def test_rotation_without_a_loss_is_no_hypothesis():
    loss = Loss(
        lambda points, pose: pose.R_cam_from_world[0, 0] if pose.R_cam_from_world[0, 0] > 0 else math.inf,
        None,
    )
    turns = np.stack([yaw_rotation(a) for a in np.radians([60, 0, 180])])
    np.testing.assert_allclose([h.score for h in losses_at(None, loss, AT, turns)], [-0.5, -1.0])
    points, panorama, true_pose = rooms.scene(1)
    turns = uniform_yaws(8) @ true_pose.R_cam_from_world
    scored = losses_at(points, sampling_loss_of(pack_texels(panorama.rgb)), true_pose.center_world, turns)
    assert np.argmax([h.score for h in scored]) == 0


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


def test_histograms_agree_best_at_the_true_place(scene):
    points, panorama, true_pose = scene
    small = shrink(panorama, 128)
    elsewhere = Pose(true_pose.R_cam_from_world, -true_pose.center_world)
    here, there = (histogram_similarity(points, small, pose, 8) for pose in (true_pose, elsewhere))
    assert here > max(0.75, there)
