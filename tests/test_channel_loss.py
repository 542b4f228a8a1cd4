"""The loss of the default method: twin, gradient, normal matrix."""

import naive
import numpy as np
import pytest

from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.optimize.channel_loss import channel_equations, correlate, score
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
    arguments = points, levels, weights, texels.rgbx, texels.width, SCALE
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


def test_correlation_is_over_what_both_show():
    points, levels, weights, rgb = _problem()
    is_valid = np.ones(rgb.shape[:2], dtype=bool)
    is_valid[:20] = False
    pixels = naive.project(points.T, TILTED.R_cam_from_world, TILTED.center_world, rgb.shape[1])
    w = weights * (naive.sample(is_valid[..., None], pixels)[:, 0] > 1 - 1e-9)
    a, b = naive.sample(rgb, pixels) - 127.5, levels.T - 127.5
    expected = (w @ (a * b)).sum() / np.sqrt((w @ a**2).sum() * (w @ b**2).sum())
    texels = pack_texels(rgb, is_valid)
    R, center = TILTED.R_cam_from_world, TILTED.center_world
    arguments = points, levels, weights, texels.rgbx, texels.width, R, center
    correlation, shared = correlate(*arguments)
    assert 0.5 < shared / weights.sum() < 0.9
    assert correlation == pytest.approx(expected, abs=1e-4)
    assert shared == pytest.approx(w.sum(), rel=1e-5)
    assert score(*arguments) == pytest.approx(correlation * np.sqrt(shared))
