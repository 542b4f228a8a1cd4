"""Seeded clouds of places that mislead a search for up: clutter, roofs, stairs, missing floors, open ground.

Surfaces are sampled evenly, without a scanner's shadows but with its noise. z is up.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ...geometry.pose import Array
from ...runtime.threads import Workers
from .room import make_repeated
from .world import RANGE_NOISE, make_world, random_size, scan_room, scan_world

DENSITY = 250.0  # points a m2
ROOM_POINTS = 80_000
CLUTTER_FRACTION = 0.4
WALL_DISTANCE = np.array([0.5, 0.5, 0.0])  # of furniture [m]
MARGIN = 0.05  # of a floor or ceiling that is taken away [m]


@dataclass
class SurfaceSampler:
    """Points on surfaces as they are added."""

    rng: np.random.Generator
    parts: list[Array] = field(default_factory=list)

    def parallelogram(self, corner: ArrayLike, a: ArrayLike, b: ArrayLike) -> None:
        """Points from `corner` along the edges `a` and `b` (3,) [m]."""
        edge_a, edge_b = np.asarray(a, float), np.asarray(b, float)
        area = float(np.linalg.norm(np.cross(edge_a, edge_b)))
        s = self.rng.uniform(0.0, 1.0, (int(DENSITY * area) + 1, 2))
        self.add(np.asarray(corner) + s[:, :1] * edge_a + s[:, 1:] * edge_b)

    def add(self, points: Array) -> None:
        """Points (N, 3) [m], blurred by the scanner's noise."""
        self.parts.append(points + self.rng.normal(0.0, RANGE_NOISE, points.shape))

    def box(self, center: ArrayLike, size: ArrayLike, yaw: float = 0.0) -> None:
        """The sides and the top of a box of `size` (3,) whose bottom's centre is at `center` (3,) [m]."""
        x, y, z = np.asarray(size, float)
        c, s = np.cos(yaw), np.sin(yaw)
        along, across, up = np.array([c * x, s * x, 0.0]), np.array([-s * y, c * y, 0.0]), np.array([0, 0, z])
        corner = np.asarray(center) - 0.5 * (along + across)
        for origin, a, b in (
            (corner, along, up), (corner + across, along, up),
            (corner, across, up), (corner + along, across, up), (corner + up, along, across),
        ):  # fmt: skip
            self.parallelogram(origin, a, b)

    def shell(self, x: float, y: float, z: float) -> None:
        """The inside of a box from the origin to (x, y, z): floor, ceiling and walls."""
        along, across, up = [x, 0, 0], [0, y, 0], [0, 0, z]
        for corner, a, b in (
            ([0, 0, 0], along, across), (up, along, across), ([0, 0, 0], along, up),
            (across, along, up), ([0, 0, 0], across, up), (along, across, up),
        ):  # fmt: skip
            self.parallelogram(corner, a, b)

    def furnish(self, low: Array, high: Array, num_pieces: int) -> None:
        """Boxes on the floor between two corners (3,)."""
        for _ in range(num_pieces):
            at = self.rng.uniform(low + WALL_DISTANCE, high - WALL_DISTANCE)
            size = self.rng.uniform([0.3, 0.3, 0.3], [1.6, 0.8, 1.2])
            self.box([at[0], at[1], low[2]], size, float(self.rng.normal(0.0, 0.3)))

    def points(self) -> Array:
        """All points (N, 3)."""
        return np.concatenate(self.parts)


def _room(seed: int) -> Array:
    rng = np.random.default_rng([seed, 60])
    num_rooms = int(rng.integers(1, 3))
    world = make_world(seed, random_size(rng), num_rooms)
    return scan_world(world, ROOM_POINTS * num_rooms, Workers())[0].astype(np.float64)


def _cluttered(seed: int) -> Array:
    """A room of whose points 40 % are on small pieces at random angles, heaped up on its floor."""
    points = _room(seed)
    s = SurfaceSampler(np.random.default_rng([seed, 61]))
    low, high = points.min(axis=0), points.max(axis=0)
    num_clutter = len(points) * CLUTTER_FRACTION / (1.0 - CLUTTER_FRACTION)
    while sum(map(len, s.parts)) < num_clutter:
        at = s.rng.uniform(low, high)
        at[2] = low[2] + (high[2] - low[2]) * s.rng.beta(1.2, 2.0)
        a, b = s.rng.normal(size=(2, 3)) * 0.3
        s.parallelogram(at, a, b)
    return np.concatenate([points, s.points().clip(low, high)])


