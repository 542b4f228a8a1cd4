"""Photos that a person takes with a phone at one spot: turning around, or on a few steps."""

import math
from collections.abc import Sequence

import numpy as np

from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import Camera
from piccolo.system.arrays import Array, Bytes
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers

from .layout import Room
from .world import change_sensor, free_position, render_picture

HEIGHTS = 1.3, 1.7  # of the phone above the floor [m]
ARM = 0.35  # of the phone from the axis about which the person turns [m]
PAN_SIZE = 12  # photos of a whole turn
BURST_SIZE = 6
BURST_STEP = 0.5  # between two photos of a burst [m]
LEAST_GAP = 0.25  # of the phone from every surface [m]
NUM_DRAWN = 30  # places, of which the one with the most room around is taken
AIM = np.radians([4.0, 8.0, 3.0])  # how far yaw, pitch and roll are off at most [rad]
STEADINESS = 0.02  # of the phone's position, standard deviation [m]
GLANCE = math.radians(20.0)  # to the sides while walking


def draw_pan(room: Room, rng: np.random.Generator) -> list[Pose]:
    """Draw poses of a phone held at arm's length by somebody who turns around once."""
    turns = np.linspace(0.0, 2.0 * math.pi, PAN_SIZE, endpoint=False)
    return draw_open(room, rng, [ARM * head(turn) for turn in turns], turns)


def draw_burst(room: Room, rng: np.random.Generator) -> list[Pose]:
    """Draw poses of a phone held ahead by somebody who walks a few steps."""
    steps = [BURST_STEP * k * head(0.0) for k in range(BURST_SIZE)]
    return draw_open(room, rng, steps, rng.uniform(-GLANCE, GLANCE, BURST_SIZE))


def head(yaw: float) -> Array:
    """Return the level direction (3,) of a yaw [rad]."""
    return np.array([math.cos(yaw), math.sin(yaw), 0.0])


def draw_open(
    room: Room, rng: np.random.Generator, offsets: Sequence[Array], turns: Sequence[float] | Array
) -> list[Pose]:
    """Draw where somebody stands and which way: where most room is left around, as people do.

    The phone is at `offsets` (3,) [m] from there, and looks along `turns` [rad], both about that way.
    """
    ways = rng.uniform(0.0, 2.0 * math.pi, NUM_DRAWN)
    drawn = [free_position(room, rng, HEIGHTS) + np.array(offsets) @ yaw_rotation(way) for way in ways]
    clearances = [min(map(room.clearance, centers)) for centers in drawn]
    best = int(np.argmax(clearances))
    if clearances[best] < LEAST_GAP:
        raise InputError(f"`size`: a room of {room.size.tolist()} m is too full to take photos in it")
    poses = []
    for center_world, turn in zip(drawn[best], turns, strict=True):
        off, pitch, roll = rng.uniform(-AIM, AIM)
        yaw = float(ways[best] + turn + off)
        R_cam_from_world = exp_so3(np.array([roll, pitch, 0.0])) @ yaw_rotation(yaw)
        poses.append(Pose(R_cam_from_world, center_world + rng.normal(0.0, STEADINESS, 3)))
    return poses


def take_photos(
    room: Room, poses: Sequence[Pose], camera: Camera, rng: np.random.Generator, workers: Workers
) -> list[Bytes]:
    """Return the photos (H, W, 3) of one phone at several poses, all processed alike."""
    sensor = int(rng.integers(2**31))
    return [
        change_sensor(render_picture(Mount(camera), room, pose, workers), np.random.default_rng(sensor), rng)
        for pose in poses
    ]
