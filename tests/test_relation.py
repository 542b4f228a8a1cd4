"""The pose of a photo by its matches with others, and how far it may be off."""

import numpy as np
import pytest

from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian, add, subtract
from piccolo.local_features.matching import NO_MATCHES
from piccolo.together.relation import compute_information, compute_match_loss, list_weak_steps, relate

TRUE = Pose(yaw_rotation(0.4), np.array([1.0, -2.0, 1.5]))


def _matches_of_wall(rng, count, noise, depth_noise):
    """Matches with points of a wall 3 m ahead, whose rays [rad] and ranges (a part of them) have errors."""
    ahead = np.column_stack([np.full(count, 3.0), rng.uniform(-1.5, 1.5, (count, 2))])
    ranges = np.linalg.norm(ahead, axis=1)
    rays = ahead / ranges[:, None]
    points = TRUE.center_world + (1.0 + depth_noise * rng.normal(size=(count, 1))) * (
        ahead @ TRUE.R_cam_from_world
    )
    found = rays + noise * rng.normal(size=rays.shape)
    found /= np.linalg.norm(found, axis=1)[:, None]
    tangents = np.cross(found, [0.3, 0.4, 0.5])
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    return NO_MATCHES._replace(
        query=np.arange(count, dtype=np.int32),
        rays=np.float32(found),
        ray_tangents=np.float32(tangents),
        angles=np.full(count, 0.1, np.float32),
        points=np.float32(points),
        tangents=np.float32(tangents @ TRUE.R_cam_from_world),
        sizes=np.float32(0.1 * ranges),
    )


@pytest.mark.parametrize("count", [8, 40])
def test_errors_of_matches_with_a_wall_are_not_told_too_small(count):
    """Some of the ranges are wrong, as at edges: of 6 dimensions the mean square is at most 1.5 times 6."""
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        matches = _matches_of_wall(rng, count, 2e-3, 0.03)
        found = relate(matches, add(TRUE, rng.normal(0.0, [0.003] * 3 + [0.02] * 3)))
        step = subtract(TRUE, found.pose)
        squares.append(step @ np.linalg.solve(found.covariance, step) / 6.0)
    assert 0.02 < np.mean(squares) < 1.5


def test_exact_matches_give_the_pose_from_a_start_beside_it():
    matches = _matches_of_wall(np.random.default_rng(0), 40, 0.0, 0.0)
    near = Pose(exp_so3(np.array([0.0, 0.004, 0.003])) @ TRUE.R_cam_from_world, TRUE.center_world + 0.01)
    found = relate(matches, near)
    assert found.pose.distance(TRUE) < 1e-3
    assert compute_match_loss(matches, found.pose) < 1e-3 < compute_match_loss(matches, near)


def test_weak_steps_of_a_wall_move_along_it_and_turn_back():
    """Both ways, so that what lies ahead stays where it is seen."""
    matches = _matches_of_wall(np.random.default_rng(0), 40, 0.0, 0.0)
    steps = np.array(list_weak_steps(compute_information(matches, TRUE)))
    assert np.allclose(steps[::2], -steps[1::2])
    along = (steps[:, 3:] @ TRUE.R_cam_from_world.T)[:, 1:]
    assert (np.linalg.norm(along, axis=1) > 0.8 * np.linalg.norm(steps[:, 3:], axis=1)).all()
    middle = np.array([3.0, 0.0, 0.0])
    for step in steps:
        moved = add(TRUE, step)
        ahead = moved.R_cam_from_world @ (
            TRUE.center_world + middle @ TRUE.R_cam_from_world - moved.center_world
        )
        assert np.linalg.norm(ahead / np.linalg.norm(ahead) - [1.0, 0.0, 0.0]) < 0.05


def test_a_mean_trusts_the_pose_that_errors_in_common_make_less_uncertain():
    """That of a bare wall has metres of error along it by the scan; equal errors in common change nothing."""
    own = np.diag([1e-6] * 3 + [0.02**2] * 3)
    small = np.diag([1e-8] * 3 + [0.005**2] * 3)
    sharp = PoseGaussian(TRUE, own, small)
    off = add(TRUE, np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    vague = PoseGaussian(off, own, np.diag([1e-8] * 3 + [2.0**2, 0.005**2, 0.005**2]))
    fused = sharp.fuse(vague)
    assert fused.pose.distance(TRUE) < 1e-3
    assert np.sqrt(fused.covariance[3, 3]) < 0.025
    assert sharp.square_distance(vague) < 0.1
    alike = sharp.fuse(PoseGaussian(off, own, small))
    assert alike.pose.distance(TRUE) == pytest.approx(0.25)
