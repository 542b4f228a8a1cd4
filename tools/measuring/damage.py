"""Seeded damage to a photo: occluders, uneven light, a narrow field of view; rooms without texture."""

import math

import numpy as np
from numpy.typing import NDArray

from piccolo.geometry.sphere import pixel_rays, solid_angles
from piccolo.scenes.synthetic.room import PLAIN
from piccolo.scenes.synthetic.world import World, blur

Image = NDArray[np.uint8]
LEAST_RADIUS, MOST_RADIUS = math.radians(8.0), math.radians(28.0)  # of an occluder
FLATTENED = 0.4  # elevations of occluders: people and things stand around the camera
LIGHT_SCALE = 0.08  # of the width: patches of light and shade
ASPECT = 0.75  # height by width of a narrow photo


def occluded(rgb: Image, other: Image, fraction: float, rng: np.random.Generator) -> Image:
    """The photo (H, W, 3) behind round pieces of another, over a fraction of the sphere."""
    height, width = rgb.shape[:2]
    rays, areas = pixel_rays(width), solid_angles(width)[:, None] / (4.0 * math.pi)
    is_hidden = np.zeros((height, width), np.bool_)
    shown = rgb.copy()
    while float((is_hidden * areas).sum()) < fraction:
        direction = rng.normal(size=3) * [1.0, 1.0, FLATTENED]
        radius = rng.uniform(LEAST_RADIUS, MOST_RADIUS)
        is_new = (rays @ (direction / np.linalg.norm(direction)) > math.cos(radius)) & ~is_hidden
        moved = np.roll(other, rng.integers(width), axis=1)[:: int(rng.choice([-1, 1]))]
        shown[is_new] = moved[is_new]
        is_hidden |= is_new
    return shown


def unevenly_lit(rgb: Image, stops: float, rng: np.random.Generator) -> Image:
    """The photo (H, W, 3) under patches of light that differ by some stops."""
    noise = blur(rng.normal(size=rgb.shape[:2])[..., None], LIGHT_SCALE * rgb.shape[1])
    gain = 2.0 ** (0.5 * stops * noise / noise.std())
    linear = (rgb / 255.0) ** 2.2 * gain
    return np.asarray(255.0 * linear.clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def outside_field(width: int, fov_deg: float, yaw: float) -> NDArray[np.bool_]:
    """Where (H, W) a sphere lies outside a level pinhole photo this wide that looks along azimuth `yaw`."""
    x, y, z = np.moveaxis(pixel_rays(width), -1, 0)
    forward, left = math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x
    reach = math.tan(math.radians(fov_deg / 2.0)) * forward
    return np.asarray((forward <= 0.0) | (np.abs(left) > reach) | (np.abs(z) > ASPECT * reach))


def without_texture(world: World) -> World:
    """The same rooms with every surface in one colour."""
    rooms = []
    for room in world.rooms:
        materials = room.materials.copy()
        materials[:, 0] = PLAIN
        rooms.append(room._replace(materials=materials))
    return world._replace(rooms=tuple(rooms))
