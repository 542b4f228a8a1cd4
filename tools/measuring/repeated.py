"""Places that look the same from several poses: twin rooms, a symmetric hall, a corridor of equal doors."""

import numpy as np

from piccolo.geometry.pose import Array
from piccolo.scenes.synthetic.floor_plan import CORRIDOR_WIDTH
from piccolo.scenes.synthetic.room import (
    PICTURE,
    PLAIN,
    PLANKS,
    TILES,
    WALL_THICKNESS,
    Room,
    RoomBuilder,
    make_room,
)

REPEATED_KINDS = ("twins", "hall", "corridor")
GAP = 0.4  # between twins [m]
NUM_DOORS = 6
DOOR_DISTANCE = 3.0  # [m]


def make_repeated(kind: str, seed: int, size: Array) -> tuple[Room, ...]:
    """Rooms of one of REPEATED_KINDS; a corridor has a length and a width of its own."""
    if kind == "twins":
        return twin_rooms(seed, size)
    return (symmetric_hall(seed, size) if kind == "hall" else corridor(seed, float(size[2])),)


def twin_rooms(seed: int, size: Array) -> tuple[Room, Room]:
    """The same furnished room twice, side by side."""
    room = make_room(seed, size, np.zeros(3))
    shift = np.array([room.size[0] + GAP, 0.0, 0.0])
    boxes = room.boxes + np.array([*shift, 0.0, 0.0, 0.0, 0.0])
    return room, room._replace(corner=room.corner + shift, boxes=boxes, light=room.light + shift)


def symmetric_hall(seed: int, size: Array) -> Room:
    """A room that half a turn about its middle takes to itself."""
    room = make_room(seed, size, np.zeros(3))
    x, y, _ = room.size
    is_long = room.boxes[:, 3] > 0.45 * x  # floor, ceiling and two of the walls: their half
    boxes = room.boxes.copy()
    boxes[is_long, 0], boxes[is_long, 3] = 0.25 * x - 0.5 * WALL_THICKNESS, 0.25 * x + 0.5 * WALL_THICKNESS
    is_kept = boxes[:, 0] < 0.5 * x
    half, materials = boxes[is_kept], np.tile(room.materials[is_kept], (2, 1))
    turned = half.copy()
    turned[:, 0], turned[:, 1], turned[:, 6] = x - half[:, 0], y - half[:, 1], half[:, 6] + np.pi
    light = np.array([0.5 * x, 0.5 * y, room.light[2]])
    labels = np.tile(room.labels[is_kept], 2)
    return Room(room.corner, room.size, np.vstack([half, turned]), materials, light, labels)


def corridor(seed: int, height: float) -> Room:
    """A corridor whose doors and pictures repeat; both ends are alike."""
    b = RoomBuilder(np.random.default_rng([seed, 3]), np.zeros(3))
    length, width, d = DOOR_DISTANCE, CORRIDOR_WIDTH, WALL_THICKNESS
    floor, ceiling = b.paint((PLANKS, TILES), 0.3, 0.7), b.paint((PLAIN,), 0.75, 0.95)
    walls = [b.paint((PLAIN,), 0.5, 0.9) for _ in range(2)]
    door, picture = b.paint((PLANKS,), 0.2, 0.6), b.paint((PICTURE,), 0.1, 1.0)
    for k in range(NUM_DOORS):
        x = (k + 0.5) * length
        b.put([x, width / 2, -d / 2], [length, width + 2 * d, d], floor)
        b.put([x, width / 2, height + d / 2], [length, width + 2 * d, d], ceiling)
        b.put([x, -d / 2, height / 2], [length, d, height], walls[0])
        b.put([x, width + d / 2, height / 2], [length, d, height], walls[1])
        b.put([x, 0.0, 1.0], [0.9, 0.06, 2.0], door)
        b.put([x, width, 1.5], [0.8, 0.06, 0.6], picture)
    for x in (-d / 2, NUM_DOORS * length + d / 2):
        b.put([x, width / 2, height / 2], [d, width, height], walls[0])
    size = np.array([NUM_DOORS * length, width, height])
    light = size * [0.5, 0.5, 0.93]
    return Room(b.corner, size, np.stack(b.boxes), np.stack(b.materials), light, np.array(b.labels))
