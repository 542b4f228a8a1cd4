"""A seeded building, from its floor plan: rooms, some of them copies, corridors, halls, stairs."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...geometry.pose import Array
from .floor_plan import (
    BETWEEN,
    CORRIDOR_WIDTH,
    EAST_WIDTH,
    HALL_WIDTH,
    PASSAGE,
    SLAB,
    TREAD,
    Flight,
    Plan,
    flight_of,
    place_of,
    plan_of,
)
from .room import (
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
from .world import SEED_STEP, World

RAIL = 0.06, 1.0  # thickness and height [m]
HALL_AREA = 8.0  # for a piece of furniture [m2]
LAMP_DISTANCE = 6.0  # [m]


@dataclass(frozen=True)
class Office:
    """A building and how it is walked through."""

    world: World  # the rooms, then parts of corridors and halls; each with the boxes of all
    num_rooms: int
    copies: NDArray[np.int64]  # (num_rooms,) the room of which a room is a copy; itself if of none
    levels: Array  # (S,) heights of the floors [m]
    flights: tuple[Flight, ...]


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
        int(k): make_room(seed * SEED_STEP + int(k), plan.size, np.zeros(3), doors=[plan.door])
        for k in np.unique(copies)
    }
    rooms = [
        placed(made[int(k)], *place_of(plan, slot)) for k, slot in zip(copies, plan.slots(), strict=True)
    ]
    others = [*corridors(seed, plan, twins > 0.0), *halls(seed, plan)]
    parts = [part for other in others for part in _parts(other)]
    cells = [(cell.corner, cell.size) for cell in (*rooms, *parts)]
    levels = plan.height * np.arange(num_storeys, dtype=np.float64)
    flights = tuple(flight_of(plan, storey) for storey in range(num_storeys - 1))
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
            up = flight_of(plan, storey) if storey < plan.num_storeys - 1 and not is_east else None
            down = flight_of(plan, storey - 1) if storey and not is_east else None
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
        foot, height = up.foot - b.corner, up.top[2] - up.foot[2]
        num_steps = round(up.run / TREAD)
        b.kind, wood = "floor", b.paint((PLANKS,), 0.25, 0.7)
        for k in range(num_steps):
            z = (k + 1) * height / num_steps
            b.put([foot[0], foot[1] + (k + 0.5) * TREAD, z / 2], [up.width, TREAD, z], wood)
    if down is not None:
        foot, run = down.foot * [1.0, 1.0, 0.0] - b.corner * [1.0, 1.0, 0.0], down.run
        b.kind, steel = "wall", b.paint((PLAIN,), 0.3, 0.7)
        thickness, height = RAIL
        aside = (down.width + thickness) / 2
        for sign in (-1, 1):
            b.put([foot[0] + sign * aside, foot[1] + run / 2, height / 2], [thickness, run, height], steel)
        b.put([foot[0], foot[1] - thickness / 2, height / 2], [down.width, thickness, height], steel)
