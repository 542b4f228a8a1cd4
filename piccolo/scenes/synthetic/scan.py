"""A laser scanner in a room: ranges from several stations, with noise, shadows and uneven density."""

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...geometry.pose import Array, yaw_rotation
from ...geometry.sphere import pixel_rays
from ...runtime.threads import Workers
from .raycast import cast_rays
from .room import Room

RANGE_NOISE = 0.003  # standard deviation [m]
MIN_CLEARANCE = 0.35  # of a station or camera [m]
NUM_TRIES = 2000


def free_position(room: Room, rng: np.random.Generator, heights: tuple[float, float]) -> Array:
    """A random position (3,) at least MIN_CLEARANCE from every surface, at a height [m] above the floor.

    Raises InputError if the room is so full that none is found.
    """
    for _ in range(NUM_TRIES):
        low = np.array([MIN_CLEARANCE, MIN_CLEARANCE, heights[0]])
        high = np.array([*(room.size[:2] - MIN_CLEARANCE), heights[1]])
        position = room.corner + rng.uniform(low, high)
        if room.clearance(position) >= MIN_CLEARANCE:
            return position
    text = f"has no place {MIN_CLEARANCE} m from everything; use a larger one"
    raise InputError(f"size: a room of {room.size.tolist()} m {text}")


def scan_room(
    room: Room, num_points: int, rng: np.random.Generator, workers: Workers
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]:
    """Points (N, 3) [m], colours (N, 3) and labels (N,) of a room, N = num_points, from three stations."""
    num_stations = 3
    width = 2 * int(np.ceil(np.sqrt(1.15 * num_points / num_stations / 2.0)))
    points, colors, labels = [], [], []
    for station in range(num_stations):
        position = free_position(room, rng, (1.2, 1.8))
        rays = pixel_rays(width).reshape(-1, 3) @ yaw_rotation(rng.uniform(0, 2 * np.pi))
        ranges, rgb, kinds = cast_rays(room, position, rays, workers, f"scan, station {station + 1}")
        ranges = ranges + rng.normal(0.0, RANGE_NOISE, len(ranges))
        points.append((position + ranges[:, None] * rays).astype(np.float32))
        colors.append(np.round(rgb * 255.0).astype(np.uint8))
        labels.append(kinds)
    is_hit = np.isfinite(np.concatenate(points)).all(axis=1)
    chosen = np.sort(rng.choice(np.flatnonzero(is_hit), num_points, replace=False))
    return np.concatenate(points)[chosen], np.concatenate(colors)[chosen], np.concatenate(labels)[chosen]