def _open_room(seed: int, is_open_above: bool) -> Array:
    """A room without its ceiling, or without its floor."""
    points = _room(seed)
    z = points[:, 2]
    return np.compress(z < z.max() - MARGIN if is_open_above else z > z.min() + MARGIN, points, axis=0)


def _attic(seed: int) -> Array:
    """Low walls, a slanted roof on both sides, furniture."""
    s = SurfaceSampler(np.random.default_rng([seed, 62]))
    x, y, wall = s.rng.uniform([5.0, 4.0, 0.4], [10.0, 8.0, 1.4])
    ridge = wall + 0.5 * y * np.tan(s.rng.uniform(0.5, 0.9))
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, 0, wall])
    s.parallelogram([0, y, 0], [x, 0, 0], [0, 0, wall])
    s.parallelogram([0, 0, wall], [x, 0, 0], [0, y / 2, ridge - wall])
    s.parallelogram([0, y, wall], [x, 0, 0], [0, -y / 2, ridge - wall])
    for end in (0.0, x):
        yz = s.rng.uniform([0, 0], [y, ridge], (int(DENSITY * y * ridge), 2))
        roof = wall + (ridge - wall) * (1.0 - np.abs(2.0 * yz[:, 0] / y - 1.0))
        yz = yz[yz[:, 1] < roof]
        s.add(np.column_stack([np.full(len(yz), end), yz]))
    s.furnish(np.zeros(3), np.array([x, y, 0.0]), int(x * y / 5))
    return s.points()


def _stairwell(seed: int) -> Array:
    """Flights with steps, their undersides, landings and walls."""
    s = SurfaceSampler(np.random.default_rng([seed, 63]))
    width, tread, rise = s.rng.uniform([0.9, 0.25, 0.16], [1.3, 0.30, 0.19])
    num_steps, num_flights = int(s.rng.integers(8, 12)), int(s.rng.integers(2, 5))
    length, height = num_steps * tread, num_steps * rise
    x, y, z = length + 2 * width, 2 * width + 0.2, num_flights * height
    for flight in range(num_flights):
        at_y, sign = (0.0, 1.0) if flight % 2 == 0 else (width + 0.2, -1.0)
        begin = width if flight % 2 == 0 else width + length
        for k in range(num_steps):
            foot = np.array([begin + sign * k * tread, at_y, flight * height + k * rise])
            s.parallelogram(foot, [0, width, 0], [0, 0, rise])
            s.parallelogram(foot + np.array([0, 0, rise]), [0, width, 0], [sign * tread, 0, 0])
        if flight:
            s.parallelogram([begin, at_y, flight * height - 0.2], [0, width, 0], [sign * length, 0, height])
        landing = 0.0 if flight % 2 else x - width
        s.parallelogram([landing, 0, (flight + 1) * height], [width, 0, 0], [0, y, 0])
    s.shell(x, y, z + 2.3)
    return s.points()


def _outdoors(seed: int) -> Array:
    """Sloping, uneven ground with trees, cars and perhaps a house front."""
    s = SurfaceSampler(np.random.default_rng([seed, 64]))
    size = s.rng.uniform(20.0, 40.0)
    xy = s.rng.uniform(0.0, size, (int(40 * size * size), 2))
    slope = s.rng.normal(0.0, 0.015, 2)
    phase = s.rng.uniform(0.0, 6.0, 2)

    def ground(xy: Array) -> Array:
        waves = np.sin(xy[:, 0] / 4.0 + phase[0]) * np.sin(xy[:, 1] / 5.0 + phase[1])
        return np.asarray(xy @ slope + 0.1 * waves)

    s.add(np.column_stack([xy, ground(xy)]))
    for at in s.rng.uniform(2.0, size - 2.0, (int(s.rng.integers(3, 16)), 2)):
        level, height = float(ground(at[None])[0]), s.rng.uniform(3.0, 7.0)
        trunk = s.rng.uniform(0.0, 1.0, (600, 2)) * [2 * np.pi, height]
        bark = at + 0.15 * np.column_stack([np.cos(trunk[:, 0]), np.sin(trunk[:, 0])])
        s.add(np.column_stack([bark, level + trunk[:, 1]]))
        s.add(s.rng.normal([*at, level + height], [1.2, 1.2, 1.0], (3000, 3)))
    for at in s.rng.uniform(3.0, size - 3.0, (int(s.rng.integers(0, 6)), 2)):
        s.box([*at, float(ground(at[None])[0])], [4.2, 1.8, 1.4], float(s.rng.uniform(0, np.pi)))
    if s.rng.random() < 0.7:
        s.parallelogram([0, size, -0.5], [size, 0, 0], [0, 0, s.rng.uniform(4.0, 10.0)])
    return s.points()


