"""Seeded clouds under the open sky: ground with trees, aerial views, fronts, streets, houses, courtyards."""

import math

import numpy as np

from ...geometry.pose import Array
from .surfaces import SurfaceSampler

STREET_DENSITY = 80.0  # points a m2


def outdoors(seed: int) -> Array:
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
        _tree(s, np.array([*at, level]), float(height))
    for at in s.rng.uniform(3.0, size - 3.0, (int(s.rng.integers(0, 6)), 2)):
        s.box([*at, float(ground(at[None])[0])], [4.2, 1.8, 1.4], float(s.rng.uniform(0, np.pi)))
    if s.rng.random() < 0.7:
        s.parallelogram([0, size, -0.5], [size, 0, 0], [0, 0, s.rng.uniform(4.0, 10.0)])
    return s.points()


def aerial(seed: int) -> Array:
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


def front(seed: int) -> Array:
    """A house front and a strip of ground before it."""
    s = SurfaceSampler(np.random.default_rng([seed, 65]))
    length, height, depth = s.rng.uniform([10.0, 5.0, 1.5], [20.0, 12.0, 6.0])
    s.parallelogram([0, 0, 0], [length, 0, 0], [0, -depth, 0])
    places = [(x, z) for x in np.arange(1.5, length - 1.5, 2.5) for z in np.arange(1.0, height - 1.5, 3.0)]
    windows = [(x, x + 1.0, z, z + 1.3) for x, z in places]
    s.pierced_wall([0, 0, 0], [length, 0, 0], height, np.array([0.0, 1.0, 0.0]), windows)
    for x, z in places:
        s.parallelogram([x, 0.15, z], [1.0, 0, 0], [0, 0, 1.3])
    s.furnish(np.array([0, -depth - 0.6, 0.0]), np.array([length, 0.6, 0.0]), int(s.rng.integers(0, 4)))
    return s.points()


def _tree(s: SurfaceSampler, at: Array, height: float) -> None:
    """A trunk and a crown on the ground at `at` (3,)."""
    s.cylinder(at, [0, 0, height], 0.15)
    s.add(s.rng.normal(at + [0, 0, height + 0.5], [1.2, 1.2, 1.0], (1500, 3)))


def _facade(s: SurfaceSampler, corner: Array, along: Array, height: float, outward: Array) -> None:
    """A front with rows of windows, of which `outward` (3,) are rooms, and a door."""
    length = float(np.linalg.norm(along))
    panes = [
        (x, x + 1.1, z, z + 1.5)
        for z in np.arange(0.9, height - 1.6, 3.0)
        for x in np.arange(1.0, length - 1.2, 2.4)
    ]
    s.pierced_wall(corner, along, height, outward, [*panes, (0.2, 1.1, 0.0, 2.1)])


def street(seed: int) -> Array:
    """A street with parked cars, lamp posts, trees; houses on one side or both, nothing at its ends."""
    s = SurfaceSampler(np.random.default_rng([seed, 100]), STREET_DENSITY)
    x, y = s.rng.uniform([25.0, 9.0], [50.0, 16.0])
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.box([x / 2, 1.0, 0], [x, 2.0, 0.13])
    s.box([x / 2, y - 1.0, 0], [x, 2.0, 0.13])
    sides = ((0.0, True), (y, bool(s.rng.random() < 0.5)))
    for side, is_built in sides:
        at = 0.0
        while is_built and at < x - 6.0:
            length = float(s.rng.uniform(6.0, 14.0))
            along = np.array([min(length, x - at), 0.0, 0.0])
            outward = np.array([0.0, 1.0 if side else -1.0, 0.0])
            _facade(s, np.array([at, side, 0.0]), along, s.rng.uniform(5.0, 13.0), outward)
            at += length + float(s.rng.choice([0.0, 2.0]))
    for at in np.arange(3.0, x - 3.0, 6.0):
        for side in (2.9, y - 2.9):
            if s.rng.random() < 0.6:
                s.car([at, side, 0.0], float(s.rng.normal(0.0, 0.02)))
        if s.rng.random() < 0.4:
            s.cylinder([at + 3.0, 1.7, 0], [0, 0, 6.0], 0.08)
        if s.rng.random() < 0.4:
            _tree(s, np.array([at + 3.0, y - 1.2, 0.1]), s.rng.uniform(2.5, 5.0))
    return s.points()


def terrace(seed: int) -> Array:
    """A deck with a railing before a house, tables and chairs, maybe a pergola."""
    s = SurfaceSampler(np.random.default_rng([seed, 101]))
    x, y = s.rng.uniform([6.0, 3.5], [12.0, 7.0])
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    outward = np.array([0.0, 1.0, 0.0])
    _facade(s, np.array([0.0, y, 0.0]), np.array([x, 0, 0]), s.rng.uniform(3.0, 6.5), outward)
    for corner, along in (([0, 0, 0], [x, 0, 0]), ([0, 0, 0], [0, y, 0]), ([x, 0, 0], [0, y, 0])):
        s.parallelogram(np.array(corner) + [0, 0, 0.95], along, [0, 0, 0.06])
        for t in np.arange(0.0, 1.0, 0.05):
            s.cylinder(np.array(corner) + t * np.array(along), [0, 0, 0.95], 0.02)
    if s.rng.random() < 0.5:
        for at in np.arange(0.5, x, 0.8):
            s.box([at, y / 2, 2.4], [0.08, y, 0.14], hangs=True)
    s.furnish([0, 0, 0], [x, y, 0], int(x * y / 5))
    return s.points()


