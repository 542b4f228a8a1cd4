"""Poses from three matches, against the truth, against PoseLib; and refined by the bearings of many."""

import numpy as np
import poselib
import pytest
import rooms

from piccolo.geometry.levenberg_marquardt import COUNT_SUM, GRADIENT, LOSS, MATRIX, NUM_SUMS
from piccolo.geometry.pose import Pose, exp_so3, pose_errors, rotation_from_quaternion_wxyz, step
from piccolo.local_features.hypotheses import angular_equations, descend_matches
from piccolo.local_features.p3p import p3p

NUM_CASES = 5000
RESTS = np.array([3.0, -7.0, 1.5])  # [m] the scene's middle, off the origin


def _rays(points, R, center):
    """Bearings (N, 3) of points (N, 3)."""
    rays = (points - center) @ R.T
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _three(bearings, points):
    rotations, centers = np.full((4, 3, 3), np.nan), np.full((4, 3), np.nan)
    count = p3p(bearings, points, rotations, centers)
    return rotations[:count], centers[:count]


def _case(rng):
    """Points (3, 3) all around a camera, its rotation and center."""
    center = RESTS + rng.normal(size=3) * 3.0
    return RESTS + rng.normal(size=(3, 3)) * 4.0, rotation_from_quaternion_wxyz(rng.normal(size=4)), center


def _off(found, R, center):
    """How far the nearest of the poses found is off [m + rotation's largest entry]; inf if there is none."""
    pairs = zip(*found, strict=True)
    return min((np.abs(r - R).max() + np.linalg.norm(c - center) for r, c in pairs), default=np.inf)


def test_truth_is_found_and_every_pose_sees_the_points():
    rng = np.random.default_rng(0)
    errors = []
    num_behind = 0
    for _ in range(NUM_CASES):
        points, R, center = _case(rng)
        bearings = _rays(points, R, center)
        num_behind += int((bearings @ bearings.T).min() < 0.0)
        found = _three(bearings, points)
        errors.append(_off(found, R, center))
        for rotation, position in zip(*found, strict=True):
            np.testing.assert_allclose(_rays(points, rotation, position), bearings, atol=1e-7)
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
            assert np.linalg.det(rotation) > 0.0
    assert num_behind > 0.25 * NUM_CASES  # angles of more than 90 degrees occur
    assert np.mean(np.array(errors) < 1e-6) >= 0.999
    assert np.median(errors) < 1e-12


def test_poses_are_those_of_poselib_where_all_points_are_in_front():
    rng = np.random.default_rng(2)
    num_compared = 0
    for _ in range(500):
        R = rotation_from_quaternion_wxyz(rng.normal(size=4))
        center = RESTS + rng.normal(size=3)
        points = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], size=(3, 3)) @ R + center
        bearings = _rays(points, R, center)
        _, ours = _three(bearings, points)
        theirs = np.array([-pose.R.T @ pose.t for pose in poselib.p3p(list(bearings), list(points))])
        assert len(ours) == len(theirs)
        for position in theirs:
            assert np.linalg.norm(ours - position, axis=1).min() < 1e-6
        num_compared += len(theirs)
    assert num_compared > 500


def test_scale_and_order_of_the_points_change_nothing():
    rng = np.random.default_rng(3)
    points, R, center = _case(rng)
    bearings = _rays(points, R, center)
    for order in ([1, 2, 0], [2, 1, 0]):
        assert _off(_three(bearings[order], points[order]), R, center) < 1e-9
    for scale in (1e-3, 1e3):
        assert _off(_three(bearings, points * scale), R, center * scale) < 1e-9 * max(scale, 1.0)


POINTS = RESTS + np.array([[2.0, 1.0, 0.5], [-1.0, 2.0, 1.5], [0.5, -3.0, -1.0]])
TILTED = exp_so3(np.array([0.4, -1.1, 0.7]))


def _degenerate_three():
    center, line = RESTS + 0.3, RESTS + np.outer([0.0, 1.0, 3.0], [1.0, 2.0, 0.5])
    rays = _rays(POINTS, TILTED, center)
    return {
        "points on a line": (_rays(line, TILTED, center), line),
        "equal points": (rays, POINTS[[0, 0, 1]]),
        "equal bearings": (rays[[0, 0, 1]], POINTS),
        "all the same": (rays[[0, 0, 0]], POINTS[[0, 0, 0]]),
        "not a number": (rays * np.nan, POINTS),
        "points not a number": (rays, POINTS * np.nan),
        "no such triangle": (np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0]]), POINTS * [[1], [1], [1e6]]),
    }


@pytest.mark.parametrize("name", _degenerate_three())
def test_three_degenerate_matches_have_no_pose(name):
    assert len(_three(*_degenerate_three()[name])[0]) == 0