def _aerial(seed: int) -> Array:
    """Houses and trees as a drone sees them: roofs, ground, no walls."""
    s = SurfaceSampler(np.random.default_rng([seed, 68]))
    size = s.rng.uniform(40.0, 90.0)
    xy = s.rng.uniform(0.0, size, (int(8 * size * size), 2))
    slope = s.rng.normal(0.0, 0.01, 2)
    level = xy @ slope + 0.05 * np.sin(xy[:, 0] / 9.0) + s.rng.normal(0.0, 0.03, len(xy))
    for at in s.rng.uniform(8.0, size - 8.0, (int(s.rng.integers(3, 15)), 2)):
        half, eaves = s.rng.uniform([4.0, 3.0], [8.0, 6.0]), s.rng.uniform(3.0, 8.0)
        pitch = float(s.rng.choice([0.0, s.rng.uniform(0.4, 0.9)]))
        place = np.abs(xy - at)
        is_roof = np.all(place < half, axis=1)
        level[is_roof] = at @ slope + eaves + pitch * (half[1] - place[is_roof, 1])
    for at in s.rng.uniform(0.0, size, (int(s.rng.integers(5, 40)), 2)):
        radius = s.rng.uniform(1.0, 3.5)
        distance = np.linalg.norm(xy - at, axis=1)
        is_crown = distance < radius
        crown = 2.0 * radius + np.sqrt(radius**2 - distance[is_crown] ** 2)
        level[is_crown] = at @ slope + crown + s.rng.normal(0.0, 0.3, len(crown))
    s.add(np.column_stack([xy, level]))
    return s.points()


def _front(seed: int) -> Array:
    """A house front and a strip of ground before it."""
    s = SurfaceSampler(np.random.default_rng([seed, 65]))
    length, height, depth = s.rng.uniform([10.0, 5.0, 1.5], [20.0, 12.0, 6.0])
    s.parallelogram([0, 0, 0], [length, 0, 0], [0, 0, height])
    s.parallelogram([0, 0, 0], [length, 0, 0], [0, -depth, 0])
    for x in np.arange(1.5, length - 1.5, 2.5):
        for z in np.arange(1.0, height - 1.5, 3.0):
            s.parallelogram([x, 0.15, z], [1.0, 0, 0], [0, 0, 1.3])
            s.parallelogram([x, 0, z], [1.0, 0, 0], [0, 0.15, 0])
    s.furnish(np.array([0, -depth - 0.6, 0.0]), np.array([length, 0.6, 0.0]), int(s.rng.integers(0, 4)))
    return s.points()


def _bare(seed: int) -> Array:
    """A closed box with nothing in it: no honest answer is sure."""
    s = SurfaceSampler(np.random.default_rng([seed, 66]))
    s.shell(*s.rng.uniform([3.0, 3.0, 2.2], [8.0, 7.0, 4.0]))
    return s.points()


def _corridor(seed: int) -> Array:
    rng = np.random.default_rng([seed, 67])
    (corridor,) = make_repeated("corridor", seed, random_size(rng))
    return scan_room(corridor, 2 * ROOM_POINTS, rng, Workers())[0].astype(np.float64)


BUILDINGS: dict[str, Callable[[int], Array]] = {  # points (N, 3) [m] by a seed
    "room": _room,
    "clutter": _cluttered,
    "no ceiling": partial(_open_room, is_open_above=True),
    "no floor": partial(_open_room, is_open_above=False),
    "attic": _attic,
    "stairs": _stairwell,
    "outdoors": _outdoors,
    "aerial": _aerial,
    "front": _front,
    "corridor": _corridor,
    "bare": _bare,
}
