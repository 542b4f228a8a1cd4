"""A photo turned at a known position."""

import functools
import math

import numpy as np
import pytest
import rooms

from piccolo.evidence.blocks import fill_symmetric
from piccolo.evidence.covariance import make_problem
from piccolo.geometry.levenberg_marquardt import GRADIENT, LOSS, MATRIX, NUM_SUMS
from piccolo.geometry.pose import Pose, angle_between, exp_so3
from piccolo.localization.turning import turn, turn_equations, turn_roughly
from piccolo.optimize.channel_loss import channel_equations

TIER = "scene"

SEED = 2


@functools.lru_cache
def _narrow():
    """A photo of 65 degrees as it is asked for in the map, and its true pose there."""
    ((panorama, pose),) = rooms.take_photos(SEED, 65.0, {3.0: (0.1, 0.2, 0.1)}, 1024)
    scan_map = rooms.scan_map(SEED)
    return rooms.ask(panorama, scan_map, rooms.KNOWN), scan_map.from_world(pose)


def test_only_turns_are_asked_for():
    """Loss, gradient and matrix of turns are those of the descents of a whole pose; the rest asks nothing."""
    problem, true_pose = _narrow()
    asked = make_problem(
        problem.view_at(true_pose, "points").around(true_pose.center_world), problem.photo.image("fine")
    )
    R = exp_so3(np.array([0.01, -0.02, 0.015])) @ true_pose.R_cam_from_world
    whole, turns = np.empty((2, NUM_SUMS))
    channel_equations(asked, R, np.array([0.02, 0.01, -0.03]), whole)
    turn_equations(asked, R, np.array([0.02, 0.01, -0.03]), turns)
    assert turns[LOSS] == whole[LOSS]
    np.testing.assert_array_equal(turns[GRADIENT : GRADIENT + 3], whole[GRADIENT : GRADIENT + 3])
    assert not turns[GRADIENT + 3 : MATRIX].any()
    of_turns, of_whole = (fill_symmetric(sums[MATRIX:]) for sums in (turns, whole))
    np.testing.assert_array_equal(of_turns[:3, :3], of_whole[:3, :3])
    np.testing.assert_array_equal(of_turns[3:], np.eye(6)[3:])
    assert of_whole[:3, 3:].all()


@pytest.mark.parametrize("off_deg", [(0.0, 0.0, 4.0), (3.0, -2.0, 1.0)])
def test_a_photo_turns_to_where_it_fits_and_stays_where_it_is(off_deg):
    problem, true_pose = _narrow()
    start = Pose(exp_so3(np.radians(off_deg)) @ true_pose.R_cam_from_world, true_pose.center_world)
    end = turn(problem, start)
    angle = math.degrees(angle_between(end.R_cam_from_world, true_pose.R_cam_from_world))
    assert angle < 0.3
    np.testing.assert_array_equal(end.center_world, true_pose.center_world)


def test_a_photo_turns_roughly_from_far_away():
    """From any rotation of the search, of which the nearest may be ten degrees off."""
    problem, true_pose = _narrow()
    starts = [
        Pose(exp_so3(np.radians(off_deg)) @ true_pose.R_cam_from_world, true_pose.center_world)
        for off_deg in ((0.0, 4.0, 8.0), (100.0, 0.0, 60.0))
    ]
    near, wrong = (turn_roughly(problem, start) for start in starts)
    angle = math.degrees(angle_between(near.pose.R_cam_from_world, true_pose.R_cam_from_world))
    assert angle < 1.5
    assert near.score > 3.0 * wrong.score
    np.testing.assert_array_equal(near.pose.center_world, true_pose.center_world)
