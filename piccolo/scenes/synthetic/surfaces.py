"""Points sampled evenly on surfaces, with a scanner's noise, and the holes that scanners leave below them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from ...geometry.pose import Array
from .world import RANGE_NOISE

DENSITY = 250.0  # points a m2
WALL_DISTANCE = np.array([0.5, 0.5, 0.0])  # of furniture [m]
WALL_THICKNESS = (0.08, 0.3)  # [m]
SKIN = 0.03  # of a box: what lies deeper inside is hidden [m]
STATION_AREA = 40.0  # of ground for each scanner position [m2]
BLIND_ANGLE = math.radians(30.0)  # around straight down, where a scanner sees nothing
EYES = (1.2, 1.9)  # heights of scanners above the ground they stand on [m]
NUM_EYES = 3
GRAZING = 0.3  # difference in height from which on a scanner sees most of a level face [m]
FROM_THE_AIR = 100.0  # height of a drone [m]
HEADROOM = (0.15, 1.7)  # above the ground, empty where a tripod stands [m]
FOOTING = 0.5  # radius around a tripod in which the ground is whole [m]
Opening = tuple[float, float, float, float]  # from and to along each edge [m]


@dataclass
class SurfaceSampler:
    """Points on surfaces as they are added; z is up.

    Of boxes, a scanner sees the tops below its eye and the undersides above it, fewer points near its height.
    """

    rng: np.random.Generator
    density: float = DENSITY  # [1/m2]
    is_from_above: bool = False  # seen by a drone
    ground: float = 0.0  # height of what scanners stand on, where boxes are added [m]
    parts: list[Array] = field(default_factory=list)
    hidden: list[tuple[Array, Array, float]] = field(default_factory=list)  # middles, sizes, yaws of boxes
    eyes: Array = field(init=False)  # heights of scanners above the ground [m]

    def __post_init__(self) -> None:
        self.eyes = np.full(1, FROM_THE_AIR) if self.is_from_above else self.rng.uniform(*EYES, NUM_EYES)

    def parallelogram(
        self,
        corner: ArrayLike,
        a: ArrayLike,
        b: ArrayLike,
        openings: Sequence[Opening] = (),
        seen: float = 1.0,
    ) -> None:
        """Points from `corner` along the edges `a` and `b` (3,) [m], none in the openings, a part `seen`."""
        edge_a, edge_b = np.asarray(a, float), np.asarray(b, float)
        area = seen * float(np.linalg.norm(np.cross(edge_a, edge_b)))
        s = self.rng.uniform(0.0, 1.0, (int(self.density * area) + 1, 2))
        x, y = s[:, 0] * np.linalg.norm(edge_a), s[:, 1] * np.linalg.norm(edge_b)
        for x0, x1, y0, y1 in openings:
            is_kept = (x < x0) | (x > x1) | (y < y0) | (y > y1)
            s, x, y = s[is_kept], x[is_kept], y[is_kept]
        self.add(np.asarray(corner) + s[:, :1] * edge_a + s[:, 1:] * edge_b)

    def add(self, points: Array) -> None:
        """Points (N, 3) [m], blurred by the scanner's noise."""
        self.parts.append(points + self.rng.normal(0.0, RANGE_NOISE, points.shape))

    def box(self, center: ArrayLike, size: ArrayLike, yaw: float = 0.0, *, hangs: bool = False) -> None:
        """A box of `size` (3,), its bottom's centre at `center` (3,) [m]; top and bottom as they are seen.

        What is inside, and the floor below, or the ceiling above one that `hangs`, is hidden.
        """
        x, y, z = np.asarray(size, float)
        c, s = np.cos(yaw), np.sin(yaw)
        along, across, up = np.array([c * x, s * x, 0.0]), np.array([-s * y, c * y, 0.0]), np.array([0, 0, z])
        corner = np.asarray(center) - 0.5 * (along + across)
        for origin, a in (
            (corner, along), (corner + across, along), (corner, across), (corner + along, across)
        ):  # fmt: skip
            self.parallelogram(origin, a, up)
        seen_below = self.seen_from_below(corner[2])
        for origin, seen in ((corner, seen_below), (corner + up, self.seen_from_above(corner[2] + z))):
            if seen > 0.0:
                self.parallelogram(origin, along, across, seen=seen)
        shift = 2.0 * SKIN if hangs else 0.0 if seen_below else -2.0 * SKIN
        thickness = z if shift else z - 2.0 * SKIN  # of one that floats, top and bottom are in sight
        self.hidden.append(
            (np.asarray(center) + [0.0, 0.0, 0.5 * z + shift], np.array([x, y, thickness]), yaw)
        )

    def floor_and_ceiling(self, x: float, y: float, z: float) -> None:
        """Level rectangles from the origin to (x, y), at heights of 0 and z."""
        for height in (0.0, z):
            self.parallelogram([0, 0, height], [x, 0, 0], [0, y, 0])

    def shell(self, x: float, y: float, z: float) -> None:
        """The inside of a box from the origin to (x, y, z): floor, ceiling and walls."""
        self.floor_and_ceiling(x, y, z)
        self.walls([0, 0, 0], [x, y, z])

    def walls(self, corner: ArrayLike, size: ArrayLike, num_doors: int = 0, num_windows: int = 0) -> None:
        """Four walls around a rectangle, with doorways and windows at random."""
        x, y, z = np.asarray(size, float)
        sides: list[list[Opening]] = [[], [], [], []]
        lengths = (x, x, y, y)
        for k in range(num_doors + num_windows):
            side = int(self.rng.integers(4))
            at = self.rng.uniform(0.2, max(lengths[side] - 1.2, 0.3))
            is_door = k < num_doors
            sides[side].append((at, at + (0.9 if is_door else 1.0), *((0.0, 2.1) if is_door else (0.9, 2.1))))
        low = np.asarray(corner, float)
        for origin, a, outward, openings in (
            (low, [x, 0, 0], [0, -1, 0], sides[0]), (low + [0, y, 0], [x, 0, 0], [0, 1, 0], sides[1]),
            (low, [0, y, 0], [-1, 0, 0], sides[2]), (low + [x, 0, 0], [0, y, 0], [1, 0, 0], sides[3]),
        ):  # fmt: skip
            self.pierced_wall(origin, a, z, np.array(outward), openings)

    def pierced_wall(
        self, corner: ArrayLike, a: ArrayLike, height: float, outward: Array, openings: Sequence[Opening]
    ) -> None:
        """A wall on the edge `a` (3,) [m]; its openings have sills, lintels and jambs."""
        origin, edge = np.asarray(corner, float), np.asarray(a, float)
        self.parallelogram(origin, edge, [0, 0, height], openings)
        along, depth = edge / np.linalg.norm(edge), self.rng.uniform(*WALL_THICKNESS) * outward
        for x0, x1, y0, y1 in openings:
            foot = origin + x0 * along
            sill, lintel = self.seen_from_above(origin[2] + y0), self.seen_from_below(origin[2] + y1)
            for level, seen in ((y0, sill if y0 else 0.0), (y1, lintel)):
                if seen > 0.0:
                    self.parallelogram(foot + [0, 0, level], (x1 - x0) * along, depth, seen=seen)
            for at in (0.0, x1 - x0):
                self.parallelogram(foot + at * along + [0, 0, y0], [0, 0, y1 - y0], depth)

    def seen_from_above(self, height: float) -> float:
        """The fraction [0, 1] of a level face's points that scanners above it see."""
        return float(np.mean(1.0 - np.exp(-(self.eyes + self.ground - height).clip(0.0) / GRAZING)))

    def seen_from_below(self, height: float) -> float:
        """The fraction [0, 1] of a level face's points that scanners below it see."""
        return float(np.mean(1.0 - np.exp(-(height - self.eyes - self.ground).clip(0.0) / GRAZING)))

    def furnish(self, low: ArrayLike, high: ArrayLike, num_pieces: int) -> None:
        """Tables, shelves and boxes on the floor between two corners (3,), cupboards hung at their sides."""
        first, last = np.asarray(low, float), np.asarray(high, float)
        for _ in range(num_pieces):
            at = self.rng.uniform(first + WALL_DISTANCE, last - WALL_DISTANCE)
            at[2] = first[2]
            yaw = float(self.rng.normal(0.0, 0.3))
            kind = self.rng.random()
            if kind < 0.3:
                self.table(at, self.rng.uniform([0.8, 0.6, 0.7], [1.8, 0.9, 0.78]), yaw)
            elif kind < 0.5:
                self.shelf(at, self.rng.uniform([0.7, 0.3, 1.0], [1.2, 0.45, 2.1]), yaw)
            elif kind < 0.9:
                self.box(at, self.rng.uniform([0.3, 0.3, 0.3], [1.6, 0.8, 1.2]), yaw)
            else:
                hung = [at[0], self.rng.choice([first[1], last[1]]), at[2] + self.rng.uniform(1.3, 1.6)]
                self.box(hung, self.rng.uniform([0.6, 0.5, 0.4], [1.8, 0.8, 0.8]))

    def table(self, at: ArrayLike, size: Array, yaw: float = 0.0) -> None:
        """A slab on four legs; `size` (3,) with its height."""
        x, y, z = size
        foot, c, s = np.asarray(at, float), np.cos(yaw), np.sin(yaw)
        self.box(foot + [0, 0, z - 0.05], [x, y, 0.05], yaw)
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            p, q = dx * (0.5 * x - 0.05), dy * (0.5 * y - 0.05)
            self.box(foot + [c * p - s * q, s * p + c * q, 0.0], [0.05, 0.05, z - 0.05], yaw)

    def shelf(self, at: ArrayLike, size: Array, yaw: float = 0.0, pitch: float = 0.4) -> None:
        """Boards every `pitch` metres before a back, with things on them."""
        x, y, z = size
        foot, across = np.asarray(at, float), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        self.box(foot + 0.5 * y * across, [x, 0.03, z], yaw)
        for level in np.arange(0.05, z, pitch):
            self.box(foot + [0, 0, level], [x, y, 0.03], yaw)
            goods = self.rng.uniform([0.3 * x, 0.3 * y, 0.2 * pitch], [0.95 * x, 0.8 * y, 0.8 * pitch])
            self.box(foot + [0, 0, level + 0.03], goods, yaw)

    def car(self, at: ArrayLike, yaw: float) -> None:
        """A body on wheels, a narrower cabin; the ground below is not seen."""
        foot = np.asarray(at, float)
        length, width = self.rng.uniform([3.8, 1.7], [4.9, 1.95])
        self.box(foot + [0, 0, 0.25], [length, width, 0.6], yaw)
        self.box(foot + [0, 0, 0.85], [0.5 * length, 0.85 * width, 0.55], yaw)
        for dx, dy in ((-0.32, -0.45), (-0.32, 0.45), (0.32, -0.45), (0.32, 0.45)):
            p, q = dx * length, dy * width
            wheel = [np.cos(yaw) * p - np.sin(yaw) * q, np.sin(yaw) * p + np.cos(yaw) * q, 0.0]
            self.box(foot + wheel, [0.6, 0.2, 0.5], yaw)
        self.hidden.append((foot + [0, 0, 0.1], np.array([length, width, 0.4]), yaw))

    def cylinder(self, start: ArrayLike, along: ArrayLike, radius: float) -> None:
        """The side of a cylinder from `start` (3,) by `along` (3,): a column, a pipe, a trunk."""
        axis = np.asarray(along, float)
        length = float(np.linalg.norm(axis))
        s = self.rng.uniform(0.0, 1.0, (int(self.density * math.tau * radius * length) + 1, 2))
        across = np.linalg.svd(axis[None])[2][1:]
        ring = radius * np.column_stack([np.cos(math.tau * s[:, 1]), np.sin(math.tau * s[:, 1])])
        self.add(np.asarray(start) + s[:, :1] * axis + ring @ across)

    def beams(self, size: ArrayLike, z: float, spacing: float, drop: float) -> None:
        """Beams across a ceiling at height z, every `spacing` metres along x, `drop` high."""
        x, y = np.asarray(size, float)[:2]
        for at in np.arange(0.5 * spacing, x, spacing):
            self.box([at, y / 2, z - drop], [self.rng.uniform(0.12, 0.3), y, drop], hangs=True)

    def lamps(self, size: ArrayLike, z: float, spacing: float, drop: float) -> None:
        """Rows of lamps below a ceiling at height z, hung `drop` metres low."""
        x, y = np.asarray(size, float)[:2]
        for at_x in np.arange(0.5 * spacing, x, spacing):
            for at_y in np.arange(0.5 * spacing, y, spacing):
                self.box([at_x, at_y, z - drop - 0.08], [1.2, 0.2, 0.08], hangs=True)

    def points(self) -> Array:
        """All points (N, 3) but those hidden inside boxes."""
        points = np.concatenate(self.parts)
        is_kept = np.ones(len(points), np.bool_)
        for middle, size, yaw in self.hidden:
            near = np.flatnonzero(np.abs(points[:, 0] - middle[0]) < 0.5 * (size[0] + size[1]))
            x, y, z = (points[near] - middle).T
            c, s = np.cos(yaw), np.sin(yaw)
            along, across = np.abs(c * x + s * y), np.abs(c * y - s * x)
            half = 0.5 * size - [SKIN, SKIN, 0.0]
            is_kept[near[(along < half[0]) & (across < half[1]) & (np.abs(z) < half[2])]] = False
        return points[is_kept]


