"""Places alike to a degree: hotel rooms, doors, cubicles, racks, some of whose things are changed."""

from collections.abc import Iterator

import numpy as np

from piccolo.geometry.pose import Array
from piccolo.scenes.synthetic.room import (
    CHECKS,
    PICTURE,
    PLAIN,
    PLANKS,
    STRIPES,
    TILES,
    Room,
    RoomBuilder,
    put_crate,
    put_shelf,
    put_shell,
    put_sofa,
    put_table,
)

ALIKE_KINDS = ("hotel", "doors", "cubicles", "racks")
CHANGED = (0.0, 0.05, 0.1, 0.2, 0.5)  # fractions of a unit's things
GAP = 0.4  # between hotel rooms [m]
PIECES = (put_table, put_shelf, put_sofa, put_crate, put_crate)


def make_alike(kind: str, seed: int, changed: float) -> tuple[Room, ...]:
    """Rooms of one of ALIKE_KINDS, a fraction of the things of each of their units unlike the others'."""
    makers = {"hotel": hotel, "doors": doors, "cubicles": cubicles, "racks": racks}
    return makers[kind](seed, changed)


def thing_seeds(seed: int, unit: int, count: int, changed: float) -> Iterator[list[int]]:
    """The seed of each thing of a unit: that of all units, or of a changed thing its own."""
    rng = np.random.default_rng([seed, 40, unit])
    for number in range(count):
        yield [seed, 41, number, 1 + unit if rng.random() < changed else 0]


def hotel(seed: int, changed: float) -> tuple[Room, ...]:
    """Five rooms in a row, with beds, shelves and pictures at the same places."""
    size = np.random.default_rng([seed, 42]).uniform([3.5, 3.5, 2.4], [5.0, 5.5, 2.8])
    rooms = []
    for unit in range(5):
        b = RoomBuilder(np.random.default_rng([seed, 43]), np.array([unit * (size[0] + GAP), 0.0, 0.0]))
        put_shell(b, size)
        for number, own in enumerate(thing_seeds(seed, unit, 12, changed)):
            b.rng = np.random.default_rng(own)
            if number < 6:  # on the walls
                side, along = number % 3, b.rng.uniform(0.6, size[1] - 0.6)
                x = (0.0, size[0], b.rng.uniform(0.6, size[0] - 0.6))[side]
                y, extent = (0.0, [0.7, 0.03, 0.5]) if side == 2 else (along, [0.03, 0.7, 0.5])
                b.put([x, y, 1.5], extent, b.paint((PICTURE, CHECKS), 0.1, 1.0))
            else:
                at, yaw = b.rng.uniform([0.6, 0.6], size[:2] - 0.6), float(b.rng.integers(4) * np.pi / 2)
                PIECES[b.rng.integers(len(PIECES))](b, at, yaw)
        rooms.append(_room(b, size, [0.5, 0.5, 0.93]))
    return tuple(rooms)


def doors(seed: int, changed: float) -> tuple[Room, ...]:
    """A corridor of eight doors, each with a sign, a mat, a lamp and a picture opposite."""
    b = RoomBuilder(np.random.default_rng([seed, 44]), np.zeros(3))
    count, step = 8, 2.6
    size = np.array([count * step, 2.2, 2.6])
    put_shell(b, size)
    for unit in range(count):
        x = (unit + 0.5) * step
        things = [
            ([x, 0.0, 1.0], [0.9, 0.06, 2.0], (PLANKS, PLAIN)),
            ([x + 0.7, 0.0, 1.5], [0.3, 0.04, 0.2], (PICTURE,)),
            ([x, 0.5, 0.01], [0.8, 0.5, 0.02], (STRIPES, CHECKS)),
            ([x, 2.2, 1.5], [0.8, 0.06, 0.6], (PICTURE,)),
            ([x + 0.9, 2.0, 0.4], [0.5, 0.4, 0.8], (PLANKS, CHECKS)),
        ]
        seeds = thing_seeds(seed, unit, len(things), changed)
        for (center, extent, patterns), own in zip(things, seeds, strict=True):
            b.rng = np.random.default_rng(own)
            shift = b.rng.uniform(-0.15, 0.15)
            b.put([center[0] + shift, *center[1:]], extent, b.paint(patterns, 0.1, 0.9))
    return (_room(b, size, [0.5, 0.5, 0.93]),)


