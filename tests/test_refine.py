"""Descents on a loss."""

import dataclasses

import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, step, yaw_rotation
from piccolo.localization.paper import PaperSettings
from piccolo.localization.paper_descent import Adam, descend_lbfgs, make_sampling_loss, refine_by_solver
from piccolo.photo.panorama.texels import pack_texels

PERTURBATION = np.array([0.05, -0.04, 0.12, 0.15, -0.12, 0.08])  # rad, m


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


@pytest.mark.parametrize("solver", ["adam", "lbfgs", "gauss-newton"])
@pytest.mark.parametrize("use_visibility", [True, False])
def test_descent_recovers_the_true_pose(scene, solver, use_visibility):
    points, panorama, true_pose = scene
    texels = pack_texels(panorama.rgb)
    settings = dataclasses.replace(PaperSettings(), solver=solver, use_visibility=use_visibility)
    refined = refine_by_solver(points, make_sampling_loss(texels), step(true_pose, PERTURBATION), settings)
    rooms.assert_near(refined.pose, true_pose, 0.010, 0.3)


def test_adam_decays_after_patience_stalled_losses():
    adam = Adam(step_size=0.1, step_decay=0.8, patience=5)
    for loss in [1.0] + [1.0] * 4:
        adam.update(loss, np.ones(6))
    assert adam.step_size == 0.1
    adam.update(1.0, np.ones(6))
    assert adam.step_size == pytest.approx(0.08)


def test_adams_first_step_is_the_step_size_against_the_gradient():
    delta = Adam(0.1, 0.8, 5).update(1.0, np.array([3.0, -0.001, 0, 0, 0, 7.0]))
    np.testing.assert_allclose(delta, [-0.1, 0.1, 0, 0, 0, -0.1], rtol=1e-4)


def test_lbfgs_follows_a_gradient_in_steps_of_the_camera():
    """A bowl about a known pose, its gradient by steps: a wrong chain rule would not arrive."""
    start = Pose(yaw_rotation(0.5), np.array([1.0, 2.0, 3.0]))
    goal = step(start, np.array([0.3, -0.2, 0.4, 0.5, 0.4, -0.3]))
    x_world = np.random.default_rng(0).normal(size=(20, 3))

    def objective(pose):
        p = (x_world - pose.center_world) @ pose.R_cam_from_world.T
        e = p - (x_world - goal.center_world) @ goal.R_cam_from_world.T
        gradient = np.concatenate([np.cross(p, e).sum(axis=0), -e.sum(axis=0)])
        return 0.5 * (e**2).sum(), gradient, np.eye(6)

    start = Pose(yaw_rotation(0.5), np.array([1.0, 2.0, 3.0]))
    best = descend_lbfgs(objective, start, 100)
    np.testing.assert_allclose(best.pose.center_world, goal.center_world, atol=1e-4)
    np.testing.assert_allclose(best.pose.R_cam_from_world, goal.R_cam_from_world, atol=1e-4)