def with_station_holes(points: Array, rng: np.random.Generator) -> Array:
    """The points (N, 3), z up, without what is right below scanner positions that are drawn on the ground."""
    tree = cKDTree(points[:, :2])
    area = float(np.prod(np.ptp(points[:, :2], axis=0)))
    num_stations, is_kept = 1 + int(area / STATION_AREA), np.ones(len(points), np.bool_)
    for at in points[rng.permutation(len(points))[: 60 * num_stations]]:
        near = np.array(tree.query_ball_point(at[:2], FOOTING))
        heights = points[near, 2] - at[2]
        is_blocked = np.any((heights > HEADROOM[0]) & (heights < HEADROOM[1])) or np.any(heights < -0.3)
        quadrants = np.unique((points[near] > at)[np.abs(heights) < 0.1][:, :2] @ [1, 2])
        if is_blocked or len(quadrants) < 4:
            continue
        height = float(rng.uniform(1.3, 1.8))
        below = np.array(tree.query_ball_point(at[:2], height * math.tan(BLIND_ANGLE)))
        drop = at[2] + height - points[below, 2]
        away = np.linalg.norm(points[below, :2] - at[:2], axis=1)
        is_kept[below[away < drop * math.tan(BLIND_ANGLE)]] = False
        num_stations -= 1
        if num_stations == 0:
            break
    return points[is_kept]
