"""A seeded building: rooms, some of them copies, along corridors between halls with stairs.

Corridors run along x between a hall in the west, with the stairs, and one in the east. Rooms stand on both
sides, each with an open door to its corridor. z is up, the floors are at multiples of the storeys' height.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from piccolo.system.arrays import Array, Int64s
from piccolo.system.errors import InputError

from . import layout
from .layout import PICTURE, PLAIN, PLANKS, TILES, WALL_THICKNESS, Door, Room, RoomBuilder
from .world import MAX_ROOMS, MAX_SIZE, SEED_STEP, World

MAX_STOREYS = 4
MIN_ROOM = (2.6, 2.6, 2.3)  # [m]
SLAB = 0.3  # between a ceiling and the next floor [m]
BETWEEN = 2.0 * WALL_THICKNESS  # rooms [m]
HALL_WIDTH = 6.0  # in the west [m]
EAST_WIDTH = 4.0  # of the hall in the east [m]
PASSAGE = 1.6  # width of the doors between halls and corridors [m]
CORRIDOR_WIDTH = 2.2  # [m]
COLUMNS = 8  # rooms on each side of a corridor
RISE = 0.19  # of a step, at most [m]
TREAD = 0.28  # [m]
FLIGHT_WIDTH = 1.4  # [m]
FLIGHT_BEGIN = 1.3  # of stairs, from the hall's south wall [m]
RAIL_THICKNESS = 0.06  # [m]
RAIL_HEIGHT = 1.0  # [m]
LAMP_DISTANCE = 6.0  # [m]

Slot = tuple[int, int, int, bool]  # storey, corridor, column of a room, and whether it is south


class Flight(NamedTuple):
    """A straight flight of stairs along +y."""

    foot: Array  # (3,) middle of the edge of the first step, on the floor [m]
    top: Array  # (3,) middle of the last step's far edge, on the next floor [m]

    @property
    def run(self) -> float:
        """Length in the plan [m]."""
        return float(self.top[1] - self.foot[1])


class Plan(NamedTuple):
    """The places of rooms, corridors and stairs."""

    size: Array  # (3,) of a room [m]
    num_rooms: int
    num_storeys: int
    num_corridors: int  # a storey
    num_columns: int

    @property
    def height(self) -> float:
        """From floor to floor [m]."""
        return float(self.size[2]) + SLAB

    @property
    def length(self) -> float:
        """Of a corridor [m]."""
        return self.num_columns * (float(self.size[0]) + BETWEEN) - BETWEEN

    @property
    def depth(self) -> float:
        """From a corridor to the next [m]."""
        return 2.0 * float(self.size[1]) + CORRIDOR_WIDTH + 3.0 * BETWEEN

    @property
    def passages(self) -> list[float]:
        """Middles of the corridors along y [m]."""
        first = float(self.size[1]) + BETWEEN + CORRIDOR_WIDTH / 2
        return [first + k * self.depth for k in range(self.num_corridors)]

    @property
    def door(self) -> Door:
        """Of a room, in the wall at its y = 0."""
        return Door(1, False, max(0.9, 0.3 * float(self.size[0])))

    def slots(self) -> list[Slot]:
        """Return the places of the rooms, storey by storey; of the last storey only those with a room."""
        per_storey = -(-self.num_rooms // self.num_storeys)
        places = itertools.product(range(self.num_corridors), range(self.num_columns), (True, False))
        own = list(itertools.islice(places, per_storey))
        return [(storey, *place) for storey in range(self.num_storeys) for place in own][: self.num_rooms]

    def corner(self, slot: Slot) -> Array:
        """Return the corner (3,) of a slot's room [m]."""
        storey, corridor, column, is_south = slot
        y = corridor * self.depth + (0.0 if is_south else self.size[1] + CORRIDOR_WIDTH + 2.0 * BETWEEN)
        return np.array([column * (self.size[0] + BETWEEN), y, storey * self.height])

    def flight(self, storey: int) -> Flight:
        """Return the stairs from a storey to the next, on alternate sides of the west hall."""
        middle = 0.8 + FLIGHT_WIDTH / 2
        x = -BETWEEN - HALL_WIDTH + (middle if storey % 2 == 0 else HALL_WIDTH - middle)
        run = TREAD * np.ceil(self.height / RISE)
        foot = np.array([x, FLIGHT_BEGIN, storey * self.height])
        return Flight(foot, foot + np.array([0.0, run, self.height]))


