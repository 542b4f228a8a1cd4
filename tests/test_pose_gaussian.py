"""Poses with their errors: steps, derivatives, and means of which errors in common are no part."""

import math

import numpy as np
import pytest
from poses import tilted_poses

from piccolo.geometry.pose_gaussian import (
    LIKELY,
    PoseGaussian,
    add,
    differentiate,
    mean_of,
    probability_near,
    probability_within,
    subtract,
)

NEAR = np.array([2.0, -1.0, 0.5])
NONE = np.zeros((6, 6))


def covariance(rng, std=0.01):
    """A covariance (6, 6) without symmetries."""
    A = std * rng.normal(size=(6, 6))
    return A @ A.T + std**2 * np.eye(6)


def test_steps_are_added_and_subtracted():
    rng = np.random.default_rng(0)
    for pose in tilted_poses(5, NEAR):
        step = rng.normal(size=6)
        np.testing.assert_allclose(subtract(add(pose, step), pose), step, atol=1e-12)
        other = tilted_poses(6, NEAR)[-1]
        back = add(other, subtract(pose, other))
        np.testing.assert_allclose(back.R_cam_from_world, pose.R_cam_from_world, atol=1e-12)
        np.testing.assert_allclose(back.center_world, pose.center_world, atol=1e-12)


def test_the_derivative_is_that_of_differences():
    *others, pose = tilted_poses(4, NEAR)
    for other_from_cam in others:
        columns = []
        for unit in np.eye(6):
            ahead = other_from_cam @ add(pose, 1e-5 * unit)
            behind = other_from_cam @ add(pose, -1e-5 * unit)
            columns.append(subtract(ahead, behind) / 2e-5)
        np.testing.assert_allclose(differentiate(pose, other_from_cam), np.stack(columns, axis=1), atol=1e-8)


def test_a_pose_on_a_rig_has_the_errors_of_both():
    """Drawn poses of a camera, and of its place on the rig, scatter as it says."""
    rng = np.random.default_rng(1)
    pose, other_from_cam = tilted_poses(2, NEAR)
    own, relative = covariance(rng, 1e-3), covariance(rng, 1e-3)
    attached = PoseGaussian(pose, own, NONE).attach(other_from_cam, relative)
    roots = [np.linalg.cholesky(c) for c in (own, relative)]
    drawn = []
    for _ in range(4000):
        camera = add(pose, roots[0] @ rng.normal(size=6))
        drawn.append(subtract(add(other_from_cam @ camera, roots[1] @ rng.normal(size=6)), attached.pose))
    np.testing.assert_allclose(np.cov(np.array(drawn).T), attached.covariance, atol=2e-6)


def test_the_mean_is_that_of_least_squares():
    rng = np.random.default_rng(3)
    pose, *_ = tilted_poses(1, NEAR)
    first = PoseGaussian(pose, covariance(rng), NONE)
    second = PoseGaussian(add(pose, 0.01 * rng.normal(size=6)), covariance(rng), NONE)
    together = np.linalg.inv(np.linalg.inv(first.own) + np.linalg.inv(second.own))
    expected = add(first.pose, together @ np.linalg.solve(second.own, subtract(second.pose, first.pose)))
    fused = first.fuse(second)
    np.testing.assert_allclose(subtract(fused.pose, expected), 0.0, atol=1e-6)
    np.testing.assert_allclose(fused.own, together, rtol=1e-6, atol=1e-10)


def test_errors_in_common_are_not_averaged_away():
    """Chi square of the mean of many estimates that share an error larger than their own."""
    rng = np.random.default_rng(4)
    pose, *_ = tilted_poses(1, NEAR)
    own = np.diag([1e-8] * 3 + [0.006**2] * 3)
    common = np.diag([1e-8] * 3 + [0.011**2] * 3)
    squares, alone = [], []
    for _ in range(400):
        shared = np.sqrt(np.diag(common)) * rng.normal(size=6)
        found = [
            PoseGaussian(add(pose, shared + np.sqrt(np.diag(own)) * rng.normal(size=6)), own, common)
            for _ in range(2)
        ]
        fused = found[0].fuse(found[1])
        step = subtract(pose, fused.pose)
        squares.append(step @ np.linalg.solve(fused.covariance, step))
        alone.append(found[0].square_distance(found[1]))
    assert np.mean(squares) / 6.0 == pytest.approx(1.0, abs=0.1)
    assert np.mean(alone) / 6.0 == pytest.approx(1.0, abs=0.1), "two estimates differ by their own errors"
    assert fused.largest_std == pytest.approx(math.hypot(0.011, 0.006 / math.sqrt(2.0)), rel=1e-3)


def test_contradictory_poses_leave_a_mean_with_larger_errors():
    pose, *_ = tilted_poses(1, NEAR)
    own = 0.01**2 * np.eye(6)
    here = PoseGaussian(pose, own, NONE)
    there = PoseGaussian(add(pose, np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0])), own, NONE)
    fused = here.fuse(there)
    excess = 0.2**2 / (2.0 * 0.01**2) - LIKELY + 1.0
    assert fused.largest_std == pytest.approx(0.01 * math.sqrt(excess / 2.0))
    assert fused.pose.distance(pose) == pytest.approx(0.1)


def test_means_of_covariances():
    assert not mean_of([]).any()
    np.testing.assert_allclose(mean_of([np.eye(6), 3.0 * np.eye(6)]), 2.0 * np.eye(6))


def test_probabilities_within_a_distance():
    assert probability_within(None) == 1.0
    assert probability_within(0.1) == pytest.approx(0.683, abs=1e-3)
    assert probability_within(0.0) == 1.0
    here = np.zeros(3)
    assert probability_near(here, 0.05**2 * np.eye(3)) == pytest.approx(probability_within(0.05))
    away = np.array([0.2, 0.0, 0.0])
    assert probability_near(away, 0.01**2 * np.eye(3)) < 1e-6
    assert probability_near(away, 0.3**2 * np.eye(3)) < probability_near(here, 0.3**2 * np.eye(3))
