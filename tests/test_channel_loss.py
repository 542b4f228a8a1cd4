"""The loss of the default method: twin, gradient, normal matrix; and the descent on it."""

import math

import naive
import numpy as np
import pytest

from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.optimize.channel_loss import (
    CHANCE,
    NUM_BLOCKS,
    ChannelProblem,
    channel_equations,
    correlate,
    score,
)
from piccolo.optimize.levenberg_marquardt import levenberg_marquardt, retract, solve_damped
from piccolo.optimize.normal_equations import COUNT, GRADIENT, LOSS, MATRIX, NUM_SUMS
from piccolo.panorama.texels import pack_texels

TILTED = Pose(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.2, -0.3, 0.1]))
SCALE = 60.0


def _problem(seed=0, count=900, width=128):
    """Points (3, N) about the tilted camera, their levels (3, N), weights (N,), and a smooth image."""
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(3, count)) * 2).astype(np.float32)
    levels = rng.uniform(60, 200, (3, count)).astype(np.float32)
    weights = rng.uniform(0.5, 1.5, count).astype(np.float32)
    v, u = np.mgrid[0 : width // 2, 0:width] / width * 2 * np.pi
    rgb = np.stack([127 + 100 * np.sin((k + 1) * u + v) for k in range(3)], axis=-1).astype(np.uint8)
    return points, levels, weights, rgb


def _loss(problem, pose):
    """Geman-McClure loss by NumPy."""
    points, levels, weights, rgb = problem
    pixels = naive.project(points.T, pose.R_cam_from_world, pose.center_world, rgb.shape[1])
    square = ((naive.sample(rgb, pixels) - levels.T) ** 2).sum(axis=1)
    return 0.5 * (weights * square / (1 + square / SCALE**2)).sum()


def _sums(problem, pose, is_valid=None):
    points, levels, weights, rgb = problem
    sums, texels = np.empty(NUM_SUMS), pack_texels(rgb, is_valid)
    arguments = ChannelProblem(points, levels, weights, texels.rgbx, texels.width, SCALE)
    channel_equations(arguments, pose.R_cam_from_world, pose.center_world, sums)
    return sums


def test_loss_equals_its_twin():
    problem = _problem()
    assert _sums(problem, TILTED)[LOSS] == pytest.approx(_loss(problem, TILTED), rel=1e-5)


def test_gradient_against_central_differences():
    problem = _problem()
    gradient = _sums(problem, TILTED)[GRADIENT:MATRIX]
    losses = [[_loss(problem, step(TILTED, h * e)) for h in (1e-6, -1e-6)] for e in np.eye(6)]
    numbers = [(ahead - behind) / 2e-6 for ahead, behind in losses]
    np.testing.assert_allclose(gradient, numbers, atol=0.02 * np.abs(numbers).max())


def test_matrix_is_that_of_the_weighted_jacobian():
    problem = _problem(count=300)
    points, levels, weights, rgb = problem

    def residuals(delta):
        at = step(TILTED, delta)
        pixels = naive.project(points.T, at.R_cam_from_world, at.center_world, rgb.shape[1])
        return naive.sample(rgb, pixels) - levels.T

    J = np.stack([(residuals(1e-6 * e) - residuals(-1e-6 * e)) / 2e-6 for e in np.eye(6)], axis=-1)
    s = 1 / (1 + (residuals(np.zeros(6)) ** 2).sum(axis=1) / SCALE**2)
    expected = np.einsum("n,nci,ncj->ij", weights * s * s, J, J)[np.triu_indices(6)]
    np.testing.assert_allclose(_sums(problem, TILTED)[MATRIX:], expected, atol=3e-3 * np.abs(expected).max())


def test_a_point_on_masked_pixels_costs_half_of_the_most_it_could():
    problem = _problem()
    sums = _sums(problem, TILTED, np.zeros(problem[3].shape[:2], dtype=bool))
    assert sums[COUNT] == 0
    assert sums[LOSS] == pytest.approx(0.25 * SCALE**2 * problem[2].sum(), rel=1e-6)
    assert (sums[GRADIENT:] == 0).all()


def test_each_block_correlates_over_what_both_show_and_counts_beyond_chance():
    points, levels, weights, rgb = _problem()
    is_valid = np.ones(rgb.shape[:2], dtype=bool)
    is_valid[:20] = False
    pixels = naive.project(points.T, TILTED.R_cam_from_world, TILTED.center_world, rgb.shape[1])
    shown = naive.sample(rgb, pixels).T
    noise = np.linspace(0, 200, points.shape[1]).astype(np.float32)  # so that blocks correlate more or less
    levels = np.clip(shown + noise * (levels - 130) / 70, 0, 255).astype(np.float32)
    w = weights * (naive.sample(is_valid[..., None], pixels)[:, 0] > 1 - 1e-9) / weights.sum()
    blocks = (np.arange(points.shape[1]) * NUM_BLOCKS // points.shape[1]).astype(np.int32)
    expected, total = [], 0.0
    for block in range(NUM_BLOCKS):
        a, b, of_block = *((x[:, blocks == block] - 127.5) for x in (shown, levels)), w[blocks == block]
        expected.append([a * b @ of_block, b * b @ of_block, a * a @ of_block, [of_block.sum()] * 3])
        product, own, other = (channel.sum() for channel in expected[-1][:3])
        total += max(product / np.sqrt(own * other) - CHANCE, 0) / (1 - CHANCE) * of_block.sum()
    texels = pack_texels(rgb, is_valid)
    how = texels.rgbx, texels.width, TILTED.R_cam_from_world, TILTED.center_world
    arguments = points, levels, (weights / weights.sum()).astype(np.float32), blocks, *how
    sums = np.empty((NUM_BLOCKS, 4))
    correlate(*arguments, sums)
    np.testing.assert_allclose(sums[:, :3], np.sum(expected, axis=2)[:, :3], rtol=1e-3, atol=0.5)
    np.testing.assert_allclose(sums[:, 3], np.array(expected)[:, 3, 0], rtol=1e-5)
    assert 0.5 < sums[:, 3].sum() < 0.9
    assert score(*arguments) == pytest.approx(total, abs=1e-4)
    assert 0.2 < total < 0.7


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
