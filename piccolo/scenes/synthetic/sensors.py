"""A laser scanner and a camera in a room.

The scanner has noise, shadows and uneven density; light, lens and file change the panoramas.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ...errors import InputError
from ...geometry.pose import Array, Pose, yaw_rotation
from ...geometry.sphere import pixel_rays
from ...runtime.threads import Workers
from .raycast import cast_rays
from .room import Room

SUPERSAMPLING = 2  # rays a pixel, each way
BAND = 8  # rows cast at once: all rays of a large image would take a gigabyte


RANGE_NOISE = 0.003  # of the scanner, standard deviation [m]
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


def photograph(room: Room, pose: Pose, width: int, workers: Workers) -> NDArray[np.uint8]:
    """Equirectangular image (width / 2, width, 3) of a room at `pose`."""
    rays_cam = pixel_rays(SUPERSAMPLING * width)

    def run(top: int) -> NDArray[np.uint8]:
        rows = rays_cam[SUPERSAMPLING * top : SUPERSAMPLING * (top + BAND)].reshape(-1, 3)
        rgb = cast_rays(room, pose.center_world, rows @ pose.R_cam_from_world, Workers(), "band")[1]
        blocks = rgb.reshape(-1, SUPERSAMPLING, width, SUPERSAMPLING, 3)
        return np.asarray(np.round(blocks.mean(axis=(1, 3)) * 255.0), dtype=np.uint8)

    return np.concatenate(list(workers.map(run, range(0, width // 2, BAND), "panorama")))


def label_image(room: Room, pose: Pose, width: int, workers: Workers) -> NDArray[np.uint16]:
    """Equirectangular image (width / 2, width) of a room's labels at `pose`, of pixels' centres."""

    def run(top: int) -> NDArray[np.uint16]:
        rays = pixel_rays(width, slice(top, top + BAND)).reshape(-1, 3) @ pose.R_cam_from_world
        labels = cast_rays(room, pose.center_world, rays, Workers(), "band")[2]
        return labels.reshape(-1, width).astype(np.uint16)

    return np.concatenate(list(workers.map(run, range(0, width // 2, BAND), "labels")))


def blur(image: Array, sigma: float) -> Array:
    """An equirectangular image (H, W, 3) under a Gaussian [px]."""
    return np.asarray(gaussian_filter(image, (sigma, sigma, 0.0), mode=("nearest", "wrap", "nearest")))


def other_light(rgb: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image (H, W, 3) with another exposure, white balance and gamma, blurred and noisy."""
    gain = rng.uniform(0.7, 1.3) * rng.uniform(0.85, 1.15, 3)
    linear = (rgb / 255.0) ** rng.uniform(0.8, 1.25)
    noisy = blur(linear * gain, 0.8) + rng.normal(0.0, 0.02, rgb.shape)
    return np.asarray(np.round(noisy.clip(0.0, 1.0) * 255.0).astype(np.uint8))
