"""Scans of places outdoors: by stations, by a car's lidar, by stereo pictures."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from piccolo.geometry.pose import yaw_rotation
from piccolo.geometry.sphere import pixel_rays
from piccolo.photo.camera.model import camera_of_fov
from piccolo.system.arrays import Array, Array32, Bytes
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers

from .outdoors import PLACE_KINDS, Place
from .raycast import cast_rays

SCANNERS = {"yard": ("station", "stereo"), "street": ("car", "stereo"), "front": ("station", "stereo")}
CLEARANCE = 0.6  # of a camera or scanner [m]
NUM_STATIONS = 3
STATION_WIDTH = 1600  # rays of a turn: 0.2 degrees, 8 cm at 20 m
STATION_HEIGHT = 1.7  # [m]
STATION_NOISE = 0.004  # of a range [m]
NUM_BEAMS = 64
BEAMS_DEG = (-22.5, 22.5)
BEAM_WIDTH = 900  # rays of a turn
SWEEP_STEP = 1.0  # [m] of the car between turns
ROOF_HEIGHT = 2.0  # [m] of the lidar
LIDAR_NOISE = 0.02  # of a range [m]
SWEEP_ERROR = 0.01  # of a turn's place [m]
NUM_PAIRS = 14  # stereo pictures
STEREO_SIZE = (480, 360)  # [px] of depth
STEREO_FOV_DEG = 70.0
STEREO_ERROR = 1.5e-4  # [1/m] deviation of a range divided by its square
PATCH = 8.0  # [px] over which a part of stereo's errors is alike
MOST_RANGE = 60.0  # [m]
MOST_GAIN = 0.12  # of a station's or picture's exposure, logarithm


class Shot(NamedTuple):
    """Directions in which a scanner measures from one position."""

    position: Array  # (3,) [m]
    rays: Array  # (N, 3) in the world


def draw_position(place: Place, rng: np.random.Generator, heights: tuple[float, float]) -> Array:
    """Draw a position (3,) [m] in the place's free ground, away from everything."""
    for _ in range(2000):
        position = np.array([*rng.uniform(place.free[0], place.free[1]), rng.uniform(*heights)])
        if place.room.clearance(position) >= CLEARANCE:
            return position
    raise InputError(f"`seed`: {place.kind} {place.seed} has no free position {CLEARANCE} m from everything")


def measure(
    place: Place, shot: Shot, noise: Callable[[Array], Array], rng: np.random.Generator, workers: Workers
) -> tuple[Array32, Bytes]:
    """Return points (N, 3) [m] and colours (N, 3) of what is hit, with an error of each range (N,) [m]."""
    ranges, rgb, _ = cast_rays(place.room, shot.position, shot.rays, workers, "scan")
    is_hit = ranges < MOST_RANGE
    measured = np.where(is_hit, ranges, 0.0)
    measured = measured + noise(measured)
    points = (shot.position + measured[:, None] * shot.rays)[is_hit]
    gain = np.exp(rng.normal(0.0, MOST_GAIN / 2.0)) * np.ones(3)
    return points.astype(np.float32), np.round(255.0 * (gain * rgb[is_hit]).clip(0.0, 1.0)).astype(np.uint8)


def shots_of_stations(place: Place, rng: np.random.Generator) -> list[Shot]:
    """Return turns of a scanner on a tripod, as far apart as the place allows."""
    rays = pixel_rays(STATION_WIDTH).reshape(-1, 3)
    drawn = [draw_position(place, rng, (STATION_HEIGHT, STATION_HEIGHT)) for _ in range(8 * NUM_STATIONS)]
    chosen = drawn[:1]
    while len(chosen) < NUM_STATIONS:
        apart = [min(float(np.linalg.norm(one - other)) for other in chosen) for one in drawn]
        chosen.append(drawn[int(np.argmax(apart))])
    return [Shot(at, rays @ yaw_rotation(rng.uniform(0.0, 2.0 * np.pi))) for at in chosen]


def shots_of_car(place: Place, rng: np.random.Generator) -> list[Shot]:
    """Return turns of a lidar on a car's roof along its way."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(*BEAMS_DEG, NUM_BEAMS)),
        np.linspace(0.0, 2.0 * np.pi, BEAM_WIDTH, endpoint=False),
        indexing="ij",
    )
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    begin, end = place.way
    count = int(np.linalg.norm(end - begin) / SWEEP_STEP)
    turns = rng.uniform(0.0, 2.0 * np.pi, count)
    return [
        Shot(np.array([*at, ROOF_HEIGHT]), rays.reshape(-1, 3) @ yaw_rotation(turn))
        for at, turn in zip(np.linspace(begin, end, count), turns, strict=True)
    ]


def shots_of_stereo(place: Place, rng: np.random.Generator) -> list[Shot]:
    """Return depth pictures along a person's way, all around or towards the place's focus."""
    camera = camera_of_fov("pinhole", STEREO_FOV_DEG, *STEREO_SIZE)
    u, v = (np.arange(size) + 0.5 for size in STEREO_SIZE)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1))[0].reshape(-1, 3)
    shots = []
    for k, at in enumerate(np.linspace(place.way[0], place.way[1], NUM_PAIRS)):
        heading = 2.4 * k + rng.uniform(-0.2, 0.2)  # golden angle
        if place.focus is not None:
            heading = float(np.arctan2(*(place.focus - at)[::-1])) + 0.45 * (k % 5 - 2)
        up = np.radians(12.0) * (k % 2) + 0.03
        # columns are the camera's forward, left and up axes in the world
        c = np.cos(heading)
        s = np.sin(heading)
        forward = np.array([c * np.cos(up), s * np.cos(up), np.sin(up)])
        left = np.array([-s, c, 0.0])
        axes = np.stack([forward, left, np.cross(forward, left)])
        shots.append(Shot(np.array([*at, 1.6]), rays @ axes))
    return shots


def draw_disparity_errors(count: int, rng: np.random.Generator) -> Array:
    """Draw errors (N,) of a depth picture, of deviation 1: half alike over patches, half a pixel's own."""
    width, height = STEREO_SIZE
    patches = gaussian_filter(rng.normal(size=(height, width)), PATCH, mode="nearest")
    own = rng.normal(size=(height, width))
    return np.asarray(((patches / patches.std() + own) / np.sqrt(2.0)).reshape(-1)[:count])


def scan_place(place: Place, scanner: str, workers: Workers) -> tuple[Array32, Bytes]:
    """Return points (N, 3) [m] and colours (N, 3) of a place, by one of its SCANNERS."""
    numbers = PLACE_KINDS.index(place.kind), SCANNERS[place.kind].index(scanner)
    rng = np.random.default_rng([place.seed, 61, *numbers])
    find_shots = {"station": shots_of_stations, "car": shots_of_car, "stereo": shots_of_stereo}[scanner]

    def noise(ranges: Array) -> Array:
        if scanner == "stereo":
            return STEREO_ERROR * ranges**2 * draw_disparity_errors(len(ranges), rng)
        return rng.normal(0.0, LIDAR_NOISE if scanner == "car" else STATION_NOISE, len(ranges))

    parts = []
    for shot in find_shots(place, rng):
        points, colors = measure(place, shot, noise, rng, workers)
        if scanner == "car":
            points = points + rng.normal(0.0, SWEEP_ERROR, 3).astype(np.float32)
        parts.append((points, colors))
    points, colors = map(np.concatenate, zip(*parts, strict=True))
    return points, colors
