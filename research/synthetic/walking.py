"""A person who walks through a building with a camera: where the camera is and looks at every moment.

Ways are the cheapest over a grid a storey of where a person can stand, joined along the stairs.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.system.arrays import Array, Int32s, Int64s, Mask

from .office import FLIGHT_WIDTH, Flight, Office

CELL = 0.1  # [m]
STEP_OVER = 0.15  # what is higher is in a person's way [m]
HEAD = 1.85  # and what is lower than this [m]
MIN_DISTANCE = 0.3  # from things [m]
NEAR_THINGS = 0.25  # how soon a place costs less farther from things [m]
PRICE = 2.0  # of a place near things
LANDING = 0.4  # between the stairs and where one turns [m]
HEIGHT = 1.6  # of the camera above the floor [m]
SPACING = 0.02  # of the path [m]
TICK = 0.02  # of its times [s]
SMOOTHING = (0.35, 0.2, 0.1, 0.0)  # of corners, standard deviation [m]; the first that keeps LEAST_CLEARANCE
LEAST_CLEARANCE = 0.2  # from what is in a person's way [m]
PACE = (1.1, 1.4)  # [m/s]
ON_STAIRS = 0.55  # fraction of it
SLOWEST = 0.15  # [m/s]
ACCELERATION = 0.8  # [m/s2]
PAUSES = (1.0, 3.0)  # in each room [s]
TURNING = 0.5  # how long a turn of the head is spread, standard deviation [s]
SWAY = 0.12  # of the heading, standard deviation [rad]
TILT = 0.02  # of pitch and roll, standard deviation [rad]
BOB = 0.015  # of the height, amplitude [m]
STRIDES = 1.8  # [1/s]
NEAR_FRACTION = 0.7  # of the rooms visited next, those among the nearest
NUM_NEAR = 6

Cells = Int64s


class Reach(NamedTuple):
    """The cheapest ways from a cell to all others."""

    costs: Array  # (N,) inf for what can't
    before: Int32s  # (N,) the cell before each on its way, negative at the start


class Floors:
    """The floors on which a person can walk in a building, and the costs from cell to cell."""

    def __init__(self, office: Office) -> None:
        rooms = office.world.rooms
        boxes = rooms[0].boxes
        self.office = office
        self.origin = np.min([room.corner[:2] for room in rooms], axis=0) - CELL  # of the first cell [m]
        end = np.max([room.corner[:2] + room.size[:2] for room in rooms], axis=0) + CELL
        num_x, num_y = np.ceil((end - self.origin) / CELL).astype(int)
        is_blocked = np.zeros((len(office.levels), num_y, num_x), np.bool_)
        for is_blocked_here, level in zip(is_blocked, office.levels, strict=True):
            is_in_the_way = boxes[:, 2] + boxes[:, 5] > level + STEP_OVER
            is_in_the_way &= boxes[:, 2] - boxes[:, 5] < level + HEAD
            for box in boxes[is_in_the_way]:
                self._block(is_blocked_here, box)
        for storey, flight in enumerate(office.flights, start=1):
            middle = (flight.foot + flight.top) / 2
            opening = np.array([*middle, FLIGHT_WIDTH / 2, flight.run / 2, 0.0, 0.0])
            self._block(is_blocked[storey], opening)
        # (S, Y, X) distance of each cell to what is in the way [m]
        self.clearance = np.stack([CELL * distance_transform_edt(~blocked) for blocked in is_blocked])
        landing = np.array([0.0, LANDING, 0.0])
        self.stairs = {(self.cell(f.foot - landing), self.cell(f.top + landing)): f for f in office.flights}
        self.costs = _costs(self.clearance, self.stairs)

    def _block(self, is_blocked: Mask, box: Array) -> None:
        """Mark the cells (Y, X) whose middle is in a box (7,) or less than half a cell off it."""
        reach = float(np.hypot(box[3], box[4])) + CELL
        x0, y0 = np.maximum(((box[:2] - reach - self.origin) / CELL).astype(int), 0)
        x1, y1 = ((box[:2] + reach - self.origin) / CELL).astype(int) + 1
        part = is_blocked[y0:y1, x0:x1]
        dy, dx = np.indices(part.shape) + np.array([y0, x0])[:, None, None] + 0.5
        dx = CELL * dx + self.origin[0] - box[0]
        dy = CELL * dy + self.origin[1] - box[1]
        c = np.cos(box[6])
        s = np.sin(box[6])
        is_along = np.abs(c * dx + s * dy) <= box[3] + CELL / 2
        part |= is_along & (np.abs(c * dy - s * dx) <= box[4] + CELL / 2)

    def position(self, cell: int) -> Array:
        """Return the middle (3,) of a cell, on the floor [m]."""
        storey, y, x = np.unravel_index(cell, self.clearance.shape)
        return np.array([*(self.origin + CELL * (np.array([x, y]) + 0.5)), self.office.levels[storey]])

    def cell(self, position: Array) -> int:
        """Return the cell of a position (3,) on a floor."""
        storey = int(np.abs(self.office.levels - position[2]).argmin())
        x, y = ((position[:2] - self.origin) / CELL).astype(int)
        return int(np.ravel_multi_index((storey, y, x), self.clearance.shape))

    def cells_of_room(self, number: int) -> Cells:
        """Return the cells of a room that a person can stand on."""
        room = self.office.world.rooms[number]
        storey = int(np.abs(self.office.levels - room.corner[2]).argmin())
        x0, y0 = ((room.corner[:2] - self.origin) / CELL).astype(int)
        x1, y1 = (((room.corner + room.size)[:2] - self.origin) / CELL).astype(int)
        cells = np.arange(self.clearance.size).reshape(self.clearance.shape)[storey, y0:y1, x0:x1]
        return np.asarray(cells[self.clearance[storey, y0:y1, x0:x1] >= MIN_DISTANCE + CELL])

    def reach(self, cell: int) -> Reach:
        """Return the cheapest paths from a cell to all others."""
        return Reach(*dijkstra(self.costs, directed=False, indices=cell, return_predecessors=True))

    def way(self, reach: Reach, cell: int) -> Array:
        """Positions (M, 3) on the floor from where `reach` starts to a cell, with the ends of stairs [m]."""
        cells = [cell]
        while reach.before[cells[-1]] >= 0:
            cells.append(int(reach.before[cells[-1]]))
        cells.reverse()
        points = [self.position(cells[0])]
        for a, b in itertools.pairwise(cells):
            if flight := self.stairs.get((min(a, b), max(a, b))):
                points += [flight.foot, flight.top] if a < b else [flight.top, flight.foot]
            points.append(self.position(b))
        return np.array(points)


def _costs(clearance: Array, stairs: dict[tuple[int, int], Flight]) -> csr_array:
    """Metres (N, N) from cell to cell, one triangle; more where things are near."""
    is_free = clearance >= MIN_DISTANCE
    price = 1.0 + PRICE * np.exp((MIN_DISTANCE - clearance) / NEAR_THINGS)
    cells = np.arange(clearance.size, dtype=np.int64).reshape(clearance.shape)
    num_y, num_x = clearance.shape[1:]
    links: list[tuple[Cells, Cells, Array]] = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[:, : num_y - dy, max(0, -dx) : num_x - max(0, dx)]
        there = np.s_[:, dy:, max(0, dx) : num_x + min(0, dx)]
        both = is_free[here] & is_free[there]
        cost = CELL * np.hypot(dx, dy) * 0.5 * (price[here] + price[there])
        links.append((cells[here][both], cells[there][both], cost[both]))
    for (below, above), flight in stairs.items():
        length = float(np.linalg.norm(flight.top - flight.foot)) + 2.0 * LANDING
        links.append((np.array([below]), np.array([above]), np.array([length])))
    first, second, cost = (np.concatenate(values) for values in zip(*links, strict=True))
    return coo_array((cost, (first, second)), shape=(clearance.size, clearance.size)).tocsr()


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
        """Return the number of frames, `rate` a second from the beginning on."""
        return int(self.duration * rate + 1e-9) + 1

    def _at(self, values: Array, time: float) -> Array:
        """Values between ticks."""
        k = min(int(time / TICK), len(values) - 2)
        f = time / TICK - k
        return np.asarray((1.0 - f) * values[k] + f * values[k + 1])

    def foot(self, time: float) -> Array:
        """Return the position of the person's feet (3,) [m]."""
        return self._at(self.feet, time)

    def yaw(self, time: float) -> float:
        """Return the heading of the camera [rad]."""
        return float(self._at(self.yaws, time))

    def pose(self, time: float) -> Pose:
        """Of the camera, at a time from 0 to the duration [s]."""
        center_world = self.foot(time) + np.array([0.0, 0.0, HEIGHT + float(self._at(self.bobs, time))])
        return Pose(exp_so3(self._at(self.leans, time)) @ yaw_rotation(self.yaw(time)), center_world)


