"""A frame of which it is known about where the camera was, and a narrow part of it."""

import functools
from dataclasses import replace

import numpy as np
import rooms

from piccolo.geometry.pose import Pose, exp_so3
from piccolo.together.walk.expectation import ExpectedFrame
from piccolo.together.walk.frames import Motion

SEED = 1


@functools.lru_cache
def seen():
    """A frame's problem in the map of a room, and its true pose there."""
    taken = rooms.query(SEED)
    problem = rooms.ask(rooms.as_panorama(taken.rgb), rooms.scan_map(SEED))
    return problem, rooms.local(SEED, taken.pose)


def off(pose, metres, degrees):
    """A pose so far from another."""
    turn = exp_so3(np.radians(degrees) * np.array([0.0, 0.0, 1.0]))
    return Pose(turn @ pose.R_cam_from_world, pose.center_world + metres * np.array([0.8, 0.6, 0.0]))


def narrow(problem):
    """The problem of a part of the same photo."""
    panorama = rooms.as_panorama(rooms.query(SEED).rgb)
    columns = np.linspace(-0.5, 0.5, panorama.is_valid.shape[1])
    taken = replace(panorama, is_valid=panorama.is_valid & (np.abs(columns) < 0.15))
    return rooms.ask(taken, problem.scan_map)


def expected(last, seconds, pose=None):
    return ExpectedFrame(last, Motion().reach(seconds), pose or last)
