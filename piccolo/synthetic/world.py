"""Rooms side by side with their scan, and queries with true poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..pose import Array, Pose, exp_so3, yaw_rotation
from ..rotations import uniform_rotations
from ..threads import Workers
from .photo import other_light, photograph
from .room import Room, make_room
from .scan import free_position, scan_room

VARIANTS = ("clean", "tilt", "photo", "change")
GAP = 0.4  # between rooms [m]
MIN_SIZE = (2.0, 2.0, 2.0)
MAX_ROOMS = 64


@dataclass(frozen=True)
class World:
    """Seeded rooms in a square grid."""

    seed: int
    rooms: tuple[Room, ...]


@dataclass(frozen=True)
class Query:
    """A panorama with the pose at which it was taken."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    pose: Pose
    variant: str


def make_world(seed: int, size: Array, num_rooms: int = 1) -> World:
    """`num_rooms` rooms of `size` (3,) [m], all different."""
    size = np.asarray(size, dtype=float)
    if (size < MIN_SIZE).any():
        raise InputError(f"size: found {size.tolist()}, wanted at least {list(MIN_SIZE)} m")
    if not 1 <= num_rooms <= MAX_ROOMS:
        raise InputError(f"rooms: found {num_rooms}, wanted 1 to {MAX_ROOMS}")
    columns = int(np.ceil(np.sqrt(num_rooms)))
    rooms = []
    for k in range(num_rooms):
        corner = np.array([*((size[:2] + GAP) * divmod(k, columns)), 0.0])
        rooms.append(make_room(seed * MAX_ROOMS + k, size, corner))
    return World(seed, tuple(rooms))


def scan_world(
    world: World, num_points: int, workers: Workers
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points (num_points, 3) [m] and colours (num_points, 3) of all rooms."""
    if num_points < 1000 * len(world.rooms):
        raise InputError(f"points: found {num_points}, wanted at least 1000 a room")
    shares = np.diff(np.linspace(0, num_points, len(world.rooms) + 1).astype(int))
    rng = np.random.default_rng([world.seed, 10])
    parts = [scan_room(room, int(n), rng, workers) for room, n in zip(world.rooms, shares, strict=True)]
    return np.concatenate([p for p, _ in parts]), np.concatenate([c for _, c in parts])


def make_query(world: World, index: int, variant: str, width: int, workers: Workers) -> Query:
    """Query number `index` of a variant: upright but for `tilt`, in a room drawn at random."""
    if variant not in VARIANTS:
        raise InputError(f"variant: found {variant!r}, wanted one of {', '.join(VARIANTS)}")
    if width < 128 or width % 2:
        raise InputError(f"width: found {width}, wanted an even number of at least 128")
    rng = np.random.default_rng([world.seed, 20, VARIANTS.index(variant), index])
    number = int(rng.integers(len(world.rooms)))
    room = world.rooms[number]
    if variant == "change":
        room = make_room(world.seed * MAX_ROOMS + number, room.size, room.corner, changed=index + 1)
    center_world = free_position(room, rng, (1.0, min(1.9, float(room.size[2]) - 0.4)))
    R_cam_from_world = yaw_rotation(rng.uniform(0, 2 * np.pi))
    if variant == "tilt":
        R_cam_from_world = exp_so3(rng.uniform(-1, 1, 3)) @ uniform_rotations(64)[rng.integers(64)]
    pose = Pose(R_cam_from_world, center_world)
    rgb = photograph(room, pose, width, workers)
    return Query(other_light(rgb, rng) if variant == "photo" else rgb, pose, variant)
