"""Poses, and poses with errors."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from poses import covariance, tilted_poses
from refusals import assert_input_error

from piccolo.geometry import pose as poses
from piccolo.geometry.nearness import ROOM_RANGE, Nearness, non_maximum_suppression
from piccolo.geometry.pose import uniform_yaws
from piccolo.geometry.pose_gaussian import (
    LIKELY,
    PoseGaussian,
    add,
    differentiate,
    differentiate_rays,
    mean_of,
    subtract,
)

VECTORS = [np.zeros(3), np.array([1e-9, 0, 0]), np.array([0.3, -0.2, 0.9]), np.array([0.0, 3.14159, 0.0])]

DIRECTIONS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda d: np.linalg.norm(d) > 1e-3)


@pytest.mark.parametrize("w", VECTORS)
def test_exponential_is_a_rotation_by_the_norm(w):
    R = poses.exp_so3(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert poses.angle_between(R, np.eye(3)) == pytest.approx(np.linalg.norm(w), abs=1e-12)
    np.testing.assert_allclose(R @ w, w, atol=1e-12)


def test_conventions_of_turns_steps_quaternions_and_matrices():
    np.testing.assert_allclose(poses.exp_so3(np.array([0, 0, np.pi / 2])) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    start = poses.Pose(poses.yaw_rotation(np.pi / 2), np.array([1.0, 2.0, 3.0]))
    moved = poses.step(start, np.array([0, 0, 0.1, 0.5, 0, 0]))
    np.testing.assert_allclose(moved.center_world, [1.0, 2.5, 3.0], atol=1e-12)  # forward is +y in the world
    assert poses.angle_between(moved.R_cam_from_world, start.R_cam_from_world) == pytest.approx(0.1)
    q = poses.quaternion_wxyz(poses.exp_so3(np.array([0.0, 0.0, np.pi / 2])))
    np.testing.assert_allclose(q, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
    pose = poses.Pose(poses.exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.3, -0.2, 1.5]))
    x_world = np.array([2.0, 1.0, 0.5])
    x_cam = pose.R_cam_from_world @ (x_world - pose.center_world)
    np.testing.assert_allclose((pose.T_world_from_cam @ [*x_cam, 1.0])[:3], x_world, atol=1e-12)
    yaw = 0.7
    forward = poses.yaw_rotation(yaw).T @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(forward, [np.cos(yaw), np.sin(yaw), 0.0], atol=1e-12)


def test_products_are_sums_in_order_on_all_processors():
    """No product is added before it is rounded, as BLAS does on some."""
    rng = np.random.default_rng(3)
    one, other = rng.normal(size=(2, 4, 3, 3))
    for a, b, product in zip(one, other, poses.multiply(one, other), strict=True):
        expected = [[x * b[0, k] + y * b[1, k] + z * b[2, k] for k in range(3)] for x, y, z in a]
        np.testing.assert_array_equal(product, expected)
        np.testing.assert_array_equal(poses.rotate_vector(a, b[:, 1]), product[:, 1])


@pytest.mark.parametrize("w", VECTORS)
def test_left_jacobian_against_central_differences(w):
    for axis in range(3):
        dw = 1e-6 * np.eye(3)[axis]
        turn = poses.exp_so3(w + dw) @ poses.exp_so3(w - dw).T
        vee = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        np.testing.assert_allclose(vee / 2e-6, poses.left_jacobian(w)[:, axis], atol=2e-5)


def test_step_is_the_derivative_that_the_kernels_use():
    start = poses.Pose(poses.exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.3, -0.2, 1.5]))
    x_world = np.array([2.0, 1.0, 0.5])
    p = start.R_cam_from_world @ (x_world - start.center_world)
    delta = np.array([1e-7, -2e-7, 3e-7, 2e-7, 1e-7, -1e-7])
    moved = poses.step(start, delta)
    dp = moved.R_cam_from_world @ (x_world - moved.center_world) - p
    np.testing.assert_allclose(dp, np.cross(delta[:3], p) - delta[3:], atol=1e-12)


@pytest.mark.parametrize("w", VECTORS)
def test_quaternion_round_trip(w):
    R = poses.exp_so3(w)
    q = poses.quaternion_wxyz(R)
    assert q[0] >= 0
    np.testing.assert_allclose(poses.rotation_from_quaternion_wxyz(q), R, atol=1e-9)


def test_orthonormal_repairs_drift():
    R = poses.exp_so3(np.array([0.4, -1.1, 0.7]))
    np.testing.assert_allclose(poses.orthonormal(R * 1.001), R, atol=1e-12)
    rough = R + np.random.default_rng(1).normal(0.0, 0.02, (3, 3))
    U, _, Vt = np.linalg.svd(rough)
    np.testing.assert_allclose(poses.orthonormal(rough), U @ Vt, atol=1e-12)


def test_rotations_are_checked_to_a_tolerance():
    R = poses.exp_so3(VECTORS[2])
    poses.check_rotation(R + 4e-4, 1e-2, "R")
    assert poses.check_rotation(R, 1e-12, "R") is R
    for wrong in (R + 4e-4, R[::-1], np.full((3, 3), np.nan), R * 1e300, R[0], np.eye(4)):
        assert_input_error("file: R is no rotation", poses.check_rotation, wrong, 1e-4, "file: R")


@given(DIRECTIONS)
def test_rotation_takes_the_direction_to_z_by_the_smallest_turn(direction):
    direction = np.array(direction) / np.linalg.norm(direction)
    R = poses.rotation_to_z(direction)
    np.testing.assert_allclose(R @ direction, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    smallest = np.arctan2(np.hypot(*direction[:2]), direction[2])
    assert poses.angle_between(R, np.eye(3)) == pytest.approx(smallest, abs=1e-7)


@pytest.mark.parametrize("tiny", [0.0, 1e-300, 1e-12])
def test_rotation_near_the_poles(tiny):
    np.testing.assert_allclose(poses.rotation_to_z(np.array([tiny, 0.0, 1.0])), np.eye(3), atol=2e-12)
    R = poses.rotation_to_z(np.array([tiny, tiny, -1.0]))
    np.testing.assert_allclose(R @ [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], atol=2e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_limits_of_distances_grow_beyond_rooms_with_what_is_seen():
    limits = Nearness(0.3, 0.1)
    assert limits.at(0.5 * ROOM_RANGE) == limits.at(ROOM_RANGE) == limits
    assert limits.at(3.0 * ROOM_RANGE) == (pytest.approx(0.9), 0.1)


def test_kept_poses_are_the_first_of_their_neighbourhood():
    centers = np.array([[0.0, 0, 0], [0.1, 0, 0], [2, 0, 0], [0.1, 0, 0]])
    rotations = np.stack([uniform_yaws(36)[k] for k in (0, 1, 0, 9)])
    assert non_maximum_suppression(rotations, centers, 9, Nearness(0.5, np.radians(20))).tolist() == [0, 2, 3]
    assert non_maximum_suppression(rotations, centers, 2, Nearness(0.5, np.radians(20))).tolist() == [0, 2]
    found = non_maximum_suppression(rotations, centers, 9, Nearness(0.5, np.radians(5)))
    assert found.tolist() == [0, 1, 2, 3]


def test_poses_are_a_group_and_act_on_points():
    """Names cancel: (c_from_b @ b_from_w) maps a point as b_from_w does, then as c_from_b."""
    rng = np.random.default_rng(0)
    a, b, c = (poses.Pose(poses.exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(3))
    identity = poses.Pose(np.eye(3), np.zeros(3))

    def matrix(pose):
        return pose.T_world_from_cam

    np.testing.assert_allclose(matrix((a @ b) @ c), matrix(a @ (b @ c)), atol=1e-12)
    np.testing.assert_allclose(matrix(a @ a.inverse()), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(matrix(a.inverse() @ a), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(matrix((a @ b).inverse()), matrix(b.inverse() @ a.inverse()), atol=1e-12)
    np.testing.assert_array_equal(matrix(a @ identity), matrix(a))
    np.testing.assert_allclose(matrix(a @ b), matrix(b) @ matrix(a), atol=1e-12)
    x = rng.normal(size=3)
    in_b = b.R_cam_from_world @ (x - b.center_world)
    in_c = a.R_cam_from_world @ (in_b - a.center_world)
    both = a @ b
    np.testing.assert_allclose(both.R_cam_from_world @ (x - both.center_world), in_c, atol=1e-12)
    turned = poses.rotation_from_quaternion_wxyz(a.quaternion_wxyz)
    np.testing.assert_allclose(turned, a.R_cam_from_world, atol=1e-12)


NEAR = np.array([2.0, -1.0, 0.5])
NONE = np.zeros((6, 6))


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


def test_rays_to_points_follow_the_pose_as_differences_say():
    points = np.random.default_rng(2).normal(size=(20, 3)) * 4.0
    for pose in tilted_poses(3, NEAR):
        rays, J = differentiate_rays(points, pose)
        offsets = (points - pose.center_world) @ pose.R_cam_from_world.T
        np.testing.assert_allclose(rays * np.linalg.norm(offsets, axis=1, keepdims=True), offsets)
        for k, h in enumerate(1e-6 * np.eye(6)):
            after = differentiate_rays(points, add(pose, h))[0]
            before = differentiate_rays(points, add(pose, -h))[0]
            np.testing.assert_allclose(J[..., k], (after - before) / 2e-6, atol=1e-8)


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
    squares = []
    alone = []
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
