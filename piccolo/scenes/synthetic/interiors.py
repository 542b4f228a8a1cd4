"""Seeded clouds of furnished insides: storeys, loft, furnished attic, cubicles, hotel, lecture hall."""

import math

import numpy as np

from ...geometry.pose import Array
from .surfaces import SurfaceSampler

DENSITY = 120.0  # points a m2: about what a search for up keeps


def _sampler(seed: int, stream: int) -> SurfaceSampler:
    return SurfaceSampler(np.random.default_rng([seed, stream]), DENSITY)


def flight(
    s: SurfaceSampler, foot: Array, width: float, height: float, num_steps: int, tread: float = 0.28
) -> None:
    """A flight of stairs along x from its `foot` (3,), with its underside."""
    rise = height / num_steps
    for k in range(num_steps):
        at = foot + np.array([k * tread, 0.0, k * rise])
        s.parallelogram(at, [0, width, 0], [0, 0, rise])
        s.parallelogram(at + np.array([0, 0, rise]), [0, width, 0], [tread, 0, 0])
    s.parallelogram(foot + np.array([0, 0, -0.2]), [0, width, 0], [num_steps * tread, 0, height])


def storeys(seed: int) -> Array:
    """Two to four furnished storeys above each other, with stairs through openings in the slabs."""
    s = _sampler(seed, 90)
    x, y, z = s.rng.uniform([7.0, 5.5, 2.4], [11.0, 8.0, 2.9])
    num_storeys, slab = int(s.rng.integers(2, 5)), 0.3
    for k in range(num_storeys):
        s.ground = level = k * (z + slab)
        hole = [(1.0, 5.0, y - 1.2, y)]
        s.parallelogram([0, 0, level], [x, 0, 0], [0, y, 0], hole if k else ())
        s.parallelogram([0, 0, level + z], [x, 0, 0], [0, y, 0], hole if k < num_storeys - 1 else ())
        s.walls([0, 0, level], [x, y, z], 1, 3)
        wall = [(0.5, 1.4, 0.0, 2.1)]
        s.parallelogram([x * s.rng.uniform(0.4, 0.6), 0, level], [0, y - 1.3, 0], [0, 0, z], wall)
        if k < num_storeys - 1:
            flight(s, np.array([1.0, y - 1.1, level]), 1.0, z + slab, 14)
        s.furnish([0, 0, level], [x, y - 1.2, level], int(x * y / s.rng.uniform(4.0, 8.0)))
    return s.points()


def loft(seed: int) -> Array:
    """One large furnished room below visible beams, a gallery over a part of it, tall windows."""
    s = _sampler(seed, 91)
    x, y, z = s.rng.uniform([8.0, 6.0, 3.4], [15.0, 10.0, 5.0])
    s.floor_and_ceiling(x, y, z)
    s.walls([0, 0, 0], [x, y, z], 1, 5)
    s.beams([x, y], z, s.rng.uniform(0.8, 1.8), s.rng.uniform(0.2, 0.4))
    depth = s.rng.uniform(2.0, 3.0)
    s.box([depth / 2, y / 2, 2.2], [depth, y, 0.2])
    s.parallelogram([0, 0, 2.4], [depth, 0, 0], [0, y, 0])  # scanned from above too
    flight(s, np.array([depth, 0.1, 0.0]), 0.9, 2.4, 11, 0.22)
    s.furnish([0, 0, 0], [x, y, 0], int(x * y / s.rng.uniform(4.0, 8.0)))
    s.lamps([x, y], z, 3.0, s.rng.uniform(0.6, 1.4))
    return s.points()


def furnished_attic(seed: int) -> Array:
    """A room below a steep roof with rafters and collar beams, dormers, much furniture."""
    s = _sampler(seed, 92)
    x, y, wall = s.rng.uniform([6.0, 4.5, 0.5], [11.0, 7.0, 1.3])
    pitch = float(s.rng.uniform(0.6, 0.95))
    rise = 0.5 * y * math.tan(pitch)
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    windows = [(at, at + 0.8, 0.8, 2.0) for at in s.rng.uniform(0.5, x - 1.5, 2)]
    for side, sign in ((0.0, 1.0), (y, -1.0)):
        s.parallelogram([0, side, 0], [x, 0, 0], [0, 0, wall])
        s.parallelogram([0, side, wall], [x, 0, 0], [0, sign * y / 2, rise], windows)
    for at in (0.0, x):
        yz = s.rng.uniform([0, 0], [y, wall + rise], (int(DENSITY * y * (wall + rise)), 2))
        yz = yz[yz[:, 1] < wall + rise * (1.0 - np.abs(2.0 * yz[:, 0] / y - 1.0))]
        s.add(np.column_stack([np.full(len(yz), at), yz]))
    collar = min(2.4, wall + 0.75 * rise)
    half = 0.5 * y * (1.0 - (collar - wall) / rise)
    for at in np.arange(1.0, x - 0.5, s.rng.uniform(1.0, 2.5)):
        s.box([at, y / 2, collar], [0.12, 2 * half, 0.16], hangs=True)
    s.furnish([0, 0.5, 0], [x, y - 0.5, 0], int(x * y / s.rng.uniform(2.5, 5.0)))
    return s.points()