class Walker:
    """Draws walks through one building."""

    def __init__(self, office: Office) -> None:
        self.office = office
        self.floors = Floors(office)
        corridor = office.world.rooms[office.num_rooms]
        middle = corridor.corner + corridor.size * [0.5, 0.5, 0.0]
        self.everywhere = self.floors.reach(self.floors.cell(middle))  # but what furniture encloses

    def walk(self, length: float, rng: np.random.Generator) -> Walk:
        """Make a walk of `length` [m] through random rooms."""
        return time_legs(smooth_legs(self.floors, self._legs(length, rng), length), rng)

    def _legs(self, length: float, rng: np.random.Generator) -> list[Array]:
        """Ways (M, 3) from room to room until they are long enough."""
        legs: list[Array] = []
        done = 0.0
        number = int(rng.integers(self.office.num_rooms))
        cell = int(rng.choice(self._reach_cells(self.everywhere, number)))
        seen = {number}
        while done < length:
            reach = self.floors.reach(cell)
            number = self._next(reach, seen, rng)
            seen.add(number)
            cell = int(rng.choice(self._reach_cells(reach, number)))
            legs.append(self.floors.way(reach, cell))
            done += float(np.linalg.norm(np.diff(legs[-1], axis=0), axis=1).sum())
        return legs

    def _next(self, reach: Reach, seen: set[int], rng: np.random.Generator) -> int:
        """Draw the next room, mostly one of the nearest not yet visited; start over when all were visited."""
        if len(seen) >= self.office.num_rooms:
            seen.clear()
        unseen = [k for k in range(self.office.num_rooms) if k not in seen]
        costs = [reach.costs[self.floors.cells_of_room(k)].min() for k in unseen]
        order = [unseen[k] for k in np.argsort(costs, kind="stable")]
        return int(rng.choice(order[:NUM_NEAR] if rng.random() < NEAR_FRACTION else order))

    def _reach_cells(self, reach: Reach, number: int) -> Cells:
        """Return the cells of a room that can be reached: at least those in front of its door."""
        cells = self.floors.cells_of_room(number)
        return cells[np.isfinite(reach.costs[cells])]


