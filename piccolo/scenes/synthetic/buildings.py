"""Seeded clouds of places that mislead a search for up: clutter, roofs, stairs, missing floors, open ground.

Surfaces are sampled evenly, without a scanner's shadows but with its noise. z is up.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...geometry.pose import Array
from ...runtime.threads import Workers
from .repeated import make_repeated
from .scan import RANGE_NOISE, scan_room
from .world import make_world, scan_world

DENSITY = 250.0  # points a m2
ROOM_POINTS = 80_000
CLUTTER_SHARE = 0.4
WALL_DISTANCE = np.array([0.5, 0.5, 0.0])  # of furniture [m]
MARGIN = 0.05  # [m] of a floor or ceiling that is taken away
Points = tuple[NDArray[np.float64], NDArray[np.uint8]]


@dataclass
class Sampler:
    """Points on surfaces as they are added."""

    rng: np.random.Generator
    points: list[Array] = field(default_factory=list)
    colors: list[NDArray[np.uint8]] = field(default_factory=list)

    def patch(self, corner: ArrayLike, a: ArrayLike, b: ArrayLike) -> None:
        """A parallelogram from `corner` along the edges `a` and `b` (3,) [m], in one colour."""
        edge_a, edge_b = np.asarray(a, float), np.asarray(b, float)
        area = float(np.linalg.norm(np.cross(edge_a, edge_b)))
        s = self.rng.uniform(0.0, 1.0, (int(DENSITY * area) + 1, 2))
        self.add(np.asarray(corner) + s[:, :1] * edge_a + s[:, 1:] * edge_b)

    def add(self, points: Array) -> None:
        """Points (N, 3) [m], blurred by the scanner's noise."""
        self.points.append(points + self.rng.normal(0.0, RANGE_NOISE, points.shape))
        color = self.rng.integers(40, 220, 3) + self.rng.integers(-20, 20, (len(points), 3))
        self.colors.append(color.astype(np.uint8))

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
            self.patch(origin, a, b)

    def furnish(self, low: Array, high: Array, num_pieces: int) -> None:
        """Boxes on the floor between two corners (3,)."""
        for _ in range(num_pieces):
            at = self.rng.uniform(low + WALL_DISTANCE, high - WALL_DISTANCE)
            size = self.rng.uniform([0.3, 0.3, 0.3], [1.6, 0.8, 1.2])
            self.box([at[0], at[1], low[2]], size, float(self.rng.normal(0.0, 0.3)))

    def cloud(self) -> Points:
        """All points and colours."""
        return np.concatenate(self.points), np.concatenate(self.colors)


def _room(seed: int) -> Points:
    rng = np.random.default_rng([seed, 60])
    num_rooms = int(rng.integers(1, 3))
    world = make_world(seed, rng.uniform([3.5, 3.0, 2.3], [9.0, 7.0, 3.4]), num_rooms)
    points, colors = scan_world(world, ROOM_POINTS * num_rooms, Workers())
    return points.astype(np.float64), colors


def _cluttered(seed: int) -> Points:
    """A room of whose points 40 % lie on patches turned anyhow, heaped up on its floor."""
    points, colors = _room(seed)
    sampler = Sampler(np.random.default_rng([seed, 61]))
    low, high = points.min(axis=0), points.max(axis=0)
    wanted = len(points) * CLUTTER_SHARE / (1.0 - CLUTTER_SHARE)
    while sum(map(len, sampler.points)) < wanted:
        at = sampler.rng.uniform(low, high)
        at[2] = low[2] + (high[2] - low[2]) * sampler.rng.beta(1.2, 2.0)
        a, b = sampler.rng.normal(size=(2, 3)) * 0.3
        sampler.patch(at, a, b)
    more, more_colors = sampler.cloud()
    return np.concatenate([points, more.clip(low, high)]), np.concatenate([colors, more_colors])


def _without_ceiling(seed: int) -> Points:
    points, colors = _room(seed)
    is_kept = points[:, 2] < points[:, 2].max() - MARGIN
    return points[is_kept], colors[is_kept]


def _without_floor(seed: int) -> Points:
    points, colors = _room(seed)
    is_kept = points[:, 2] > points[:, 2].min() + MARGIN
    return points[is_kept], colors[is_kept]


