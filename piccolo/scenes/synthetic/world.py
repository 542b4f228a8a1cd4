"""Rooms side by side with their scan, and queries with true poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...geometry.pose import Array, Pose, exp_so3, yaw_rotation
from ...geometry.rotations import uniform_rotations
from ...runtime.threads import Workers
from .room import Room, make_room
from .sensors import free_position, label_image, other_light, photograph, scan_room

VARIANTS = ("clean", "tilt", "photo", "change")
GAP = 0.4  # between rooms [m]
MIN_SIZE, MAX_SIZE = 2.0, 50.0  # of a room, each way [m]
MAX_ROOMS = 64
MIN_POINTS = 1000  # of a room


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
    if not ((size >= MIN_SIZE) & (size <= MAX_SIZE)).all():  # so that NaN is refused too
        raise InputError(f"size: {size.tolist()} is not between {MIN_SIZE} and {MAX_SIZE} m each way")
    if not 1 <= num_rooms <= MAX_ROOMS:
        raise InputError(f"rooms: {num_rooms} is not between 1 and {MAX_ROOMS}")
    columns = int(np.ceil(np.sqrt(num_rooms)))
    rooms = []
    for k in range(num_rooms):
        corner = np.array([*((size[:2] + GAP) * divmod(k, columns)), 0.0])
        rooms.append(make_room(seed * MAX_ROOMS + k, size, corner))
    return World(seed, tuple(rooms))


def random_size(rng: np.random.Generator) -> Array:
    """Size (3,) of a room [m], from a box room to a hall."""
    return rng.uniform([3.5, 3.0, 2.3], [9.0, 7.0, 3.4])


def check_num_points(world: World, num_points: int) -> None:
    """Refuse, before any work is done, a scan too sparse to show the rooms."""
    if num_points < MIN_POINTS * len(world.rooms):
        raise InputError(f"points: {num_points} are too few, use at least {MIN_POINTS} a room")


def check_width(width: int) -> None:
    """Refuse, before any work is done, a panorama too small or of an odd width [px]."""
    if width < 128 or width % 2:
        raise InputError(f"width: {width} is not an even number of at least 128")


def scan_world(
    world: World, num_points: int, workers: Workers
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]:
    """Points (num_points, 3) [m], colours (num_points, 3) and labels (num_points,) of all rooms."""
    check_num_points(world, num_points)
    counts = np.diff(np.linspace(0, num_points, len(world.rooms) + 1).astype(int))
    rng = np.random.default_rng([world.seed, 10])
    parts = [scan_room(room, int(n), rng, workers) for room, n in zip(world.rooms, counts, strict=True)]
    points, colors, labels = zip(*parts, strict=True)
    return np.concatenate(points), np.concatenate(colors), np.concatenate(labels)


def room_of_query(world: World, index: int, variant: str) -> tuple[Room, np.random.Generator]:
    """The room as query number `index` of a variant finds it, and what else of the query is drawn from."""
    rng = np.random.default_rng([world.seed, 20, VARIANTS.index(variant), index])
    number = int(rng.integers(len(world.rooms)))
    room = world.rooms[number]
    if variant == "change":
        room = make_room(world.seed * MAX_ROOMS + number, room.size, room.corner, changed=index + 1)
    return room, rng


def make_query(world: World, index: int, variant: str, width: int, workers: Workers) -> Query:
    """Query number `index` of a variant: upright but for `tilt`, in a room drawn at random."""
    if variant not in VARIANTS:
        raise InputError(f"variant: {variant!r} is not one of {', '.join(VARIANTS)}")
    check_width(width)
    room, rng = room_of_query(world, index, variant)
    center_world = free_position(room, rng, (1.0, min(1.9, float(room.size[2]) - 0.4)))
    R_cam_from_world = yaw_rotation(rng.uniform(0, 2 * np.pi))
    if variant == "tilt":
        R_cam_from_world = exp_so3(rng.uniform(-1, 1, 3)) @ uniform_rotations(64)[rng.integers(64)]
    pose = Pose(R_cam_from_world, center_world)
    rgb = photograph(room, pose, width, workers)
    return Query(other_light(rgb, rng) if variant == "photo" else rgb, pose, variant)


def make_labels(world: World, index: int, query: Query, workers: Workers) -> NDArray[np.uint16]:
    """Image (H, W) of the labels that query number `index` of its variant shows."""
    room, _ = room_of_query(world, index, query.variant)
    return label_image(room, query.pose, query.rgb.shape[1], workers)