def smooth_legs(floors: Floors, ways: Sequence[Array], length: float) -> list[Array]:
    """Ways without corners, a point every SPACING, up to a length [m]."""
    legs = []
    left = length
    for way in ways:
        for sigma in SMOOTHING:
            leg = _smooth(way, sigma)
            if sigma == 0.0 or _clearance(floors, leg) >= LEAST_CLEARANCE:
                break
        distance = _distances(leg)
        legs.append(leg[: int(np.searchsorted(distance, left)) + 1])
        left -= float(distance[-1])
        if left <= 0.0:
            break
    return legs


def _clearance(floors: Floors, leg: Array) -> float:
    """Return the smallest clearance [m] of those of the points (N, 3) that are on a floor, not on stairs."""
    heights = np.abs(leg[:, 2:] - floors.office.levels).min(axis=1)
    cells = [floors.cell(position) for position in leg[heights < 1e-3]]
    return float(floors.clearance.ravel()[cells].min())


def _distances(points: Array) -> Array:
    """Return the horizontal distance (N,) along a path of points (N, 3) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])


def _smooth(way: Array, sigma: float) -> Array:
    """Resample a path (N, 3) evenly and round its corners in the horizontal plane; its ends stay."""
    distance = _distances(way)
    at = np.linspace(0.0, distance[-1], max(2, int(distance[-1] / SPACING)))
    points = np.column_stack([np.interp(at, distance, way[:, k]) for k in range(3)])
    pad = min(len(points) - 1, int(4.0 * sigma / SPACING))
    if pad:
        padded = np.pad(points[:, :2], ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
        points[:, :2] = gaussian_filter1d(padded, sigma / SPACING, axis=0)[pad:-pad]
    return points


def speeds(leg: Array, pace: float) -> Array:
    """Return the speed (N,) [m/s] at points (N, 3): slower in turns, on stairs and at both ends."""
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


def time_legs(legs: Sequence[Array], rng: np.random.Generator) -> Walk:
    """Time the legs at a person's speed, with a pause after each but the last."""
    pace = float(rng.uniform(*PACE))
    times = []
    headings = []
    now = 0.0
    for leg in legs:
        speed = speeds(leg, pace)
        steps = np.diff(_distances(leg)) / (0.5 * (speed[1:] + speed[:-1]))
        times.append(now + np.concatenate([[0.0], np.cumsum(steps)]))
        step = np.gradient(leg[:, :2], axis=0)
        headings.append(np.arctan2(step[:, 1], step[:, 0]))
        now = float(times[-1][-1]) + float(rng.uniform(*PAUSES))
    at = np.concatenate(times)
    way = np.concatenate(legs)
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