def _attic(seed: int) -> Points:
    """Low walls, a slanted roof on both sides, furniture."""
    s = Sampler(np.random.default_rng([seed, 62]))
    x, y, wall = s.rng.uniform([5.0, 4.0, 0.4], [10.0, 8.0, 1.4])
    ridge = wall + 0.5 * y * np.tan(s.rng.uniform(0.5, 0.9))
    s.patch([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.patch([0, 0, 0], [x, 0, 0], [0, 0, wall])
    s.patch([0, y, 0], [x, 0, 0], [0, 0, wall])
    s.patch([0, 0, wall], [x, 0, 0], [0, y / 2, ridge - wall])
    s.patch([0, y, wall], [x, 0, 0], [0, -y / 2, ridge - wall])
    for end in (0.0, x):
        yz = s.rng.uniform([0, 0], [y, ridge], (int(DENSITY * y * ridge), 2))
        roof = wall + (ridge - wall) * (1.0 - np.abs(2.0 * yz[:, 0] / y - 1.0))
        yz = yz[yz[:, 1] < roof]
        s.add(np.column_stack([np.full(len(yz), end), yz]))
    s.furnish(np.zeros(3), np.array([x, y, 0.0]), int(x * y / 5))
    return s.cloud()


def _stairwell(seed: int) -> Points:
    """Flights with steps, their undersides, landings and walls."""
    s = Sampler(np.random.default_rng([seed, 63]))
    width, tread, rise = s.rng.uniform([0.9, 0.25, 0.16], [1.3, 0.30, 0.19])
    num_steps, num_flights = int(s.rng.integers(8, 12)), int(s.rng.integers(2, 5))
    length, height = num_steps * tread, num_steps * rise
    x, y, z = length + 2 * width, 2 * width + 0.2, num_flights * height
    for flight in range(num_flights):
        at_y, sign = (0.0, 1.0) if flight % 2 == 0 else (width + 0.2, -1.0)
        begin = width if flight % 2 == 0 else width + length
        for k in range(num_steps):
            foot = np.array([begin + sign * k * tread, at_y, flight * height + k * rise])
            s.patch(foot, [0, width, 0], [0, 0, rise])
            s.patch(foot + np.array([0, 0, rise]), [0, width, 0], [sign * tread, 0, 0])
        if flight:
            s.patch([begin, at_y, flight * height - 0.2], [0, width, 0], [sign * length, 0, height])
        landing = 0.0 if flight % 2 else x - width
        s.patch([landing, 0, (flight + 1) * height], [width, 0, 0], [0, y, 0])
    s.patch([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.patch([0, 0, z + 2.3], [x, 0, 0], [0, y, 0])
    for corner, a in (([0, 0, 0], [x, 0, 0]), ([0, y, 0], [x, 0, 0]), ([0, 0, 0], [0, y, 0]),
                      ([x, 0, 0], [0, y, 0])):  # fmt: skip
        s.patch(corner, a, [0, 0, z + 2.3])
    return s.cloud()


def _outdoors(seed: int) -> Points:
    """Sloping, uneven ground with trees, cars and perhaps a house front."""
    s = Sampler(np.random.default_rng([seed, 64]))
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
        s.patch([0, size, -0.5], [size, 0, 0], [0, 0, s.rng.uniform(4.0, 10.0)])
    return s.cloud()


def _aerial(seed: int) -> Points:
    """Houses and trees as a drone sees them: roofs, ground, no walls."""
    s = Sampler(np.random.default_rng([seed, 68]))
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
    return s.cloud()


def _front(seed: int) -> Points:
    """A house front and a strip of ground before it."""
    s = Sampler(np.random.default_rng([seed, 65]))
    length, height, depth = s.rng.uniform([10.0, 5.0, 1.5], [20.0, 12.0, 6.0])
    s.patch([0, 0, 0], [length, 0, 0], [0, 0, height])
    s.patch([0, 0, 0], [length, 0, 0], [0, -depth, 0])
    for x in np.arange(1.5, length - 1.5, 2.5):
        for z in np.arange(1.0, height - 1.5, 3.0):
            s.patch([x, 0.15, z], [1.0, 0, 0], [0, 0, 1.3])
            s.patch([x, 0, z], [1.0, 0, 0], [0, 0.15, 0])
    s.furnish(np.array([0, -depth - 0.6, 0.0]), np.array([length, 0.6, 0.0]), int(s.rng.integers(0, 4)))
    return s.cloud()


def _bare(seed: int) -> Points:
    """A closed box with nothing in it: no honest answer is sure."""
    s = Sampler(np.random.default_rng([seed, 66]))
    s_x, s_y, s_z = s.rng.uniform([3.0, 3.0, 2.2], [8.0, 7.0, 4.0])
    s.patch([0, 0, s_z], [s_x, 0, 0], [0, s_y, 0])
    s.patch([0, 0, 0], [s_x, 0, 0], [0, s_y, 0])
    for corner, a in (([0, 0, 0], [s_x, 0, 0]), ([0, s_y, 0], [s_x, 0, 0]), ([0, 0, 0], [0, s_y, 0]),
                      ([s_x, 0, 0], [0, s_y, 0])):  # fmt: skip
        s.patch(corner, a, [0, 0, s_z])
    return s.cloud()


def _corridor(seed: int) -> Points:
    rng = np.random.default_rng([seed, 67])
    (corridor,) = make_repeated("corridor", seed, rng.uniform([3.5, 3.0, 2.3], [9.0, 7.0, 3.4]))
    points, colors, _ = scan_room(corridor, 2 * ROOM_POINTS, rng, Workers())
    return points.astype(np.float64), colors


BUILDINGS: dict[str, Callable[[int], Points]] = {
    "room": _room,
    "clutter": _cluttered,
    "no ceiling": _without_ceiling,
    "no floor": _without_floor,
    "attic": _attic,
    "stairs": _stairwell,
    "outdoors": _outdoors,
    "aerial": _aerial,
    "front": _front,
    "corridor": _corridor,
    "bare": _bare,
}


def make_building(kind: str, seed: int) -> Points:
    """Points (N, 3) [m] and colours (N, 3) of one of BUILDINGS."""
    return BUILDINGS[kind](seed)