def cubicles(seed: int) -> Array:
    """An office of desks between low partitions, lamps in the ceiling."""
    s = _sampler(seed, 93)
    columns, rows = s.rng.integers([3, 2], [7, 5])
    x, y, z = 2.4 * columns + 3.0, 2.4 * rows + 3.0, s.rng.uniform(2.6, 3.1)
    s.floor_and_ceiling(x, y, z)
    s.walls([0, 0, 0], [x, y, z], 2, 5)
    height = s.rng.uniform(1.2, 1.6)
    for i in range(columns):
        for j in range(rows):
            at = np.array([1.5 + 2.4 * (i + 0.5), 1.5 + 2.4 * (j + 0.5), 0.0])
            s.box(at + [-1.2, 0, 0], [0.06, 2.0, height])
            s.box(at + [0, 1.1, 0], [2.3, 0.06, height])
            s.table(at + [0, 0.7, 0], np.array([1.6, 0.75, 0.74]))
            s.box(at + [0, 0.9, 0.74], [0.5, 0.1, 0.4])
            chair = at + [*s.rng.uniform(-0.3, 0.3, 2), 0.0]
            s.box(chair + [0, 0, 0.4], [0.5, 0.5, 0.1], float(s.rng.uniform(0, 3)))
            s.box(chair + [0, -0.25, 0.5], [0.45, 0.06, 0.5])
    return s.points()


def hotel(seed: int) -> Array:
    """A corridor with rooms of a bed, a desk and a wardrobe on both sides."""
    s = _sampler(seed, 94)
    num_rooms, z = int(s.rng.integers(2, 5)), s.rng.uniform(2.4, 2.8)
    x, depth, width = 3.6 * num_rooms, 5.0, 1.8
    s.shell(x, 2 * depth + width, z)
    doors = [(3.6 * k + 0.4, 3.6 * k + 1.3, 0.0, 2.1) for k in range(num_rooms) if s.rng.random() < 0.8]
    for side in (depth, depth + width):
        s.parallelogram([0, side, 0], [x, 0, 0], [0, 0, z], doors)
    for k in range(num_rooms):
        for begin, sign in ((depth, -1.0), (depth + width, 1.0)):
            s.parallelogram([3.6 * k, begin, 0], [0, sign * depth, 0], [0, 0, z])
            s.box([3.6 * k + 2.5, begin + sign * 3.2, 0], [2.0, 1.6, 0.5])
            s.box([3.6 * k + 3.5, begin + sign * 3.2, 0], [0.1, 1.8, 1.1])
            s.table([3.6 * k + 0.5, begin + sign * 3.5, 0], np.array([0.6, 1.2, 0.75]))
            s.box([3.6 * k + 2.6, begin + sign * 0.4, 0], [1.4, 0.6, 2.1])
    return s.points()


def lecture(seed: int) -> Array:
    """Rows of seats that rise in steps below a level or slanted ceiling."""
    s = _sampler(seed, 95)
    rows, rise, depth = int(s.rng.integers(7, 14)), s.rng.uniform(0.15, 0.4), s.rng.uniform(0.9, 1.1)
    y, front = s.rng.uniform([8.0, 3.0], [14.0, 5.0])
    x, z = front + rows * depth, rows * rise + s.rng.uniform(2.6, 4.0)
    s.parallelogram([0, 0, 0], [front, 0, 0], [0, y, 0])
    s.parallelogram([0, 0, z], [x, 0, 0], [0, y, 0])
    s.walls([0, 0, 0], [x, y, z], 1, 0)
    for k in range(rows):
        at, level = front + k * depth, (k + 1) * rise
        s.ground = level
        s.parallelogram([at, 0, level - rise], [0, y, 0], [0, 0, rise])
        s.parallelogram([at, 0, level], [0, y, 0], [depth, 0, 0])
        s.box([at + 0.3, y / 2, level], [0.35, y - 2.4, 0.75])
        s.box([at + 0.75, y / 2, level], [0.08, y - 2.4, 0.85])
    s.ground = 0.0
    s.table([1.5, y / 2, 0], np.array([0.8, 2.5, 0.9]))
    return s.points()
