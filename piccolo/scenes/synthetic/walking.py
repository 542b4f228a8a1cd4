"""A person who walks through a building with a camera: where the camera is and looks at every moment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from ...geometry.pose import Array, Pose, exp_so3, yaw_rotation
from .floor_paths import FreeSpace, Reach, free_space_of, reach_from
from .office import Office

HEIGHT = 1.6  # of the camera above the floor [m]
SPACING, TICK = 0.02, 0.02  # of the path [m] and of its times [s]
SMOOTHING = (0.35, 0.2, 0.1, 0.0)  # of corners, standard deviation [m]; the first that keeps LEAST_CLEARANCE
LEAST_CLEARANCE = 0.2  # from what is in a person's way [m]
PACE, ON_STAIRS, SLOWEST = (1.1, 1.4), 0.55, 0.15  # [m/s], fraction of it, [m/s]
ACCELERATION = 0.8  # [m/s2]
PAUSES = (1.0, 3.0)  # in each room [s]
TURNING = 0.5  # how long a turn of the head is spread, standard deviation [s]
SWAY, TILT, BOB = (
    0.12,
    0.02,
    0.015,
)  # of heading and of pitch and roll [rad], of the height [m]; std, std, amplitude
STRIDES = 1.8  # [1/s]
NEAR_FRACTION, NUM_NEAR = 0.7, 6  # of the rooms visited next, those among the nearest


@dataclass(frozen=True)
class Walk:
    """The camera of a person who walks, at every TICK."""

    feet: Array  # (T, 3) on the floor [m]
    yaws: Array  # (T,) of the camera, not wrapped [rad]
    leans: Array  # (T, 3) rotation vectors in the camera's frame, small [rad]
    bobs: Array  # (T,) [m]

    @property
    def duration(self) -> float:
        """[s]."""
        return TICK * (len(self.feet) - 1)

    def num_frames(self, rate: float) -> int:
        """How many frames are taken, `rate` a second from the beginning on."""
        return int(self.duration * rate + 1e-9) + 1

    def _at(self, values: Array, time: float) -> Array:
        """Values between ticks."""
        k = min(int(time / TICK), len(values) - 2)
        f = time / TICK - k
        return np.asarray((1.0 - f) * values[k] + f * values[k + 1])

    def foot(self, time: float) -> Array:
        """Where the person stands (3,) [m]."""
        return self._at(self.feet, time)

    def yaw(self, time: float) -> float:
        """Where the person looks [rad]."""
        return float(self._at(self.yaws, time))

    def pose(self, time: float) -> Pose:
        """Of the camera, at a time from 0 to the duration [s]."""
        center_world = self.foot(time) + np.array([0.0, 0.0, HEIGHT + float(self._at(self.bobs, time))])
        return Pose(exp_so3(self._at(self.leans, time)) @ yaw_rotation(self.yaw(time)), center_world)


class Walker:
    """Draws walks through one building."""

    def __init__(self, office: Office) -> None:
        self.office, self.space = office, free_space_of(office)
        corridor = office.world.rooms[office.num_rooms]
        middle = corridor.corner + corridor.size * [0.5, 0.5, 0.0]
        self.everywhere = reach_from(self.space, self.space.cell(middle))  # but what furniture encloses

    def walk(self, length: float, visited: Sequence[int], rng: np.random.Generator) -> Walk:
        """A walk of so many metres through rooms, the given ones first, then others at random."""
        legs = smooth_legs(self.space, self._legs(length, visited, rng), length)
        return timed(legs, rng)

    def _legs(self, length: float, visited: Sequence[int], rng: np.random.Generator) -> list[Array]:
        """Ways (M, 3) from room to room until they are long enough."""
        left, legs, done = list(visited), list[Array](), 0.0
        number = left.pop(0) if left else int(rng.integers(self.office.num_rooms))
        cell = int(rng.choice(_reached(self.everywhere, number)))
        seen = {number}
        while done < length:
            reach = reach_from(self.space, cell)
            number = left.pop(0) if left else self._next(reach, seen, rng)
            seen.add(number)
            cell = int(rng.choice(_reached(reach, number)))
            legs.append(reach.way(cell))
            done += float(np.linalg.norm(np.diff(legs[-1], axis=0), axis=1).sum())
        return legs

    def _next(self, reach: Reach, seen: set[int], rng: np.random.Generator) -> int:
        """The next room, mostly one of the nearest that were not seen; all again when all were."""
        if len(seen) >= self.office.num_rooms:
            seen.clear()
        unseen = [k for k in range(self.office.num_rooms) if k not in seen]
        costs = [reach.costs[self.space.cells_of_room(k)].min() for k in unseen]
        order = [unseen[k] for k in np.argsort(costs, kind="stable")]
        return int(rng.choice(order[:NUM_NEAR] if rng.random() < NEAR_FRACTION else order))


def _reached(reach: Reach, number: int) -> NDArray[np.int64]:
    """The cells of a room that can be reached: at least those before its door."""
    cells = reach.space.cells_of_room(number)
    return cells[np.isfinite(reach.costs[cells])]


def smooth_legs(space: FreeSpace, ways: Sequence[Array], length: float) -> list[Array]:
    """Ways without corners, a point every SPACING, up to a length [m]."""
    legs, left = [], length
    for way in ways:
        for sigma in SMOOTHING:
            leg = _smooth(way, sigma)
            if sigma == 0.0 or _clearance(space, leg) >= LEAST_CLEARANCE:
                break
        distance = _distances(leg)
        legs.append(leg[: int(np.searchsorted(distance, left)) + 1])
        left -= float(distance[-1])
        if left <= 0.0:
            break
    return legs


def _clearance(space: FreeSpace, leg: Array) -> float:
    """The least clearance of points (N, 3) that are on a floor, not on stairs [m]."""
    heights = np.abs(leg[:, 2:] - space.office.levels).min(axis=1)
    return float(space.clearance_at(leg[heights < 1e-3]).min())


def _distances(points: Array) -> Array:
    """The way (N,) along points (N, 3) [m], level."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])


