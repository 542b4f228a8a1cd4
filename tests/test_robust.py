"""Robust losses: their weights are their derivatives."""

import numpy as np
import pytest

from piccolo.geometry import robust

SQUARES = np.array([0.3, 2.0, 5.9, 6.1, 40.0, 1e4])


def redescend(square):
    return robust.redescend(square, 6.0)


@pytest.mark.parametrize("loss", [redescend])
def test_a_weight_is_twice_the_derivative_of_the_loss_by_the_square(loss):
    numbers = [(loss(SQUARES + side)[0]) for side in (1e-5, -1e-5)]
    np.testing.assert_allclose(loss(SQUARES)[1], (numbers[0] - numbers[1]) / 1e-5, rtol=2e-4, atol=1e-6)
    np.testing.assert_array_equal([part[0] for part in loss(np.zeros(1))], [0.0, 1.0])


def test_far_residuals_have_a_falling_influence():
    losses, weights = redescend(SQUARES)
    np.testing.assert_allclose(losses[:3], 0.5 * SQUARES[:3])  # up to the limit all counts
    np.testing.assert_allclose(weights[3:], (6.0 / SQUARES[3:]) ** 2)
    assert losses.max() < 6.0
