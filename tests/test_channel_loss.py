"""The loss of the default method: twin, gradient, normal matrix; and the descent on it."""

import math

import naive
import numpy as np
import pytest

from piccolo.geometry.levenberg_marquardt import (
    COUNT_SUM,
    GRADIENT,
    LOSS,
    MATRIX,
    NUM_SUMS,
    levenberg_marquardt,
    retract,
    solve_damped,
)
from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.geometry.sphere import CHANCE_CORRELATION, NUM_BLOCKS
from piccolo.optimize import channel_loss
from piccolo.photo.panorama.texels import pack_texels

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
    sums = np.empty(NUM_SUMS)
    texels = pack_texels(rgb, is_valid)
    arguments = channel_loss.ChannelProblem(points, levels, weights, texels.rgbx, texels.width, SCALE)
    channel_loss.channel_equations(arguments, pose.R_cam_from_world, pose.center_world, sums)
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
    assert sums[COUNT_SUM] == 0
    assert sums[LOSS] == pytest.approx(0.25 * SCALE**2 * problem[2].sum(), rel=1e-6)
    assert (sums[GRADIENT:] == 0).all()


def test_moments_of_each_block_are_over_what_both_show():
    arguments, (shown, levels, w, blocks) = _blockwise()
    sums = np.empty((NUM_BLOCKS, channel_loss.NUM_MOMENTS))
    channel_loss.correlate(*arguments, sums)
    a = levels - 127.5
    b = shown - 127.5
    products = np.stack([(a * b).sum(axis=0), (a * a).sum(axis=0), (b * b).sum(axis=0)])
    terms = w * np.concatenate([products, np.ones((1, len(w))), a, b])
    expected = [[term[blocks == block].sum() for term in terms] for block in range(NUM_BLOCKS)]
    np.testing.assert_allclose(sums, expected, rtol=1e-3, atol=0.5)
    np.testing.assert_allclose(sums[:, 3], np.array(expected)[:, 3], rtol=1e-5)
    np.testing.assert_allclose(sums[:, 4:], np.array(expected)[:, 4:], atol=2e-3)
    assert 0.5 < sums[:, 3].sum() < 0.9


def test_a_pose_scores_what_its_blocks_correlate_beyond_chance():
    """Channels around their means over the block."""
    arguments, of_twin = _blockwise()
    total = _score(*of_twin)
    assert channel_loss.score(*arguments) == pytest.approx(total, abs=1e-4)
    assert 0.2 < total < 0.7


def test_plain_blocks_do_not_correlate_whatever_their_colours_are():
    """Nor does noise below the least deviation; but an edge as strong as it does."""
    points, _, weights, rgb = _problem()
    weights = (weights / weights.sum()).astype(np.float32)
    blocks = (np.arange(len(weights)) * NUM_BLOCKS // len(weights)).astype(np.int32)
    plain = np.full_like(rgb, (200, 90, 180))
    step_up = np.where(np.arange(rgb.shape[1])[None, :, None] < rgb.shape[1] // 2, 100, 160).astype(np.uint8)
    step_up = np.ascontiguousarray(np.broadcast_to(step_up, rgb.shape))
    for image, noise, least, most in (
        (plain, 0.0, 0.0, 0.0),
        (plain, 2.0, 0.0, 0.01),
        (step_up, 0.0, 0.9, 1.0),
    ):
        pixels = naive.project(points.T, TILTED.R_cam_from_world, TILTED.center_world, rgb.shape[1])
        levels = naive.sample(image, pixels).T
        levels = levels + noise * np.random.default_rng(1).normal(size=levels.shape)
        texels = pack_texels(image)
        how = texels.rgbx, texels.width, TILTED.R_cam_from_world, TILTED.center_world
        found = channel_loss.score(points, levels.astype(np.float32), weights, blocks, *how)
        assert least <= found <= most + 1e-6
        w = weights.astype(float)
        assert found == pytest.approx(_score(naive.sample(image, pixels).T, levels, w, blocks), abs=1e-4)


def _blockwise():
    """Arguments of `score` whose blocks correlate more or less, and those of its twin."""
    points, levels, weights, rgb = _problem()
    is_valid = np.ones(rgb.shape[:2], dtype=bool)
    is_valid[:20] = False
    pixels = naive.project(points.T, TILTED.R_cam_from_world, TILTED.center_world, rgb.shape[1])
    shown = naive.sample(rgb, pixels).T
    noise = np.linspace(0, 200, points.shape[1]).astype(np.float32)
    levels = np.clip(shown + noise * (levels - 130) / 70, 0, 255).astype(np.float32)
    w = weights * (naive.sample(is_valid[..., None], pixels)[:, 0] > 1 - 1e-9) / weights.sum()
    blocks = (np.arange(points.shape[1]) * NUM_BLOCKS // points.shape[1]).astype(np.int32)
    texels = pack_texels(rgb, is_valid)
    how = texels.rgbx, texels.width, TILTED.R_cam_from_world, TILTED.center_world
    arguments = points, levels, (weights / weights.sum()).astype(np.float32), blocks, *how
    return arguments, (shown, levels, w, blocks)


def _score(shown, levels, weights, blocks):
    """Score by NumPy: covariances of each block around its weighted means."""
    total = 0.0
    for block in np.unique(blocks[weights > 0]):
        w = weights[blocks == block]
        a = levels[:, blocks == block]
        b = shown[:, blocks == block]
        a = a - np.average(a, axis=1, weights=w)[:, None]
        b = b - np.average(b, axis=1, weights=w)[:, None]
        variances = [max((w * x * x).sum() / w.sum(), channel_loss.FLAT_BLOCK**2) for x in (a, b)]
        correlation = (w * a * b).sum() / w.sum() / math.sqrt(variances[0] * variances[1])
        total += max(correlation - CHANCE_CORRELATION, 0) / (1 - CHANCE_CORRELATION) * w.sum()
    return total


def test_solver_equals_numpy_and_refuses_a_singular_matrix():
    rng = np.random.default_rng(0)
    J = rng.normal(size=(20, 6))
    A = J.T @ J
    g = rng.normal(size=6)
    delta = np.empty(6)
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
    goal = np.array([1.0, 2.0, 3.0])
    losses = []

    def equations(problem, R, t, sums):
        e = R @ (t - goal)
        is_wall = np.linalg.norm(t - problem) < 0.1
        sums[LOSS] = 100.0 if is_wall else 0.5 * e @ e
        sums[GRADIENT:MATRIX] = [0, 0, 0, *e]
        sums[MATRIX:] = np.diag([1.0] * 6)[np.triu_indices(6)]
        losses.append(sums[LOSS])

    for num_iterations, most in ((3, 7.0), (100, 1e-9)):
        R = np.eye(3)
        t = np.zeros(3)
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

    R = np.eye(3)
    t = np.ones(3)
    assert levenberg_marquardt(equations)(None, 9, 1e-7, R, t) == math.inf
    np.testing.assert_array_equal(calls, [np.ones(3)])
    np.testing.assert_array_equal(R, np.eye(3))
