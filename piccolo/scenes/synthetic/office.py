"""A seeded building: rooms off corridors of equal doors, halls, storeys joined by stairs; some are copies.

Corridors run along x between a hall in the west, with the stairs, and one in the east. Rooms stand on both
sides, each with an open door to its corridor. z is up, the floors are at multiples of the storeys' height.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...geometry.pose import Array
from .room import (
    CORRIDOR_WIDTH,
    DOOR_ROOM,
    PICTURE,
    PLAIN,
    PLANKS,
    TILES,
    WALL_THICKNESS,
    Door,
    Room,
    RoomBuilder,
    make_room,
    put_furniture,
    put_hangings,
    put_wall,
    put_walls,
)
from .world import MAX_ROOMS, MAX_SIZE, World

MAX_STOREYS = 4
MIN_ROOM = (2.6, 2.6, 2.3)  # [m]
SLAB = 0.3  # between a ceiling and the next floor [m]
BETWEEN = 2.0 * WALL_THICKNESS  # rooms [m]
HALL_WIDTH, EAST_WIDTH, PASSAGE = 6.0, 4.0, 1.6  # halls, and the doors between them and corridors [m]
COLUMNS = 8  # rooms on each side of a corridor
RISE, TREAD, FLIGHT_WIDTH, FLIGHT_BEGIN = 0.19, 0.28, 1.4, 1.3  # of stairs [m]
RAIL = 0.06, 1.0  # thickness and height [m]
HALL_AREA = 8.0  # for a piece of furniture [m2]
LAMP_DISTANCE = 6.0  # [m]


class Flight(NamedTuple):
    """A straight flight of stairs along +y."""

    foot: Array  # (3,) middle of the edge of the first step, on the floor [m]
    top: Array  # (3,) middle of the last step's far edge, on the next floor [m]
    width: float  # [m]


@dataclass(frozen=True)
class Office:
    """A building and how it is walked through."""

    world: World  # the rooms, then parts of corridors and halls; each with the boxes of all
    num_rooms: int
    copies: NDArray[np.int64]  # (num_rooms,) the room of which a room is a copy; itself if of none
    levels: Array  # (S,) heights of the floors [m]
    flights: tuple[Flight, ...]


class Plan(NamedTuple):
    """How many of everything, and where it stands."""

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
        """Where along y the corridors' middles are [m]."""
        first = float(self.size[1]) + BETWEEN + CORRIDOR_WIDTH / 2
        return [first + k * self.depth for k in range(self.num_corridors)]

    @property
    def door(self) -> Door:
        """Of a room, in the wall at its y = 0."""
        return Door(1, False, max(0.9, 0.3 * float(self.size[0])))

    def slots(self) -> list[tuple[int, int, int, bool]]:
        """Storey, corridor, column and whether it is south of the corridor, of each room."""
        ranges = range(self.num_storeys), range(self.num_corridors), range(self.num_columns), (True, False)
        per_storey = -(-self.num_rooms // self.num_storeys)
        found = [
            slot
            for s in ranges[0]
            for slot in itertools.islice(itertools.product([s], *ranges[1:]), per_storey)
        ]
        return found[: self.num_rooms]


def plan_of(size: Array, num_rooms: int, num_storeys: int) -> Plan:
    """The plan of a building; InputError if there can be none."""
    size = np.asarray(size, float)
    if not ((size >= MIN_ROOM) & (size <= MAX_SIZE)).all():
        raise InputError(
            f"size: found {size.tolist()}, wanted {list(MIN_ROOM)} to {MAX_SIZE} m in a building"
        )
    if not 1 <= num_storeys <= MAX_STOREYS:
        raise InputError(f"storeys: found {num_storeys}, wanted 1 to {MAX_STOREYS}")
    if not num_storeys <= num_rooms <= MAX_ROOMS:
        raise InputError(f"rooms: found {num_rooms}, wanted one a storey to {MAX_ROOMS}")
    per_storey = -(-num_rooms // num_storeys)
    num_corridors = -(-per_storey // (2 * COLUMNS))
    return Plan(size, num_rooms, num_storeys, num_corridors, -(-per_storey // (2 * num_corridors)))


def make_office(seed: int, size: Array, num_rooms: int, num_storeys: int, twins: float) -> Office:
    """A building of rooms of `size` (3,) [m], of which a fraction `twins` are exact copies of others."""
    plan = plan_of(size, num_rooms, num_storeys)
    if not 0.0 <= twins < 1.0:
        raise InputError(f"twins: found {twins}, wanted at least 0 and less than 1")
    rng = np.random.default_rng([seed, 50])
    copies, order = np.arange(num_rooms), rng.permutation(num_rooms)
    num_copies = min(round(twins * num_rooms), num_rooms - 1)
    copies[order[:num_copies]] = rng.choice(order[num_copies:], num_copies)
    made = {
        int(k): make_room(seed * MAX_ROOMS + int(k), plan.size, np.zeros(3), doors=[plan.door])
        for k in np.unique(copies)
    }
    rooms = [placed(made[int(k)], *_place(plan, slot)) for k, slot in zip(copies, plan.slots(), strict=True)]
    others = [*corridors(seed, plan, twins > 0.0), *halls(seed, plan)]
    parts = [part for other in others for part in _parts(other)]
    cells = [(cell.corner, cell.size) for cell in (*rooms, *parts)]
    levels = plan.height * np.arange(num_storeys, dtype=np.float64)
    flights = tuple(_flight(plan, storey) for storey in range(num_storeys - 1))
    return Office(World(seed, _joined([*rooms, *others], cells)), num_rooms, copies, levels, flights)


def _joined(rooms: list[Room], cells: list[tuple[Array, Array]]) -> tuple[Room, ...]:
    """Rooms at the corners and of the sizes of cells, each with the boxes of all rooms."""
    boxes, materials = np.concatenate([r.boxes for r in rooms]), np.concatenate([r.materials for r in rooms])
    light = np.concatenate([np.broadcast_to(r.light, (len(r.boxes), 3)) for r in rooms])
    labels = np.concatenate([r.labels for r in rooms])
    return tuple(Room(corner, size, boxes, materials, light, labels) for corner, size in cells)


def placed(room: Room, corner: Array, is_turned: bool) -> Room:
    """A room whose corner is the origin, moved to `corner` (3,), turned by half a turn if asked."""
    sign, shift = np.ones(3), np.array(corner)
    if is_turned:
        sign[:2], shift[:2] = -1.0, shift[:2] + room.size[:2]
    boxes = room.boxes.copy()
    boxes[:, :3] = sign * boxes[:, :3] + shift
    boxes[:, 6] += np.pi * is_turned
    return room._replace(corner=corner, boxes=boxes, light=sign * room.light + shift)


def _place(plan: Plan, slot: tuple[int, int, int, bool]) -> tuple[Array, bool]:
    """The corner (3,) of a slot's room, and whether the room is turned so that its door is in the north."""
    storey, corridor, column, is_south = slot
    y = corridor * plan.depth + (0.0 if is_south else plan.size[1] + CORRIDOR_WIDTH + 2.0 * BETWEEN)
    return np.array([column * (plan.size[0] + BETWEEN), y, storey * plan.height]), is_south


def _room_of(b: RoomBuilder, size: Array) -> Room:
    """What was built, each box lit by the nearest of the lamps along the longer side."""
    along = int(np.argmax(size[:2]))
    num_lamps = max(1, round(size[along] / LAMP_DISTANCE))
    lamps = np.tile(size * [0.5, 0.5, 0.93], (num_lamps, 1))
    lamps[:, along] = (np.arange(num_lamps) + 0.5) * size[along] / num_lamps
    boxes, lamps = np.stack(b.boxes), lamps + b.corner
    nearest = np.abs(boxes[:, along, None] - lamps[:, along]).argmin(axis=1)
    return Room(b.corner, size, boxes, np.stack(b.materials), lamps[nearest], np.array(b.labels))


def _parts(room: Room) -> Iterator[Room]:
    """A long room in parts of about LAMP_DISTANCE."""
    along = int(np.argmax(room.size[:2]))
    num_parts = max(1, round(room.size[along] / LAMP_DISTANCE))
    for k in range(num_parts):
        corner, size = room.corner.copy(), room.size.copy()
        size[along] /= num_parts
        corner[along] += k * size[along]
        yield room._replace(corner=corner, size=size)


def corridors(seed: int, plan: Plan, are_alike: bool) -> Iterator[Room]:
    """All corridors: the same door and picture repeat; alike ones differ at most in their doors."""
    x, passage = plan.size[0] + BETWEEN, plan.door.middle
    size = np.array([plan.length, CORRIDOR_WIDTH, plan.size[2]])
    slots, d = set(plan.slots()), WALL_THICKNESS
    for number, (storey, corridor) in enumerate(np.ndindex(plan.num_storeys, plan.num_corridors)):
        corner = [0.0, plan.passages[corridor] - CORRIDOR_WIDTH / 2, storey * plan.height]
        b = RoomBuilder(np.random.default_rng([seed, 51, 0 if are_alike else number]), np.array(corner))
        floor, ceiling = b.paint((PLANKS, TILES), 0.3, 0.7), b.paint((PLAIN,), 0.75, 0.95)
        walls = [b.paint((PLAIN,), 0.5, 0.9) for _ in range(3)]
        picture = b.paint((PICTURE,), 0.1, 1.0)
        doors: dict[bool, list[Door]] = {is_south: [] for is_south in (True, False)}
        for column in range(plan.num_columns):
            ends = max(column * x - BETWEEN / 2, -d), min((column + 1) * x - BETWEEN / 2, plan.length + d)
            middle, extent = sum(ends) / 2, ends[1] - ends[0]
            b.kind = "floor"
            b.put([middle, size[1] / 2, -d / 2], [extent, size[1] + 2 * d, d], floor)
            b.kind = "ceiling"
            b.put([middle, size[1] / 2, size[2] + d / 2], [extent, size[1] + 2 * d, d], ceiling)
            b.kind = "picture"
            for is_south in (True, False):
                at = column * x + (plan.size[0] - passage if is_south else passage)
                beside = at + (-1.0 if is_south else 1.0)
                b.put([beside, 0.0 if is_south else size[1], 1.5], [0.6, 0.03, 0.5], picture)
                if (storey, corridor, column, is_south) in slots:
                    doors[is_south].append(Door(1, not is_south, at))
        b.kind = "wall"
        for is_far in (False, True):
            put_wall(b, size, (1, is_far), walls[is_far], doors[not is_far])
            put_wall(b, size, (0, is_far), walls[2], [Door(0, is_far, size[1] / 2, PASSAGE)])
        yield _room_of(b, size)


def _flight(plan: Plan, storey: int) -> Flight:
    """The stairs from a storey to the next, on alternate sides of the west hall."""
    middle = 0.8 + FLIGHT_WIDTH / 2
    x = -BETWEEN - HALL_WIDTH + (middle if storey % 2 == 0 else HALL_WIDTH - middle)
    run = TREAD * np.ceil(plan.height / RISE)
    foot = np.array([x, FLIGHT_BEGIN, storey * plan.height])
    return Flight(foot, foot + np.array([0.0, run, plan.height]), FLIGHT_WIDTH)


def halls(seed: int, plan: Plan) -> Iterator[Room]:
    """The halls at both ends of the corridors of every storey, all different."""
    y = plan.num_corridors * plan.depth - BETWEEN
    for storey in range(plan.num_storeys):
        for is_east in (False, True):
            width = EAST_WIDTH if is_east else HALL_WIDTH
            left = plan.length + BETWEEN if is_east else -BETWEEN - HALL_WIDTH
            corner, size = np.array([left, 0.0, storey * plan.height]), np.array([width, y, plan.size[2]])
            b = RoomBuilder(np.random.default_rng([seed, 52, storey, int(is_east)]), corner)
            doors = [Door(0, not is_east, passage, PASSAGE) for passage in plan.passages]
            up = _flight(plan, storey) if storey < plan.num_storeys - 1 and not is_east else None
            down = _flight(plan, storey - 1) if storey and not is_east else None
            b.clear = [door.clear(size, DOOR_ROOM) for door in doors] + [
                _around(b, f) for f in (up, down) if f
            ]
            d = WALL_THICKNESS
            b.kind = "floor"
            _slab(b, size, (-d, 0.0), down, b.paint((PLANKS, TILES), 0.35, 0.75))
            b.kind = "ceiling"
            _slab(b, size, (size[2], size[2] + SLAB - d), up, b.paint((PLAIN,), 0.75, 0.95))
            put_walls(b, size, doors)
            put_hangings(b, size)
            put_furniture(b, size, area=HALL_AREA)
            _stairs(b, up, down)
            yield _room_of(b, size)


def _around(b: RoomBuilder, flight: Flight) -> tuple[Array, Array]:
    """A flight of stairs with what is walked on before and after it, relative to the builder's corner."""
    aside = np.array([flight.width / 2 + 0.1, 1.1, 1.0])
    return flight.foot - aside - b.corner, flight.top + aside + [0.0, 0.0, 1.0] - b.corner


def _slab(b: RoomBuilder, size: Array, ends: tuple[float, float], hole: Flight | None, paint: Array) -> None:
    """A floor or ceiling between two heights, open above a flight of stairs."""
    d = WALL_THICKNESS
    west, east, south, north = -d, size[0] + d, -d, size[1] + d
    pieces = [(west, east, south, north)]
    if hole is not None:
        left, right = hole.foot[0] - hole.width / 2 - b.corner[0], hole.foot[0] + hole.width / 2 - b.corner[0]
        near, far = hole.foot[1] - b.corner[1], hole.top[1] - b.corner[1]
        pieces = [(west, left, south, north), (right, east, south, north)]
        pieces += [(left, right, south, near), (left, right, far, north)]
    for x0, x1, y0, y1 in pieces:
        b.put([(x0 + x1) / 2, (y0 + y1) / 2, sum(ends) / 2], [x1 - x0, y1 - y0, ends[1] - ends[0]], paint)


def _stairs(b: RoomBuilder, up: Flight | None, down: Flight | None) -> None:
    """Steps, solid down to the floor, and rails around the opening of those that come from below."""
    if up is not None:
        foot, (_, run, height) = up.foot - b.corner, up.top - up.foot
        num_steps = round(run / TREAD)
        b.kind, wood = "floor", b.paint((PLANKS,), 0.25, 0.7)
        for k in range(num_steps):
            z = (k + 1) * height / num_steps
            b.put([foot[0], foot[1] + (k + 0.5) * TREAD, z / 2], [up.width, TREAD, z], wood)
    if down is not None:
        foot, top = down.foot - b.corner, down.top - b.corner
        b.kind, steel = "wall", b.paint((PLAIN,), 0.3, 0.7)
        thickness, height = RAIL
        run, aside = top[1] - foot[1], (down.width + thickness) / 2
        for sign in (-1, 1):
            b.put([foot[0] + sign * aside, foot[1] + run / 2, height / 2], [thickness, run, height], steel)
        b.put([foot[0], foot[1] - thickness / 2, height / 2], [down.width, thickness, height], steel)
