"""Seeded clouds of halls and the like: showroom, racks, shop, garage, church, tunnel, basement."""

import math

import numpy as np

from ...geometry.pose import Array
from .surfaces import SurfaceSampler

DENSITY = 90.0  # points a m2: about what a search for up keeps


def _sampler(seed: int, stream: int) -> SurfaceSampler:
    return SurfaceSampler(np.random.default_rng([seed, stream]), DENSITY)


def showroom(seed: int) -> Array:
    """Cars below an open ceiling with beams, ducts and lamps, a glass front on one or two sides."""
    s = _sampler(seed, 80)
    x, y, z = s.rng.uniform([14.0, 10.0, 3.8], [26.0, 18.0, 6.0])
    s.floor_and_ceiling(x, y, z)
    s.parallelogram([0, y, 0], [x, 0, 0], [0, 0, z], [(2.0, 3.0, 0.0, 2.1)])
    s.parallelogram([x, 0, 0], [0, y, 0], [0, 0, z])
    panes = [(at + 0.05, at + 1.45, 0.1, z - 0.3) for at in np.arange(0.0, x - 1.5, 1.5)]
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, 0, z], panes)
    is_glass = bool(s.rng.random() < 0.5)
    panes = [(at + 0.05, at + 1.45, 0.1, z - 0.3) for at in np.arange(0.0, y - 1.5, 1.5)]
    s.parallelogram([0, 0, 0], [0, y, 0], [0, 0, z], panes if is_glass else ())
    s.beams([x, y], z, s.rng.uniform(1.2, 3.0), s.rng.uniform(0.3, 0.7))
    s.lamps([x, y], z, s.rng.uniform(2.0, 3.5), s.rng.uniform(0.6, 1.2))
    for at in s.rng.uniform(0.0, y, int(s.rng.integers(1, 4))):
        s.cylinder([0, at, z - 0.9], [x, 0, 0], 0.25)
    for at_x in np.arange(3.0, x - 2.0, 5.5):
        for at_y in np.arange(2.0, y - 1.5, 3.5):
            if s.rng.random() < 0.7:
                s.car([at_x, at_y, 0.0], float(s.rng.normal(0.3, 0.3)))
    s.furnish([0, y - 3, 0], [x, y, 0], int(s.rng.integers(2, 6)))
    return s.points()


def racks(seed: int) -> Array:
    """A hall of racks with pallets, up to the roof."""
    s = _sampler(seed, 81)
    x, y, z = s.rng.uniform([18.0, 12.0, 5.0], [30.0, 20.0, 9.0])
    s.shell(x, y, z)
    s.beams([x, y], z, 5.0, 0.4)
    pitch = s.rng.uniform(1.2, 1.8)
    for at_y in np.arange(2.0, y - 1.5, s.rng.uniform(3.2, 4.2)):
        for at_x in np.arange(2.5, x - 2.0, 2.8):
            for level in np.arange(0.0, z - pitch, pitch):
                if level:
                    s.box([at_x, at_y, level - 0.1], [2.7, 1.1, 0.1])
                for shift in (-0.65, 0.65):
                    if s.rng.random() < 0.8:
                        size = s.rng.uniform([0.8, 0.8, 0.5], [1.2, 1.0, pitch - 0.2])
                        s.box([at_x + shift, at_y, level], size)
            s.box([at_x - 1.37, at_y - 0.5, 0], [0.1, 0.1, z - 0.6])
            s.box([at_x - 1.37, at_y + 0.5, 0], [0.1, 0.1, z - 0.6])
    return s.points()


def shop(seed: int) -> Array:
    """Rows of shelves, a counter, lamps below the ceiling."""
    s = _sampler(seed, 82)
    x, y, z = s.rng.uniform([9.0, 7.0, 2.8], [18.0, 14.0, 4.0])
    s.floor_and_ceiling(x, y, z)
    s.walls([0, 0, 0], [x, y, z], 1, 2)
    s.lamps([x, y], z, 2.4, s.rng.uniform(0.0, 0.6))
    height = s.rng.uniform(1.4, 2.2)
    for at_y in np.arange(1.8, y - 1.5, 2.2):
        for at_x in np.arange(2.0, x - 1.5, 1.25):
            s.shelf([at_x, at_y, 0], np.array([1.2, 0.5, height]))
            s.shelf([at_x, at_y + 0.5, 0], np.array([1.2, 0.5, height]), math.pi)
    s.box([1.0, 1.0, 0], [0.8, 1.6, 1.0])
    return s.points()


def warehouse(seed: int) -> Array:
    """Stacks of boxes below a slightly pitched roof with beams."""
    s = _sampler(seed, 83)
    x, y, z = s.rng.uniform([18.0, 14.0, 5.0], [34.0, 22.0, 8.0])
    rise = float(s.rng.uniform(0.0, 1.5))
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.walls([0, 0, 0], [x, y, z], 3, 4)
    s.parallelogram([0, 0, z], [x, 0, 0], [0, y / 2, rise])
    s.parallelogram([0, y, z], [x, 0, 0], [0, -y / 2, rise])
    s.beams([x, y], z, 5.0, 0.5)
    for _ in range(int(x * y / 14)):
        size = s.rng.uniform([0.8, 0.8, 0.6], [2.4, 1.6, 3.0])
        s.box(
            [*s.rng.uniform([1.5, 1.5], [x - 1.5, y - 1.5]), 0.0], size, float(s.rng.choice([0.0, 0.1, 1.57]))
        )
    return s.points()


