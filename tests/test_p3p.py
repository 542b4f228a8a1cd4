"""Poses from three matches, against the truth, against PoseLib, and where there is none."""

import numpy as np
import poselib
import pytest

from piccolo.geometry.pose import exp_so3
from piccolo.geometry.rotations import random_rotation
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
    return RESTS + rng.normal(size=(3, 3)) * 4.0, random_rotation(rng), center


def _off(found, R, center):
    """How far the nearest of the poses found is off [m + rotation's largest entry]; inf if there is none."""
    pairs = zip(*found, strict=True)
    return min((np.abs(r - R).max() + np.linalg.norm(c - center) for r, c in pairs), default=np.inf)


def test_truth_is_found_and_every_pose_sees_the_points():
    rng, errors = np.random.default_rng(0), []
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
    rng, num_compared = np.random.default_rng(2), 0
    for _ in range(500):
        R, center = random_rotation(rng), RESTS + rng.normal(size=3)
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
