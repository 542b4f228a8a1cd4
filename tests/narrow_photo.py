"""A narrow photo of a dense room, and one taken beside it."""

import functools

import numpy as np
import rooms

from piccolo.evidence import verification
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.photo.panorama import Panorama
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import change_light, mask_outside_field, photograph

NUM_POINTS = 200_000
WIDTH = 1024


def take(seed=1, yaw=1.0):
    """A level photo of 70 degrees that looks along an azimuth, and its true pose in the world."""
    taken = rooms.query(seed, width=WIDTH)
    return Panorama(taken.rgb, ~mask_outside_field(WIDTH, 70.0, yaw)), taken.pose


@functools.lru_cache
def problem():
    return rooms.ask(take()[0], rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN)


@functools.lru_cache
def true_pose():
    return rooms.local(1, take()[1], NUM_POINTS)


@functools.lru_cache
def beside():
    """The keypoints of a photo taken half a metre beside, with other noise and light, at its true pose."""
    world = rooms.room(1, NUM_POINTS)[0]
    here = take()[1]
    pose = Pose(yaw_rotation(0.1) @ here.R_cam_from_world, here.center_world + np.array([0.3, 0.4, 0.0]))
    rng = np.random.default_rng(0)
    rgb = change_light(photograph(world.rooms[0], pose, WIDTH, Workers(2)), rng, rng)
    panorama = Panorama(rgb, take()[0].is_valid)
    other = rooms.ask(panorama, rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN)
    return verification.place_keypoints(other, rooms.local(1, pose, NUM_POINTS), rooms.WORKERS)
