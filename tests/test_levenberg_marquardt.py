import math

import numpy as np
import pytest

from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.optimize.levenberg_marquardt import levenberg_marquardt, retract, solve_damped
from piccolo.optimize.normal_equations import GRADIENT, LOSS, MATRIX

TILTED = Pose(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.2, -0.3, 0.1]))


def test_solver_equals_numpy_and_refuses_a_singular_matrix():
    rng = np.random.default_rng(0)
    J = rng.normal(size=(20, 6))
    A, g, delta = J.T @ J, rng.normal(size=6), np.empty(6)
    assert solve_damped(np.concatenate([[0.0, 0.0], g, A[np.triu_indices(6)]]), 0.1, delta)
    np.testing.assert_allclose(delta, np.linalg.solve(A + 0.1 * np.diag(np.diag(A)), -g), rtol=1e-6)
    assert not solve_damped(np.concatenate([[0.0, 0.0], g, -A[np.triu_indices(6)]]), 0.0, delta)


def test_step_is_limited_and_otherwise_that_of_the_pose():
    R, t = np.empty((3, 3)), np.empty(3)
    small = np.array([0.01, -0.02, 0.03, 0.05, 0.02, -0.04])
    length = retract(TILTED.R_cam_from_world, TILTED.center_world, small, R, t)
    expected = step(TILTED, small)
    np.testing.assert_allclose(R, expected.R_cam_from_world, atol=1e-9)
    np.testing.assert_allclose(t, expected.center_world, atol=1e-12)
    assert length == pytest.approx(np.linalg.norm(small[:3]) + np.linalg.norm(small[3:]))
    retract(TILTED.R_cam_from_world, TILTED.center_world, 100 * small, R, t)
    assert np.linalg.norm(t - TILTED.center_world) <= 0.3 + 1e-9
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)


def test_descent_arrives_and_takes_no_step_up():
    """A bowl about (1, 2, 3) with a wall around a point on the way, where the loss is 100."""
    goal, losses = np.array([1.0, 2.0, 3.0]), []

    def equations(problem, R, t, sums):
        e = R @ (t - goal)
        is_wall = np.linalg.norm(t - problem) < 0.1
        sums[LOSS], sums[GRADIENT:MATRIX] = 100.0 if is_wall else 0.5 * e @ e, [0, 0, 0, *e]
        sums[MATRIX:] = np.diag([1.0] * 6)[np.triu_indices(6)]
        losses.append(sums[LOSS])

    for num_iterations, most in ((3, 7.0), (100, 1e-9)):
        R, t = np.eye(3), np.zeros(3)
        loss = levenberg_marquardt(equations)(0.3 * goal / np.linalg.norm(goal), num_iterations, 1e-7, R, t)
        assert loss == pytest.approx(0.5 * (t - goal) @ (t - goal))
        assert loss <= most
    assert max(losses) == 100.0
    assert len(losses) < 60


def test_a_start_without_a_loss_takes_no_step():
    calls = []

    def equations(problem, R, t, sums):
        sums[:] = np.nan
        calls.append(t.copy())

    R, t = np.eye(3), np.ones(3)
    assert levenberg_marquardt(equations)(None, 9, 1e-7, R, t) == math.inf
    np.testing.assert_array_equal(calls, [np.ones(3)])
    np.testing.assert_array_equal(R, np.eye(3))
