"""Made-up places that look alike: hotel rooms, doors, cubicles, racks, both halves of a hall."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from . import layout
from .layout import CHECKS, PICTURE, PLAIN, PLANKS, STRIPES, TILES, Room, RoomBuilder
from .office import place
from .world import GAP

ALIKE_KINDS = ("hotel", "doors", "cubicles", "racks", "hall")  # some of whose things are changed
CHANGED = (0.0, 0.05, 0.1, 0.2, 0.5)  # fractions of a unit's things
PIECES = (layout.put_table, layout.put_shelf, layout.put_sofa, layout.put_crate, layout.put_crate)

Thing = tuple[Sequence[float], Sequence[float], tuple[int, ...]]  # centre (3,), size (3,) [m], patterns


def make_alike(kind: str, seed: int, changed: float) -> tuple[Room, ...]:
    """Make rooms of one of ALIKE_KINDS, in each of whose units a fraction of the things is changed."""
    makers = {"hotel": hotel, "doors": doors, "cubicles": cubicles, "racks": racks, "hall": hall}
    return makers[kind](seed, changed)


def thing_seeds(seed: int, unit: int, count: int, changed: float) -> Iterator[list[int]]:
    """Yield the seed of each thing of a unit: shared by all units, or its own if the thing is changed."""
    rng = np.random.default_rng([seed, 40, unit])
    for number in range(count):
        yield [seed, 41, number, 1 + unit if rng.random() < changed else 0]


def put_things(
    b: RoomBuilder, things: Sequence[Thing], seeds: Iterable[list[int]], spread: tuple[float, ...]
) -> None:
    """Put things where they belong, each off by up to 0.15 m times `spread` along x (and y)."""
    for (center, extent, patterns), own in zip(things, seeds, strict=True):
        b.rng = np.random.default_rng(own)
        at = np.array(center)
        at[: len(spread)] += spread * b.rng.uniform(-0.15, 0.15, len(spread))
        b.put(at, extent, b.paint(patterns, 0.1, 0.9))


def hotel(seed: int, changed: float) -> tuple[Room, ...]:
    """Make five rooms in a row, with furniture and pictures at the same places."""
    size = np.random.default_rng([seed, 42]).uniform([3.5, 3.5, 2.4], [5.0, 5.5, 2.8])
    rooms = []
    for unit in range(5):
        b = RoomBuilder(np.random.default_rng([seed, 43]), np.array([unit * (size[0] + GAP), 0.0, 0.0]))
        layout.put_shell(b, size)
        for number, own in enumerate(thing_seeds(seed, unit, 12, changed)):
            b.rng = np.random.default_rng(own)
            if number < 6:  # on the walls
                side = number % 3
                along = b.rng.uniform(0.6, size[1] - 0.6)
                across = b.rng.uniform(0.6, size[0] - 0.6)
                center = ([0.0, along, 1.5], [size[0], along, 1.5], [across, 0.0, 1.5])[side]
                extent = [0.7, 0.03, 0.5] if side == 2 else [0.03, 0.7, 0.5]
                b.put(center, extent, b.paint((PICTURE, CHECKS), 0.1, 1.0))
            else:
                at = b.rng.uniform([0.6, 0.6], size[:2] - 0.6)
                yaw = float(b.rng.integers(4) * np.pi / 2)
                PIECES[b.rng.integers(len(PIECES))](b, at, yaw)
        rooms.append(b.room(size, b.corner + size * [0.5, 0.5, 0.93]))
    return tuple(rooms)


def doors(seed: int, changed: float) -> tuple[Room, ...]:
    """Make a corridor of eight doors, each with a sign, a mat, a lamp and a picture opposite."""
    b = RoomBuilder(np.random.default_rng([seed, 44]), np.zeros(3))
    count = 8
    step = 2.6
    size = np.array([count * step, 2.2, 2.6])
    layout.put_shell(b, size)
    for unit in range(count):
        x = (unit + 0.5) * step
        things: list[Thing] = [
            ([x, 0.0, 1.0], [0.9, 0.06, 2.0], (PLANKS, PLAIN)),
            ([x + 0.7, 0.0, 1.5], [0.3, 0.04, 0.2], (PICTURE,)),
            ([x, 0.5, 0.01], [0.8, 0.5, 0.02], (STRIPES, CHECKS)),
            ([x, 2.2, 1.5], [0.8, 0.06, 0.6], (PICTURE,)),
            ([x + 0.9, 2.0, 0.4], [0.5, 0.4, 0.8], (PLANKS, CHECKS)),
        ]
        put_things(b, things, thing_seeds(seed, unit, len(things), changed), (1.0,))
    return (b.room(size, size * [0.5, 0.5, 0.93]),)


def cubicles(seed: int, changed: float) -> tuple[Room, ...]:
    """Make an open office of ten cubicles on both sides of an aisle."""
    b = RoomBuilder(np.random.default_rng([seed, 45]), np.zeros(3))
    columns = 5
    cell = 2.6
    size = np.array([columns * cell + 1.0, 2 * cell + 1.8, 2.8])
    layout.put_shell(b, size)
    screen = b.paint((PLAIN, TILES), 0.5, 0.8)
    for unit in range(2 * columns):
        x = 0.5 + cell * (unit // 2)
        is_far = unit % 2
        y = size[1] - cell if is_far else 0.0
        b.put([x, y + cell / 2, 0.7], [0.05, cell, 1.4], screen)
        back = y + cell - 0.4 if is_far else y + 0.4
        things: list[Thing] = [
            ([x + cell / 2, back, 0.72], [1.6, 0.7, 0.04], (PLANKS, PLAIN)),
            ([x + cell / 2, back, 0.95], [0.5, 0.08, 0.35], (PICTURE, PLAIN)),
            ([x + cell / 2 + 0.6, back, 0.85], [0.2, 0.2, 0.22], (CHECKS, STRIPES)),
            ([x + cell / 2, y + cell / 2, 0.45], [0.5, 0.5, 0.9], (PLAIN, STRIPES)),
            ([x + 0.06, y + cell / 2, 1.0], [0.04, 0.5, 0.4], (PICTURE,)),
            ([x + cell - 0.5, back, 0.3], [0.4, 0.5, 0.6], (PLANKS, CHECKS)),
        ]
        put_things(b, things, thing_seeds(seed, unit, len(things), changed), (1.0, 0.3))
    return (b.room(size, size * [0.5, 0.5, 0.95]),)


def racks(seed: int, changed: float) -> tuple[Room, ...]:
    """Make a store of four racks, each of six bays with boxes on three levels."""
    b = RoomBuilder(np.random.default_rng([seed, 46]), np.zeros(3))
    rows = 4
    bays = 6
    bay = 1.6
    aisle = 2.4
    size = np.array([bays * bay + 3.0, rows * aisle + 1.2, 3.2])
    layout.put_shell(b, size)
    steel = b.paint((PLAIN,), 0.3, 0.6)
    for unit in range(rows * bays):
        x = 1.5 + bay * (unit // rows)
        y = 1.2 + aisle * (unit % rows)
        for level in (0.1, 1.0, 1.9):
            b.put([x + bay / 2, y, level], [bay, 0.8, 0.05], steel)
        b.put([x, y, 1.2], [0.08, 0.8, 2.4], steel)
        for number, own in enumerate(thing_seeds(seed, unit, 6, changed)):
            b.rng = np.random.default_rng(own)
            extent = b.rng.uniform([0.35, 0.4, 0.3], [0.7, 0.75, 0.8])
            z = (0.1, 1.0, 1.9)[number // 2] + 0.03 + extent[2] / 2
            at = [x + 0.4 + 0.75 * (number % 2), y, z]
            b.put(at, extent, b.paint((PLAIN, PLANKS, PICTURE, STRIPES), 0.15, 0.9))
    return (b.room(size, size * [0.5, 0.5, 0.95]),)


def hall(seed: int, changed: float) -> tuple[Room, ...]:
    """Make a room that half a turn about its middle takes to itself."""
    rng = np.random.default_rng([seed, 47])
    room = layout.make_room(seed, rng.uniform([3.5, 3.0, 2.3], [9.0, 7.0, 3.4]), np.zeros(3))
    x, y, _ = room.size
    is_long = room.boxes[:, 3] > 0.45 * x  # floor, ceiling and two of the walls: their half
    boxes = room.boxes.copy()
    boxes[is_long, 0] = 0.25 * x - 0.5 * layout.WALL_THICKNESS
    boxes[is_long, 3] = 0.25 * x + 0.5 * layout.WALL_THICKNESS
    is_kept = boxes[:, 0] < 0.5 * x
    half = room._replace(boxes=boxes[is_kept])
    own = room.materials[is_kept]
    other = own.copy()
    is_changed = rng.random(len(own)) < changed
    other[is_changed, 2:] = rng.permutation(own)[is_changed, 2:]  # in the colours of others
    symmetric = room._replace(
        boxes=np.vstack([half.boxes, place(half, np.zeros(3), is_turned=True).boxes]),
        materials=np.vstack([own, other]),
        light=np.array([0.5 * x, 0.5 * y, room.light[2]]),
        labels=np.tile(room.labels[is_kept], 2),
    )
    return (symmetric,)