def _smooth(way: Array, sigma: float) -> Array:
    """A way (N, 3) evenly spaced, its corners rounded in the plan; its ends stay."""
    distance = _distances(way)
    at = np.linspace(0.0, distance[-1], max(2, int(distance[-1] / SPACING)))
    points = np.column_stack([np.interp(at, distance, way[:, k]) for k in range(3)])
    pad = min(len(points) - 1, int(4.0 * sigma / SPACING))
    if pad:
        padded = np.pad(points[:, :2], ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
        points[:, :2] = gaussian_filter1d(padded, sigma / SPACING, axis=0)[pad:-pad]
    return points


def speeds(leg: Array, pace: float) -> Array:
    """The speed (N,) [m/s] at points (N, 3): slower in turns and on stairs, from slowest to slowest."""
    distance = _distances(leg)
    step = np.gradient(leg, axis=0)
    headings = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    curvature = np.abs(gaussian_filter1d(np.gradient(headings), 5.0)) / SPACING
    found = pace / (1.0 + 0.5 * curvature) * np.where(np.abs(step[:, 2]) > 0.1 * SPACING, ON_STAIRS, 1.0)
    found[[0, -1]] = SLOWEST
    for some, ways in ((found, distance), (found[::-1], distance[::-1])):
        for k, step_ in enumerate(np.abs(np.diff(ways))):
            some[k + 1] = min(some[k + 1], np.sqrt(some[k] ** 2 + 2.0 * ACCELERATION * step_))
    return np.asarray(np.maximum(found, SLOWEST))


def timed(legs: Sequence[Array], rng: np.random.Generator) -> Walk:
    """The legs at a person's speed, with a pause after each but the last."""
    pace = float(rng.uniform(*PACE))
    points, times, headings = [], [], []
    now = 0.0
    for leg in legs:
        speed = speeds(leg, pace)
        steps = np.diff(_distances(leg)) / (0.5 * (speed[1:] + speed[:-1]))
        times.append(now + np.concatenate([[0.0], np.cumsum(steps)]))
        points.append(leg)
        step = np.gradient(leg[:, :2], axis=0)
        headings.append(np.arctan2(step[:, 1], step[:, 0]))
        now = float(times[-1][-1]) + float(rng.uniform(*PAUSES))
    at, way = np.concatenate(times), np.concatenate(points)
    ticks = TICK * np.arange(int(at[-1] / TICK) + 1)
    feet = np.column_stack([np.interp(ticks, at, way[:, k]) for k in range(3)])
    yaws = np.interp(ticks, at, np.unwrap(np.concatenate(headings)))
    moving = np.linalg.norm(np.gradient(feet, TICK, axis=0), axis=1) / pace
    leans = np.column_stack([*(TILT * _noise(len(ticks), 0.4, rng) for _ in range(2)), np.zeros(len(ticks))])
    yaws = gaussian_filter1d(yaws, TURNING / TICK, mode="nearest") + SWAY * _noise(len(ticks), 1.5, rng)
    bobs = BOB * np.clip(moving, 0.0, 1.0) * np.sin(2.0 * np.pi * STRIDES * ticks)
    return Walk(feet, yaws, leans, bobs)


def _noise(count: int, sigma: float, rng: np.random.Generator) -> Array:
    """Smooth noise (count,) of standard deviation 1 over ticks that are alike within `sigma` [s]."""
    pad = int(4.0 * sigma / TICK)
    smooth = gaussian_filter1d(rng.normal(size=count + 2 * pad), sigma / TICK)[pad : pad + count]
    return np.asarray(smooth * np.sqrt(2.0 * np.sqrt(np.pi) * sigma / TICK))
