"""Robust losses: their weights are their derivatives."""

import numpy as np
import pytest

from piccolo.geometry import robust
from piccolo.system.kernels.jit import kernel

SQUARES = np.array([0.3, 2.0, 5.9, 6.1, 40.0, 1e4])


def redescend(square):
    return robust.redescend(square, 6.0)


def geman_mcclure(square):
    return robust.geman_mcclure(square, 1.0 / 6.0)


def absolute(square):
    return np.sqrt(square), robust.weigh_absolute(np.sqrt(square), 1e-3)


@pytest.mark.parametrize("loss", [redescend, geman_mcclure, absolute])
def test_a_weight_is_twice_the_derivative_of_the_loss_by_the_square(loss):
    numbers = [loss(SQUARES + side)[0] for side in (1e-5, -1e-5)]
    np.testing.assert_allclose(loss(SQUARES)[1], (numbers[0] - numbers[1]) / 1e-5, rtol=2e-4, atol=1e-6)


def test_far_residuals_have_a_falling_influence():
    losses, weights = redescend(SQUARES)
    np.testing.assert_allclose(losses[:3], 0.5 * SQUARES[:3])  # up to the limit all counts
    np.testing.assert_allclose(weights[3:], (6.0 / SQUARES[3:]) ** 2)
    for loss in (redescend, geman_mcclure):
        assert loss(SQUARES)[0].max() < 6.0
        np.testing.assert_array_equal([part[0] for part in loss(np.zeros(1))], [0.0, 1.0])
    assert geman_mcclure(np.full(1, 6.0))[1] == 0.25


@kernel
def _write(squares, by_scale, least, found):
    for n in range(len(squares)):
        found[0, n], found[1, n] = robust.inline_geman_mcclure(squares[n], by_scale)
        found[2, n], found[3, n] = robust.inline_absolute(squares[n], least)


def test_kernels_have_the_same_losses_and_weights():
    found = np.empty((4, len(SQUARES)), np.float32)
    _write(SQUARES.astype(np.float32), np.float32(1.0 / 6.0), np.float32(1.0), found)
    lengths = np.sqrt(SQUARES)
    expected = [*geman_mcclure(SQUARES), lengths, robust.weigh_absolute(-lengths, 1.0)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