@dataclass(frozen=True)
class Office:
    """A building and how it is walked through."""

    world: World  # the rooms, then parts of corridors and halls; each with the boxes of all
    num_rooms: int
    copies: Int64s  # (num_rooms,) the room of which a room is a copy; itself if of none
    levels: Array  # (S,) heights of the floors [m]
    flights: tuple[Flight, ...]


def plan_building(size: Array, num_rooms: int, num_storeys: int) -> Plan:
    """Plan a building; InputError if no such building is possible."""
    size = np.asarray(size, float)
    if not ((size >= MIN_ROOM) & (size <= MAX_SIZE)).all():
        wanted = f"wanted {list(MIN_ROOM)} to {MAX_SIZE} m in a building"
        raise InputError(f"`size`: found {size.tolist()}, {wanted}")
    if not 1 <= num_storeys <= MAX_STOREYS:
        raise InputError(f"`storeys`: found {num_storeys}, wanted 1 to {MAX_STOREYS}")
    if not num_storeys <= num_rooms <= MAX_ROOMS:
        raise InputError(f"`rooms`: found {num_rooms}, wanted one per storey to {MAX_ROOMS}")
    per_storey = -(-num_rooms // num_storeys)
    num_corridors = -(-per_storey // (2 * COLUMNS))
    plan = Plan(size, num_rooms, num_storeys, num_corridors, -(-per_storey // (2 * num_corridors)))
    if num_storeys > 1 and 2.0 * FLIGHT_BEGIN + plan.flight(0).run > plan.num_corridors * plan.depth:
        why = "are too high for stairs in the halls between them"
        raise InputError(f"`size`: rooms of {size.tolist()} m {why}")
    return plan


def make_office(seed: int, size: Array, num_rooms: int, num_storeys: int, twins: float) -> Office:
    """Make a building of rooms of `size` (3,) [m]; a fraction `twins` of them are exact copies of others."""
    plan = plan_building(size, num_rooms, num_storeys)
    if not 0.0 <= twins < 1.0:
        raise InputError(f"`twins`: found {twins}, wanted at least 0 and less than 1")
    rng = np.random.default_rng([seed, 50])
    copies = np.arange(num_rooms)
    order = rng.permutation(num_rooms)
    num_copies = min(round(twins * num_rooms), num_rooms - 1)
    copies[order[:num_copies]] = rng.choice(order[num_copies:], num_copies)
    made = {
        int(k): layout.make_room(seed * SEED_STEP + int(k), plan.size, np.zeros(3), doors=[plan.door])
        for k in np.unique(copies)
    }
    slots = plan.slots()
    rooms = [
        place(made[int(k)], plan.corner(slot), is_turned=slot[3])
        for k, slot in zip(copies, slots, strict=True)
    ]
    others = [*corridors(seed, plan, twins > 0.0), *halls(seed, plan)]
    whole = layout.join_rooms([*rooms, *others])
    parts = [part for other in others for part in _parts(other)]
    cells = tuple(whole._replace(corner=cell.corner, size=cell.size) for cell in (*rooms, *parts))
    levels = plan.height * np.arange(num_storeys, dtype=np.float64)
    flights = tuple(plan.flight(storey) for storey in range(num_storeys - 1))
    return Office(World(seed, cells), num_rooms, copies, levels, flights)


def place(room: Room, corner: Array, is_turned: bool) -> Room:
    """Move a room from the origin to `corner` (3,), turned by 180 degrees if `is_turned`."""
    sign = np.ones(3)
    shift = np.array(corner)
    if is_turned:
        sign[:2] = -1.0
        shift[:2] += room.size[:2]
    boxes = room.boxes.copy()
    boxes[:, :3] = sign * boxes[:, :3] + shift
    boxes[:, 6] += np.pi * is_turned
    return room._replace(corner=corner, boxes=boxes, light=sign * room.light + shift)


def _room_of(b: RoomBuilder, size: Array) -> Room:
    """Return the finished room; the nearest of the lamps along its longer side lights each box."""
    along = int(np.argmax(size[:2]))
    num_lamps = max(1, round(size[along] / LAMP_DISTANCE))
    lamps = np.tile(size * [0.5, 0.5, 0.93], (num_lamps, 1))
    lamps[:, along] = (np.arange(num_lamps) + 0.5) * size[along] / num_lamps
    lamps = lamps + b.corner
    room = b.room(size, lamps[0])
    nearest = np.abs(room.boxes[:, along, None] - lamps[:, along]).argmin(axis=1)
    return room._replace(light=lamps[nearest])


def _parts(room: Room) -> Iterator[Room]:
    """Yield a long room in parts of about LAMP_DISTANCE."""
    along = int(np.argmax(room.size[:2]))
    num_parts = max(1, round(room.size[along] / LAMP_DISTANCE))
    for k in range(num_parts):
        corner = room.corner.copy()
        size = room.size.copy()
        size[along] /= num_parts
        corner[along] += k * size[along]
        yield room._replace(corner=corner, size=size)


def corridors(seed: int, plan: Plan, are_alike: bool) -> Iterator[Room]:
    """All corridors: the same door and picture repeat; alike ones differ at most in their doors."""
    x = plan.size[0] + BETWEEN
    passage = plan.door.middle
    size = np.array([plan.length, CORRIDOR_WIDTH, plan.size[2]])
    slots = set(plan.slots())
    d = WALL_THICKNESS
    for number, (storey, corridor) in enumerate(np.ndindex(plan.num_storeys, plan.num_corridors)):
        corner = [0.0, plan.passages[corridor] - CORRIDOR_WIDTH / 2, storey * plan.height]
        b = RoomBuilder(np.random.default_rng([seed, 51, 0 if are_alike else number]), np.array(corner))
        floor = b.paint((PLANKS, TILES), 0.3, 0.7)
        ceiling = b.paint((PLAIN,), 0.75, 0.95)
        walls = [b.paint((PLAIN,), 0.5, 0.9) for _ in range(3)]
        picture = b.paint((PICTURE,), 0.1, 1.0)
        doors: dict[bool, list[Door]] = {True: [], False: []}  # by whether they are south
        for column in range(plan.num_columns):
            begin = max(column * x - BETWEEN / 2, -d)
            end = min((column + 1) * x - BETWEEN / 2, plan.length + d)
            extent = [end - begin, size[1] + 2 * d, d]
            b.put([(begin + end) / 2, size[1] / 2, -d / 2], extent, floor, kind="floor")
            b.put([(begin + end) / 2, size[1] / 2, size[2] + d / 2], extent, ceiling, kind="ceiling")
            for is_south in (True, False):
                at = column * x + (plan.size[0] - passage if is_south else passage)
                beside = at + (-1.0 if is_south else 1.0)
                center = [beside, 0.0 if is_south else size[1], 1.5]
                b.put(center, [0.6, 0.03, 0.5], picture, kind="picture")
                if (storey, corridor, column, is_south) in slots:
                    doors[is_south].append(Door(1, not is_south, at))
        b.kind = "wall"
        for is_far in (False, True):
            layout.put_wall(b, size, (1, is_far), walls[is_far], doors[not is_far])
            layout.put_wall(b, size, (0, is_far), walls[2], [Door(0, is_far, size[1] / 2, PASSAGE)])
        yield _room_of(b, size)


def halls(seed: int, plan: Plan) -> Iterator[Room]:
    """Yield the halls at both ends of the corridors of every storey, all different."""
    y = plan.num_corridors * plan.depth - BETWEEN
    for storey, is_east in itertools.product(range(plan.num_storeys), (False, True)):
        left = plan.length + BETWEEN if is_east else -BETWEEN - HALL_WIDTH
        size = np.array([EAST_WIDTH if is_east else HALL_WIDTH, y, plan.size[2]])
        rng = np.random.default_rng([seed, 52, storey, int(is_east)])
        b = RoomBuilder(rng, np.array([left, 0.0, storey * plan.height]))
        doors = [Door(0, not is_east, passage, PASSAGE) for passage in plan.passages]
        up = plan.flight(storey) if storey < plan.num_storeys - 1 and not is_east else None
        down = plan.flight(storey - 1) if storey and not is_east else None
        b.clear = [door.clear(size, layout.DOOR_ROOM) for door in doors]
        b.clear += [_around(b, flight) for flight in (up, down) if flight]
        b.kind = "floor"
        _put_slab(b, size, (-WALL_THICKNESS, 0.0), down, b.paint((PLANKS, TILES), 0.35, 0.75))
        b.kind = "ceiling"
        ends = size[2], size[2] + SLAB - WALL_THICKNESS
        _put_slab(b, size, ends, up, b.paint((PLAIN,), 0.75, 0.95))
        layout.put_walls(b, size, doors)
        layout.put_hangings(b, size)
        layout.put_furniture(b, size, area=8.0)
        if up is not None:
            _put_steps(b, up)
        if down is not None:
            _put_rails(b, down)
        yield _room_of(b, size)


def _around(b: RoomBuilder, flight: Flight) -> tuple[Array, Array]:
    """Return the box (low, high) of stairs and landings, relative to the builder's corner."""
    aside = np.array([FLIGHT_WIDTH / 2 + 0.1, 1.1, 1.0])
    return flight.foot - aside - b.corner, flight.top + aside + [0.0, 0.0, 1.0] - b.corner


def _put_slab(
    b: RoomBuilder, size: Array, ends: tuple[float, float], hole: Flight | None, paint: Array
) -> None:
    """Add a floor or ceiling between two heights, open above a flight of stairs."""
    d = WALL_THICKNESS
    east = size[0] + d
    north = size[1] + d
    pieces = [(-d, east, -d, north)]
    if hole is not None:
        left = hole.foot[0] - FLIGHT_WIDTH / 2 - b.corner[0]
        right = hole.foot[0] + FLIGHT_WIDTH / 2 - b.corner[0]
        near = hole.foot[1] - b.corner[1]
        far = hole.top[1] - b.corner[1]
        pieces = [(-d, left, -d, north), (right, east, -d, north)]
        pieces += [(left, right, -d, near), (left, right, far, north)]
    for x0, x1, y0, y1 in pieces:
        b.put([(x0 + x1) / 2, (y0 + y1) / 2, sum(ends) / 2], [x1 - x0, y1 - y0, ends[1] - ends[0]], paint)


def _put_steps(b: RoomBuilder, flight: Flight) -> None:
    """Add the steps of stairs, solid down to the floor."""
    foot = flight.foot - b.corner
    height = flight.top[2] - flight.foot[2]
    num_steps = round(flight.run / TREAD)
    wood = b.paint((PLANKS,), 0.25, 0.7)
    for k in range(num_steps):
        z = (k + 1) * height / num_steps
        center = [foot[0], foot[1] + (k + 0.5) * TREAD, z / 2]
        b.put(center, [FLIGHT_WIDTH, TREAD, z], wood, kind="floor")


def _put_rails(b: RoomBuilder, flight: Flight) -> None:
    """Rails around the opening of stairs that come from below."""
    x, y = (flight.foot - b.corner)[:2]
    steel = b.paint((PLAIN,), 0.3, 0.7)
    aside = (FLIGHT_WIDTH + RAIL_THICKNESS) / 2
    middle = RAIL_HEIGHT / 2
    b.kind = "wall"
    for sign in (-1, 1):
        extent = [RAIL_THICKNESS, flight.run, RAIL_HEIGHT]
        b.put([x + sign * aside, y + flight.run / 2, middle], extent, steel)
    b.put([x, y - RAIL_THICKNESS / 2, middle], [FLIGHT_WIDTH, RAIL_THICKNESS, RAIL_HEIGHT], steel)
