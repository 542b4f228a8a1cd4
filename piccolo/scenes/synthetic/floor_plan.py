"""Where rooms, corridors, halls and stairs of a building are.

Corridors run along x between a hall in the west, with the stairs, and one in the east. Rooms stand on both
sides, each with an open door to its corridor. z is up, the floors are at multiples of the storeys' height.
"""

import itertools
from typing import NamedTuple

import numpy as np

from ...errors import InputError
from ...geometry.pose import Array
from .room import WALL_THICKNESS, Door
from .world import MAX_ROOMS, MAX_SIZE

MAX_STOREYS = 4
MIN_ROOM = (2.6, 2.6, 2.3)  # [m]
SLAB = 0.3  # between a ceiling and the next floor [m]
BETWEEN = 2.0 * WALL_THICKNESS  # rooms [m]
HALL_WIDTH, EAST_WIDTH, PASSAGE = 6.0, 4.0, 1.6  # halls, and the doors between them and corridors [m]
CORRIDOR_WIDTH = 2.2  # [m]
COLUMNS = 8  # rooms on each side of a corridor
RISE, TREAD, FLIGHT_WIDTH, FLIGHT_BEGIN = 0.19, 0.28, 1.4, 1.3  # of stairs [m]


class Flight(NamedTuple):
    """A straight flight of stairs along +y."""

    foot: Array  # (3,) middle of the edge of the first step, on the floor [m]
    top: Array  # (3,) middle of the last step's far edge, on the next floor [m]
    width: float  # [m]

    @property
    def run(self) -> float:
        """In the plan [m]."""
        return float(self.top[1] - self.foot[1])


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
    plan = Plan(size, num_rooms, num_storeys, num_corridors, -(-per_storey // (2 * num_corridors)))
    if num_storeys > 1 and 2.0 * FLIGHT_BEGIN + flight_of(plan, 0).run > plan.num_corridors * plan.depth:
        raise InputError(
            f"size: rooms of {size.tolist()} m are too high for stairs in the halls between them"
        )
    return plan


def place_of(plan: Plan, slot: tuple[int, int, int, bool]) -> tuple[Array, bool]:
    """The corner (3,) of a slot's room, and whether the room is turned so that its door is in the north."""
    storey, corridor, column, is_south = slot
    y = corridor * plan.depth + (0.0 if is_south else plan.size[1] + CORRIDOR_WIDTH + 2.0 * BETWEEN)
    return np.array([column * (plan.size[0] + BETWEEN), y, storey * plan.height]), is_south


def flight_of(plan: Plan, storey: int) -> Flight:
    """The stairs from a storey to the next, on alternate sides of the west hall."""
    middle = 0.8 + FLIGHT_WIDTH / 2
    x = -BETWEEN - HALL_WIDTH + (middle if storey % 2 == 0 else HALL_WIDTH - middle)
    run = TREAD * np.ceil(plan.height / RISE)
    foot = np.array([x, FLIGHT_BEGIN, storey * plan.height])
    return Flight(foot, foot + np.array([0.0, run, plan.height]), FLIGHT_WIDTH)
