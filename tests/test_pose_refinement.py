"""Refinement of a pose by the bearings of its matches."""

import numpy as np
import pytest

from piccolo.geometry.pose import Pose, exp_so3, pose_errors, step
from piccolo.geometry.rotations import random_rotation
from piccolo.local_features.hypotheses import angular_equations, descend_matches
from piccolo.optimize.normal_equations import COUNT, GRADIENT, LOSS, MATRIX, NUM_SUMS

TILTED = Pose(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.2, -0.3, 0.1]))


def _rays(points, pose):
    rays = (points - pose.center_world) @ pose.R_cam_from_world.T
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _matches(rng, pose, num_matches, noise=0.0):
    """Bearings (N, 3) that are off by `noise` [rad], points (N, 3) all around."""
    points = pose.center_world + rng.normal(size=(num_matches, 3)) * 3.0
    rays = _rays(points, pose) + noise * rng.normal(size=(num_matches, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), points


def _sums(problem, pose):
    sums = np.empty(NUM_SUMS)
    angular_equations(problem, pose.R_cam_from_world, pose.center_world, sums)
    return sums


def test_sums_are_those_of_numerical_rows_at_tilted_poses():
    rng, h = np.random.default_rng(0), 1e-5
    for _ in range(5):
        pose = Pose(random_rotation(rng), rng.normal(size=3))
        bearings, points = _matches(rng, pose, 40, noise=0.2)
        scale = 0.3
        sums = _sums((bearings, points, scale), pose)
        moves = np.eye(6) * h
        ends = [(_rays(points, step(pose, m)), _rays(points, step(pose, -m))) for m in moves]
        rows = np.stack([(a - b) / (2.0 * h) for a, b in ends], axis=2)  # (N, 3, 6)
        residuals = _rays(points, pose) - bearings
        square = (residuals**2).sum(axis=1)
        robust = 1.0 / (1.0 + square / scale**2) ** 2
        matrix = np.einsum("n,nij,nik->jk", robust, rows, rows)
        gradient = np.einsum("n,nij,ni->j", robust, rows, residuals)
        assert sums[LOSS] == pytest.approx((0.5 * square / (1.0 + square / scale**2)).sum())
        assert sums[COUNT] == len(points)
        np.testing.assert_allclose(sums[GRADIENT:MATRIX], gradient, atol=1e-7)
        np.testing.assert_allclose(sums[MATRIX:], matrix[np.triu_indices(6)], atol=1e-6)
        losses = [[_sums((bearings, points, scale), step(pose, s * m))[LOSS] for s in (1, -1)] for m in moves]
        np.testing.assert_allclose(sums[GRADIENT:MATRIX], np.diff(losses)[:, 0] / (-2.0 * h), atol=1e-6)


def _refined(matches, start, scale):
    R, center = start.R_cam_from_world.copy(), start.center_world.copy()
    loss = descend_matches((*matches, scale), 30, 1e-7, R, center)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    return Pose(R, center), loss


def _away(rng, pose):
    """A pose 0.3 m and 10 degrees away."""
    turn, move = rng.normal(size=3), rng.normal(size=3)
    turned, moved = np.radians(10.0) * turn / np.linalg.norm(turn), 0.3 * move / np.linalg.norm(move)
    return step(pose, np.concatenate([turned, moved]))


def test_pose_is_found_from_afar():
    rng = np.random.default_rng(1)
    for _ in range(100):
        pose = Pose(random_rotation(rng), rng.normal(size=3) * 5.0)
        found, loss = _refined(_matches(rng, pose, 30), _away(rng, pose), 0.3)
        distance, angle = pose_errors(found, pose)
        assert distance < 1e-5
        assert angle < 1e-5
        assert loss < 1e-9


def test_wrong_matches_hardly_count():
    rng, errors = np.random.default_rng(2), []
    for _ in range(50):
        bearings, points = _matches(rng, TILTED, 80, noise=1e-3)
        wrong = rng.normal(size=(40, 3))
        bearings[:40] = wrong / np.linalg.norm(wrong, axis=1, keepdims=True)
        wide, _ = _refined((bearings, points), _away(rng, TILTED), 0.3)
        narrow, _ = _refined((bearings, points), wide, 0.01)
        errors.append(pose_errors(narrow, TILTED))
    assert np.max(errors, axis=0)[0] < 0.01
    assert np.max(errors, axis=0)[1] < np.radians(0.2)


def test_a_point_at_the_camera_and_too_few_matches_leave_a_finite_pose():
    rng = np.random.default_rng(4)
    bearings, points = _matches(rng, TILTED, 3)
    points[0] = TILTED.center_world
    found, _ = _refined((bearings[:1], points[:1]), TILTED, 0.1)
    assert np.isfinite(found.center_world).all()
    found, _ = _refined((bearings, points), TILTED, 0.1)
    assert np.isfinite(found.R_cam_from_world).all()