def test_opposite_bearings_and_a_camera_in_the_plane_of_the_points():
    center = 0.4 * POINTS[0] + 0.6 * POINTS[1]  # between two points, so in the plane of all three
    assert _off(_three(_rays(POINTS, TILTED, center), POINTS), TILTED, center) < 1e-6
    beside = POINTS.mean(axis=0) + 0.2 * (POINTS[0] - POINTS[1])
    assert _off(_three(_rays(POINTS, TILTED, beside), POINTS), TILTED, beside) < 1e-6


def test_symmetric_triangle_seen_from_its_axis():
    """Equal sides and angles: the conics are mirrored, and one of their pencil is degenerate at infinity."""
    angles = np.radians([0.0, 120.0, 240.0])
    points = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    for height in (0.2, 1.0, 5.0):
        center = np.array([0.0, 0.0, height])
        assert _off(_three(_rays(points, TILTED, center), points), TILTED, center) < 1e-6


CAMERA = Pose(TILTED, np.array([0.2, -0.3, 0.1]))


def _rays_at(points, pose):
    return _rays(points, pose.R_cam_from_world, pose.center_world)


def _matches(rng, pose, num_matches, noise=0.0):
    """Bearings (N, 3) that are off by `noise` [rad], points (N, 3) all around."""
    points = pose.center_world + rng.normal(size=(num_matches, 3)) * 3.0
    rays = _rays_at(points, pose) + noise * rng.normal(size=(num_matches, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), points


def _sums(problem, pose):
    sums = np.empty(NUM_SUMS)
    angular_equations(problem, pose.R_cam_from_world, pose.center_world, sums)
    return sums


def test_sums_are_those_of_numerical_rows_at_tilted_poses():
    rng = np.random.default_rng(0)
    h = 1e-5
    for _ in range(5):
        pose = Pose(rotation_from_quaternion_wxyz(rng.normal(size=4)), rng.normal(size=3))
        bearings, points = _matches(rng, pose, 40, noise=0.2)
        scale = 0.3
        sums = _sums((bearings, points, scale), pose)
        moves = np.eye(6) * h
        ends = [(_rays_at(points, step(pose, m)), _rays_at(points, step(pose, -m))) for m in moves]
        rows = np.stack([(a - b) / (2.0 * h) for a, b in ends], axis=2)  # (N, 3, 6)
        residuals = _rays_at(points, pose) - bearings
        square = (residuals**2).sum(axis=1)
        robust = 1.0 / (1.0 + square / scale**2) ** 2
        matrix = np.einsum("n,nij,nik->jk", robust, rows, rows)
        gradient = np.einsum("n,nij,ni->j", robust, rows, residuals)
        assert sums[LOSS] == pytest.approx((0.5 * square / (1.0 + square / scale**2)).sum())
        assert sums[COUNT_SUM] == len(points)
        np.testing.assert_allclose(sums[GRADIENT:MATRIX], gradient, atol=1e-7)
        np.testing.assert_allclose(sums[MATRIX:], matrix[np.triu_indices(6)], atol=1e-6)
        losses = [[_sums((bearings, points, scale), step(pose, s * m))[LOSS] for s in (1, -1)] for m in moves]
        np.testing.assert_allclose(sums[GRADIENT:MATRIX], np.diff(losses)[:, 0] / (-2.0 * h), atol=1e-6)


def _refined(matches, start, scale):
    R = start.R_cam_from_world.copy()
    center = start.center_world.copy()
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
        pose = Pose(rotation_from_quaternion_wxyz(rng.normal(size=4)), rng.normal(size=3) * 5.0)
        found, loss = _refined(_matches(rng, pose, 30), _away(rng, pose), 0.3)
        rooms.assert_near(found, pose, 1e-5, 5e-4)
        assert loss < 1e-9


def test_wrong_matches_hardly_count():
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(50):
        bearings, points = _matches(rng, CAMERA, 80, noise=1e-3)
        wrong = rng.normal(size=(40, 3))
        bearings[:40] = wrong / np.linalg.norm(wrong, axis=1, keepdims=True)
        wide, _ = _refined((bearings, points), _away(rng, CAMERA), 0.3)
        narrow, _ = _refined((bearings, points), wide, 0.01)
        errors.append(pose_errors(narrow, CAMERA))
    assert np.max(errors, axis=0)[0] < 0.01
    assert np.max(errors, axis=0)[1] < np.radians(0.2)


def test_a_point_at_the_camera_and_too_few_matches_leave_a_finite_pose():
    rng = np.random.default_rng(4)
    bearings, points = _matches(rng, CAMERA, 3)
    points[0] = CAMERA.center_world
    found, _ = _refined((bearings[:1], points[:1]), CAMERA, 0.1)
    assert np.isfinite(found.center_world).all()
    found, _ = _refined((bearings, points), CAMERA, 0.1)
    assert np.isfinite(found.R_cam_from_world).all()