def garage(seed: int) -> Array:
    """A car or two, shelves along a wall, an opener's rail below the ceiling."""
    s = SurfaceSampler(np.random.default_rng([seed, 84]))
    num_cars = int(s.rng.integers(1, 3))
    x, y, z = s.rng.uniform([5.8, 3.0 * num_cars, 2.3], [7.5, 3.0 * num_cars + 1.5, 2.9])
    s.floor_and_ceiling(x, y, z)
    s.walls([0, 0, 0], [x, y, z], 1, 1)
    for k in range(num_cars):
        if s.rng.random() < 0.8:
            s.car(
                [0.5 * x + s.rng.uniform(-0.4, 0.4), (k + 0.5) * y / num_cars, 0.0],
                float(s.rng.normal(0, 0.03)),
            )
        s.box([0.5 * x, (k + 0.5) * y / num_cars, z - 0.25], [3.0, 0.1, 0.1], hangs=True)
    for at in np.arange(0.8, x - 0.8, 1.1):
        if s.rng.random() < 0.6:
            s.shelf([at, 0.25, 0], s.rng.uniform([1.0, 0.3, 1.2], [1.05, 0.5, 2.0]), math.pi)
    return s.points()


def church(seed: int) -> Array:
    """A high nave with pews, columns and a barrel vault."""
    s = _sampler(seed, 85)
    x, y, wall = s.rng.uniform([16.0, 8.0, 5.0], [28.0, 13.0, 9.0])
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.walls([0, 0, 0], [x, y, wall], 1, 0)
    t = s.rng.uniform(0.0, 1.0, (int(DENSITY * x * y * math.pi / 2), 2))
    vault = np.column_stack([t[:, 0] * x, 0.5 * y * (1 - np.cos(math.pi * t[:, 1]))])
    s.add(np.column_stack([vault, wall + 0.5 * y * np.sin(math.pi * t[:, 1])]))
    for at in np.arange(3.0, x - 4.0, 4.0):
        for side in (1.2, y - 1.2):
            s.cylinder([at, side, 0], [0, 0, wall], 0.35)
    for at in np.arange(3.0, x - 5.0, 1.0):
        for side in (0.32 * y, 0.68 * y):
            s.box([at, side, 0.0], [0.4, 0.25 * y, 0.45])
            s.box([at + 0.2, side, 0.0], [0.05, 0.25 * y, 0.95])
    s.box([x - 2.0, y / 2, 0], [3.0, 0.6 * y, 0.4])
    s.box([x - 2.0, y / 2, 0.4], [0.9, 2.0, 1.0])
    return s.points()


def tunnel(seed: int) -> Array:
    """A tube with a road, walkways on both sides, pipes or fans above."""
    s = _sampler(seed, 86)
    x, radius = float(s.rng.uniform(20.0, 45.0)), float(s.rng.uniform(3.0, 5.0))
    s.ground = level = -0.45 * radius
    half = math.sqrt(radius**2 - level**2)
    t = s.rng.uniform(0.0, 1.0, (int(DENSITY * x * 4.2 * radius), 2))
    angle = -0.45 + t[:, 1] * (math.pi + 0.9)
    s.add(np.column_stack([t[:, 0] * x, radius * np.cos(angle), radius * np.sin(angle)]))
    s.parallelogram([0, -half, level], [x, 0, 0], [0, 2 * half, 0])
    for side in (-1, 1):
        s.box([x / 2, side * (half - 0.4), level], [x, 0.8, 0.25])
    s.cylinder([0, 0.5 * radius, 0.7 * radius], [x, 0, 0], 0.15)
    for at in np.arange(4.0, x - 3.0, 8.0):
        s.box([at, 0.0, 0.8 * radius], [1.2, 0.4, 0.2], hangs=True)
        if s.rng.random() < 0.3:
            s.car([at, s.rng.uniform(-1.5, 1.5), level], 0.0)
    return s.points()


def parking(seed: int) -> Array:
    """A parking deck: low ceiling with beams, columns, cars, open sides with parapets."""
    s = _sampler(seed, 87)
    x, y, z = s.rng.uniform([20.0, 14.0, 2.4], [32.0, 17.0, 3.0])
    s.floor_and_ceiling(x, y, z)
    s.walls([0, 0, 0], [x, y, 1.0])
    s.beams([x, y], z, 5.0, 0.4)
    for at_x in np.arange(2.5, x - 0.5, 5.0):
        for at_y in (5.2, y - 5.2):
            s.box([at_x, at_y, 0], [0.4, 0.4, z])
    for at_x in np.arange(1.6, x - 1.2, 2.5):
        for at_y in (2.7, y - 2.7):
            if s.rng.random() < 0.5:
                s.car([at_x, at_y, 0.0], math.pi / 2 + float(s.rng.normal(0, 0.03)))
    return s.points()


def basement(seed: int) -> Array:
    """Pipes and ducts below a low ceiling, a boiler, shelves, piles."""
    s = SurfaceSampler(np.random.default_rng([seed, 88]))
    x, y, z = s.rng.uniform([5.0, 4.0, 2.1], [11.0, 8.0, 2.7])
    s.floor_and_ceiling(x, y, z)
    s.walls([0, 0, 0], [x, y, z], 2, 1)
    for _ in range(int(s.rng.integers(3, 9))):
        radius, drop = s.rng.uniform([0.03, 0.15], [0.12, 0.5])
        if s.rng.random() < 0.5:
            s.cylinder([0, s.rng.uniform(0.2, y - 0.2), z - drop], [x, 0, 0], radius)
        else:
            s.cylinder([s.rng.uniform(0.2, x - 0.2), 0, z - drop], [0, y, 0], radius)
    s.box([x / 2, s.rng.uniform(0.8, y - 0.8), z - 0.45], [x, 0.4, 0.3], hangs=True)
    s.cylinder([0.8, 0.8, 0.1], [0, 0, 1.5], 0.4)
    s.furnish([0, 0, 0], [x, y, 0], int(x * y / 4))
    return s.points()