def _pitched(s: SurfaceSampler, corner: Array, size: Array, rise: float) -> None:
    """A roof of two slopes with eaves over a rectangle; `size` (2,), the ridge along x."""
    x, y = size
    low = np.array([corner[0] - 0.4, corner[1] - 0.4, corner[2] - 0.8 * rise / y])
    half = y / 2 + 0.4
    s.parallelogram(low, [x + 0.8, 0, 0], [0, half, 2.0 * rise * half / y])
    s.parallelogram(low + [0, 2 * half, 0], [x + 0.8, 0, 0], [0, -half, 2.0 * rise * half / y])


def gable_house(seed: int) -> Array:
    """A house with a pitched roof seen from all sides, and the garden around it."""
    s = SurfaceSampler(np.random.default_rng([seed, 102]), STREET_DENSITY)
    x, y, wall = s.rng.uniform([9.0, 7.0, 2.8], [14.0, 10.0, 6.0])
    rise, margin = 0.5 * y * math.tan(s.rng.uniform(0.5, 0.9)), s.rng.uniform(4.0, 9.0)
    ground = [(margin, margin + x, margin, margin + y)]
    s.parallelogram([-margin, -margin, 0], [x + 2 * margin, 0, 0], [0, y + 2 * margin, 0], ground)
    s.walls([0, 0, 0], [x, y, wall], 1, 8)
    _pitched(s, np.array([0.0, 0.0, wall]), np.array([x, y]), rise)
    for at in (0.0, x):
        yz = s.rng.uniform(0.0, 1.0, (int(STREET_DENSITY * y * rise), 2))
        yz = yz[yz[:, 1] < 1.0 - np.abs(2.0 * yz[:, 0] - 1.0)]
        s.add(np.column_stack([np.full(len(yz), at), yz[:, 0] * y, wall + yz[:, 1] * rise]))
    s.box([0.6 * x, 0.4 * y, wall + 0.6 * rise], [0.5, 0.5, 0.4 * rise + 0.8])
    for at in s.rng.uniform(0.0, x, int(s.rng.integers(1, 6))):
        _tree(s, np.array([at, -0.7 * margin, 0.0]), s.rng.uniform(1.0, 4.0))
    if s.rng.random() < 0.6:
        s.car([-0.5 * margin, 0.5 * y, 0.0], math.pi / 2)
    return s.points()


def roof(seed: int) -> Array:
    """Roofs alone, as from a drone that looks down: slopes, chimneys, dormers, a flat part."""
    s = SurfaceSampler(np.random.default_rng([seed, 103]), STREET_DENSITY, is_from_above=True)
    for k in range(int(s.rng.integers(1, 4))):
        x, y, wall = s.rng.uniform([8.0, 7.0, 0.0], [14.0, 10.0, 1.5])
        rise = 0.5 * y * math.tan(s.rng.uniform(0.5, 0.8))
        _pitched(s, np.array([0.0, 12.0 * k, wall]), np.array([x, y]), rise)
        for at in s.rng.uniform(1.0, x - 1.0, int(s.rng.integers(1, 4))):
            s.box([at, 12.0 * k + 0.35 * y, wall + 0.5 * rise], [0.6, 0.5, 0.5 * rise + 0.7])
            s.box([at, 12.0 * k + 0.75 * y, wall + 0.2 * rise], [1.2, 1.6, 1.2])
    if s.rng.random() < 0.7:
        s.box([-3.0, 4.0, -0.5], [5.0, 8.0, 1.0])
    return s.points()


def courtyard(seed: int) -> Array:
    """Fronts on all four sides, no roof; benches, trees, bicycles."""
    s = SurfaceSampler(np.random.default_rng([seed, 104]), STREET_DENSITY)
    x, y, z = s.rng.uniform([9.0, 8.0, 6.0], [20.0, 16.0, 15.0])
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    for corner, along, outward in (
        ([0, 0, 0], [x, 0, 0], [0, -1, 0]), ([0, y, 0], [x, 0, 0], [0, 1, 0]),
        ([0, 0, 0], [0, y, 0], [-1, 0, 0]), ([x, 0, 0], [0, y, 0], [1, 0, 0]),
    ):  # fmt: skip
        _facade(s, np.array(corner, float), np.array(along, float), z, np.array(outward, float))
    for at in s.rng.uniform([2.0, 2.0], [x - 2.0, y - 2.0], (int(s.rng.integers(0, 4)), 2)):
        _tree(s, np.array([*at, 0.0]), s.rng.uniform(2.0, 4.0))
    s.furnish([0, 0, 0], [x, y, 0], int(s.rng.integers(3, 10)))
    return s.points()
