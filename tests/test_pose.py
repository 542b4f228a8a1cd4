import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piccolo.errors import InputError
from piccolo.geometry import pose as poses
from piccolo.geometry.nearness import Nearness
from piccolo.geometry.rotations import uniform_yaws
from piccolo.geometry.suppression import non_maximum_suppression

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
        with pytest.raises(InputError, match="file: R is no rotation"):
            poses.check_rotation(wrong, 1e-4, "file: R")


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


def test_kept_poses_are_the_first_of_their_neighbourhood():
    centers = np.array([[0.0, 0, 0], [0.1, 0, 0], [2, 0, 0], [0.1, 0, 0]])
    rotations = np.stack([uniform_yaws(36)[k] for k in (0, 1, 0, 9)])
    assert non_maximum_suppression(rotations, centers, 9, Nearness(0.5, np.radians(20))).tolist() == [0, 2, 3]
    assert non_maximum_suppression(rotations, centers, 2, Nearness(0.5, np.radians(20))).tolist() == [0, 2]
    assert non_maximum_suppression(rotations, centers, 9, Nearness(0.5, np.radians(5))).tolist() == [
        0,
        1,
        2,
        3,
    ]


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
