"""Where somebody stands, by the photos that are sure; made up, without a scan."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.together.spot import (
    LEAST_AT_SPOT,
    STEADINESSES,
    Positioned,
    compute_density,
    differentiate_position,
    find_spots,
    fit_spot,
)

TIER = "pure"

AXIS = np.array([30.0, -12.0, 1.5])  # about which somebody turns
OWN_STD = 0.015  # [m] of the positions of sure photos


def _draw(rng, turns, arm, steadiness, axis=AXIS):
    """Poses of somebody who turns with a camera held out, each with its error."""
    poses = []
    for turn in turns:
        wrist = exp_so3(rng.normal(0.0, 0.1, 3) * [1.0, 1.0, 0.0])
        R_cam_from_map = wrist @ yaw_rotation(turn)
        center = axis + np.array([arm, 0.0, 0.0]) @ yaw_rotation(turn)
        poses.append(Pose(R_cam_from_map, center + rng.normal(0.0, steadiness, 3)))
    return poses


def _measure(rng, poses, std=OWN_STD):
    """The poses as photos tell them."""
    errors = np.diag(np.repeat([1e-4, std**2], 3))
    return [
        PoseGaussian(
            Pose(one.R_cam_from_world, one.center_world + rng.normal(0.0, std, 3)), errors, np.zeros((6, 6))
        )
        for one in poses
    ]


@pytest.mark.parametrize("arm", [0.0, 0.35, 0.6])
def test_photos_of_a_turn_tell_where_another_was_taken(arm):
    """Half of a turn tells the other half, to a few centimetres; the deviation is told about right."""
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        turns = rng.uniform(0.0, math.tau, 13)
        *sure, asked = _draw(rng, turns, arm, 0.03)
        center, covariance = fit_spot(_measure(rng, sure)).place(asked.R_cam_from_world)
        offset = asked.center_world - center
        squares.append(float(offset @ np.linalg.solve(covariance, offset)) / 3.0)
        assert math.sqrt(np.linalg.eigvalsh(covariance)[-1]) < 0.09
    assert 0.6 < np.mean(squares) < 1.5


def test_who_is_unsteady_or_walks_some_steps_tells_less():
    rng = np.random.default_rng(5)
    turns = rng.uniform(0.0, math.tau, 8)
    stds = []
    for steadiness in (0.02, 0.1, 0.5):
        sure = _measure(rng, _draw(rng, turns, 0.35, steadiness))
        stds.append(math.sqrt(np.trace(fit_spot(sure).place(np.eye(3)).covariance) / 3.0))
    assert 0.02 < stds[0] < 0.06
    assert 0.08 < stds[1] < 0.2
    assert stds[2] > 0.4


def test_few_photos_tell_little():
    """Three positions may be near each other by chance: what is told is much wider than what they differ."""
    rng = np.random.default_rng(3)
    poses = _draw(rng, (0.3, 0.9, 1.4, 2.2, 3.0, 4.1, 5.0, 5.9), 0.0, 0.01)
    widths = [
        np.trace(fit_spot(_measure(rng, poses[:count])).place(yaw_rotation(3.3)).covariance)
        for count in (3, 5, 8)
    ]
    assert widths[0] > 4.0 * widths[2]
    assert widths[0] > widths[1] > widths[2]


def test_a_photo_that_is_not_exact_counts_less():
    rng = np.random.default_rng(8)
    sure = _measure(rng, _draw(rng, np.linspace(0.0, 6.0, 8), 0.0, 0.01))
    far = sure[3].pose.center_world + np.array([0.5, 0.0, 0.0])
    off = Pose(sure[3].pose.R_cam_from_world, far)
    loose = PoseGaussian(off, np.diag(np.repeat([1e-4, 1.0], 3)), np.zeros((6, 6)))
    place = fit_spot([*sure[:3], loose, *sure[4:]]).place(np.eye(3))
    assert np.linalg.norm(place.center - AXIS) < 0.03
    assert math.sqrt(np.trace(place.covariance)) < 0.12


def test_photos_far_apart_are_of_several_spots_and_few_of_none():
    rng = np.random.default_rng(1)
    here = _measure(rng, _draw(rng, np.linspace(0.0, 5.0, 5), 0.3, 0.02))
    there = _measure(rng, _draw(rng, np.linspace(0.0, 5.0, 4), 0.3, 0.02, AXIS + 4.0))
    spots = find_spots([here[0], there[0], *here[1:], *there[1:]])
    centers = [spot.place(np.eye(3)).center for spot in spots]
    assert len(spots) == 2
    assert np.linalg.norm(centers[1] - centers[0] - 4.0) < 0.2
    assert find_spots(here[: LEAST_AT_SPOT - 1]) == []
    assert len(find_spots([*here[:LEAST_AT_SPOT], there[0]])) == 1


def test_who_walks_a_step_at_a_time_is_at_one_spot():
    """Each photo is near another, the first and the last are not."""
    rng = np.random.default_rng(2)
    photos = [_measure(rng, _draw(rng, [0.1], 0.0, 0.01, AXIS + 0.5 * k))[0] for k in range(4)]
    assert len(find_spots(photos)) == 1
    assert len(find_spots([photos[2], photos[0], photos[3], photos[1]])) == 1


def test_moving_the_world_moves_the_spot():
    rng = np.random.default_rng(4)
    sure = _measure(rng, _draw(rng, np.linspace(0.0, 5.0, 6), 0.4, 0.05))
    R = yaw_rotation(0.7)
    move = np.array([100.0, -40.0, 3.0])

    def moved(pose):
        return Pose(pose.R_cam_from_world @ R.T, R @ pose.center_world + move)

    turned = [PoseGaussian(moved(one.pose), one.own, one.common) for one in sure]
    asked = yaw_rotation(2.0)
    before = fit_spot(sure).place(asked)
    after = fit_spot(turned).place(asked @ R.T)
    np.testing.assert_allclose(after.center, R @ before.center + move, atol=1e-4)
    np.testing.assert_allclose(after.covariance, R @ before.covariance @ R.T, atol=1e-6)


def test_density_is_that_of_a_gaussian():
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, -0.02], [0.0, -0.02, 0.05]])
    point = AXIS + np.array([0.1, -0.2, 0.05])
    expected = multivariate_normal(AXIS, covariance).pdf(point)
    assert compute_density(Positioned(AXIS, covariance), point) == pytest.approx(expected)


@pytest.mark.parametrize("pitch_deg", [0.0, -40.0, -85.0, 70.0])
def test_the_arm_turns_with_the_heading_and_stays_level(pitch_deg):
    """Whatever the wrist does, also if the camera looks at the floor or the ceiling."""
    wrist = exp_so3(np.array([0.0, np.radians(pitch_deg), 0.0]))
    A = differentiate_position(wrist @ yaw_rotation(0.9))
    np.testing.assert_allclose(A[:, 3:].T, yaw_rotation(0.9)[:2], atol=1e-12)
    np.testing.assert_array_equal(A[:, :3], np.eye(3))


def _walk(rng, count):
    """Poses of somebody who walks straight on and looks a little around, half a metre apart; and the way."""
    heading = rng.uniform(0.0, math.tau)
    way = np.array([math.cos(heading), math.sin(heading), 0.0])
    poses = []
    for k in range(count):
        center = AXIS + 0.5 * k * way + rng.normal(0.0, 0.02, 3)
        poses.append(Pose(yaw_rotation(heading + rng.uniform(-0.35, 0.35)), center))
    return poses, way


def test_who_walks_straight_on_is_expected_on_that_way():
    """How far along is not told; how far beside is, to a few centimetres, about right."""
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        poses, way = _walk(rng, 6)
        *sure, asked = (poses[k] for k in rng.permutation(6)[:5])
        center, covariance = fit_spot(_measure(rng, sure)).place(asked.R_cam_from_world)
        beside = np.array([-way[1], way[0], 0.0])
        offset = asked.center_world - center
        squares.append(float(offset @ np.linalg.solve(covariance, offset)) / 3.0)
        assert math.sqrt(beside @ covariance @ beside) < 0.2
        assert math.sqrt(way @ covariance @ way) > 0.5
    assert 0.4 < np.mean(squares) < 1.3


def test_a_pose_is_attracted_across_the_way_and_hardly_along_it():
    """Of who walks; who stands attracts it from all sides."""
    rng = np.random.default_rng(9)
    poses, way = _walk(rng, 6)
    beside = np.array([-way[1], way[0], 0.0])
    on_way = AXIS + 1.2 * way
    walking = fit_spot(_measure(rng, poses))
    attracted = walking.attract(poses[0].R_cam_from_world, on_way + 0.3 * beside)
    assert abs((attracted.center_world - on_way) @ beside) < 0.06
    assert abs((attracted.center_world - on_way) @ way) < 0.12
    np.testing.assert_array_equal(attracted.R_cam_from_world, poses[0].R_cam_from_world)
    standing = fit_spot(_measure(rng, _draw(rng, np.linspace(0.0, 6.0, 8), 0.0, 0.01)))
    assert np.linalg.norm(standing.attract(np.eye(3), AXIS + 0.3).center_world - AXIS) < 0.06


def test_nobody_stands_steadier_than_hands_hold_a_phone():
    """Photos that agree by chance would else tell the other side of a turn too exactly."""
    turns = np.linspace(0.0, 2.0, 7)
    rng = np.random.default_rng(1)
    exact = _measure(rng, _draw(rng, turns, 0.35, 0.0), 0.001)
    expected = fit_spot(exact).place(exact[3].pose.R_cam_from_world)
    stds = np.sqrt(np.diag(expected.covariance))
    assert stds == pytest.approx([STEADINESSES[0]] * 3, rel=0.25)
