"""Robust least squares: equations against differences, known problems, steps that are not taken."""

from functools import partial

import numpy as np
import pytest
from poses import covariance, tilted_poses

from piccolo.geometry.gauss_newton import Equations, minimize, sum_observations, whiten
from piccolo.geometry.pose import Pose, exp_so3, log_so3
from piccolo.geometry.pose_gaussian import add, differentiate_rays, subtract
from piccolo.geometry.robust import redescend

LIMIT = 9.0
robustly = partial(redescend, limit=LIMIT)


def _camera(seed, num_wrong=0, noise=1e-3):
    """Rays to known points by a camera, some of them wrong, and its equations at any pose."""
    rng = np.random.default_rng(seed)
    pose = tilted_poses(1, np.array([1.0, -2.0, 0.5]))[0]
    points = pose.center_world + rng.uniform(-5.0, 5.0, (60, 3))
    rays = differentiate_rays(points, pose)[0] + noise * rng.normal(size=points.shape)
    rays[:num_wrong] = rng.normal(size=(num_wrong, 3))

    def equations(at):
        predicted, J = differentiate_rays(points, at)
        return sum_observations((predicted - rays) / noise, J / noise, robustly)

    return pose, equations


def test_gradient_and_known_are_those_of_differences():
    true_pose, equations = _camera(3, num_wrong=20)
    pose = add(true_pose, np.array([2e-3, -1e-3, 1e-3, 3e-3, 4e-3, -5e-3]))
    information = np.diag(np.arange(1.0, 7.0)) + 0.2

    def known(at):
        return equations(at).add_known(subtract(at, pose) + 0.1, information)

    found = known(pose)
    for k, unit in enumerate(np.eye(6)):
        ends = [known(add(pose, side * unit)).loss for side in (1e-6, -1e-6)]
        assert found.gradient[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-2)
    np.testing.assert_allclose(found.matrix - information, equations(pose).matrix, rtol=1e-6, atol=1e-3)


def test_a_linear_problem_is_solved_by_one_step_without_damping():
    rng = np.random.default_rng(1)
    J = rng.normal(size=(20, 3, 7))
    covariances = np.array([covariance(rng)[:3, :3] for _ in range(20)])
    true = rng.normal(size=7)
    off = -J @ true + 0.01 * rng.normal(size=(20, 3))
    white = whiten(covariances, off), whiten(covariances, J)
    inverses = np.linalg.inv(covariances)
    matrix = np.einsum("kmi,kmn,knj->ij", J, inverses, J)
    right = -np.einsum("kmi,kmn,kn->i", J, inverses, off)
    plain = sum_observations(*white, lambda square: (0.5 * square, np.ones_like(square)))
    np.testing.assert_allclose(plain.matrix, matrix, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(plain.solve(), np.linalg.solve(matrix, right), rtol=1e-7)


@pytest.mark.parametrize("num_wrong", [0, 20])
def test_a_camera_is_found_from_afar_whatever_a_third_of_the_rays_says(num_wrong):
    true_pose, equations = _camera(5, num_wrong)
    start = add(true_pose, np.array([0.01, -0.02, 0.01, 0.05, 0.03, -0.04]))
    pose, found = minimize(equations, add, start, 30, 1e-9)
    errors = subtract(pose, true_pose)
    assert errors @ np.linalg.solve(np.linalg.inv(found.matrix), errors) < 16.8  # chi square of 6 at 99 %
    assert np.abs(found.gradient).max() < 1e-4 * np.abs(equations(start).gradient).max()


def test_a_step_that_raises_the_loss_is_not_taken():
    """Rosenbrock's valley, in which whole steps of Gauss and Newton jump out."""

    def equations(at):
        x, y = at
        residuals = np.array([[10.0 * (y - x * x)], [1.0 - x]])
        J = np.array([[[-20.0 * x, 10.0]], [[-1.0, 0.0]]])
        asked.append(0.5 * np.square(residuals).sum())
        return sum_observations(residuals, J, lambda square: (0.5 * square, np.ones_like(square)))

    asked = []
    state, found = minimize(equations, np.add, np.array([-1.2, 1.0]), 60, 1e-9)
    np.testing.assert_allclose(state, [1.0, 1.0], atol=1e-6)
    assert max(asked) > asked[0]  # such a step was tried
    assert found.loss == min(asked)


def test_it_ends_where_no_step_lowers_the_loss():
    asked = []

    def equations(at):
        asked.append(at)
        return Equations(float(len(asked)), np.ones(1), np.eye(1))

    assert minimize(equations, np.add, np.zeros(1), 100, 1e-9)[0] == 0.0
    assert len(asked) < 12


def test_a_rotation_is_found_by_its_logarithm():
    """A mean of rotations, which has no closed form."""
    rng = np.random.default_rng(2)
    rotations = [exp_so3(0.3 * rng.normal(size=3)) for _ in range(9)]

    def equations(at):
        off = np.array([log_so3(at.R_cam_from_world @ R.T) for R in rotations])
        J = np.tile(np.eye(6)[:3], (9, 1, 1))
        near = sum_observations(off, J, lambda square: (0.5 * square, np.ones_like(square)))
        return near.add_known(np.zeros(6), 1e-6 * np.eye(6))

    pose, _ = minimize(equations, add, Pose(rotations[0], np.zeros(3)), 30, 1e-10)
    away = sum(log_so3(pose.R_cam_from_world @ R.T) for R in rotations)
    np.testing.assert_allclose(away, 0.0, atol=1e-6)