def cubicles(seed: int, changed: float) -> tuple[Room, ...]:
    """An open office of ten cubicles on both sides of an aisle."""
    b = RoomBuilder(np.random.default_rng([seed, 45]), np.zeros(3))
    columns, cell = 5, 2.6
    size = np.array([columns * cell + 1.0, 2 * cell + 1.8, 2.8])
    put_shell(b, size)
    screen = b.paint((PLAIN, TILES), 0.5, 0.8)
    for unit in range(2 * columns):
        x, is_far = 0.5 + cell * (unit // 2), unit % 2
        y = size[1] - cell if is_far else 0.0
        b.put([x, y + cell / 2, 0.7], [0.05, cell, 1.4], screen)
        back = y + cell - 0.4 if is_far else y + 0.4
        things = [
            ([x + cell / 2, back, 0.72], [1.6, 0.7, 0.04], (PLANKS, PLAIN)),
            ([x + cell / 2, back, 0.95], [0.5, 0.08, 0.35], (PICTURE, PLAIN)),
            ([x + cell / 2 + 0.6, back, 0.85], [0.2, 0.2, 0.22], (CHECKS, STRIPES)),
            ([x + cell / 2, y + cell / 2, 0.45], [0.5, 0.5, 0.9], (PLAIN, STRIPES)),
            ([x + 0.06, y + cell / 2, 1.0], [0.04, 0.5, 0.4], (PICTURE,)),
            ([x + cell - 0.5, back, 0.3], [0.4, 0.5, 0.6], (PLANKS, CHECKS)),
        ]
        seeds = thing_seeds(seed, unit, len(things), changed)
        for (center, extent, patterns), own in zip(things, seeds, strict=True):
            b.rng = np.random.default_rng(own)
            dx, dy = b.rng.uniform(-0.15, 0.15, 2)
            at = [center[0] + dx, center[1] + 0.3 * dy, center[2]]
            b.put(at, extent, b.paint(patterns, 0.1, 0.9))
    return (_room(b, size, [0.5, 0.5, 0.95]),)


def racks(seed: int, changed: float) -> tuple[Room, ...]:
    """A store of four racks, each of six bays with boxes on three levels."""
    b = RoomBuilder(np.random.default_rng([seed, 46]), np.zeros(3))
    rows, bays, bay, aisle = 4, 6, 1.6, 2.4
    size = np.array([bays * bay + 3.0, rows * aisle + 1.2, 3.2])
    put_shell(b, size)
    steel = b.paint((PLAIN,), 0.3, 0.6)
    for unit in range(rows * bays):
        x, y = 1.5 + bay * (unit // rows), 1.2 + aisle * (unit % rows)
        for level in (0.1, 1.0, 1.9):
            b.put([x + bay / 2, y, level], [bay, 0.8, 0.05], steel)
        b.put([x, y, 1.2], [0.08, 0.8, 2.4], steel)
        for number, own in enumerate(thing_seeds(seed, unit, 6, changed)):
            b.rng = np.random.default_rng(own)
            extent = b.rng.uniform([0.35, 0.4, 0.3], [0.7, 0.75, 0.8])
            z = (0.1, 1.0, 1.9)[number // 2] + 0.03 + extent[2] / 2
            at = [x + 0.4 + 0.75 * (number % 2), y, z]
            b.put(at, extent, b.paint((PLAIN, PLANKS, PICTURE, STRIPES), 0.15, 0.9))
    return (_room(b, size, [0.5, 0.5, 0.95]),)


def _room(b: RoomBuilder, size: Array, light: list[float]) -> Room:
    boxes, materials = np.stack(b.boxes), np.stack(b.materials)
    return Room(b.corner, size, boxes, materials, b.corner + size * light, np.array(b.labels))
