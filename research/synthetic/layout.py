"""The seeded layout of a room: boxes, each with a material."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from piccolo.system.arrays import Array, Int64s

PLAIN, PLANKS, TILES, STRIPES, CHECKS, PICTURE = range(6)
WALL_THICKNESS = 0.1  # [m]
LABEL_NAMES = (  # kinds of surfaces; a label is the place in this list, and 0 is nothing
    *("nothing", "floor", "ceiling", "wall", "picture", "window", "door"),
    *("rug", "table", "shelf", "sofa", "crate"),
    *("facade", "tree", "car", "pole"),
)
Pair = tuple[float, float]
DOOR_ROOM = 1.2  # left free before an open door [m]


@dataclass
class RoomBuilder:
    """Boxes as they are put into a room whose floor's corner is at `corner` (3,)."""

    rng: np.random.Generator
    corner: Array
    boxes: list[Array] = field(default_factory=list)
    materials: list[Array] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    kind: str = "nothing"  # of what is put next, one of LABEL_NAMES
    clear: list[tuple[Array, Array]] = field(default_factory=list)  # low, high (3,) of places to be left free

    def paint(self, patterns: tuple[int, ...], low: float, high: float) -> Array:
        """Draw a row of Room.materials: a pattern in two related colours with channels in [low, high]."""
        base = self.rng.uniform(low, high, 3)
        base = base.mean() + 0.5 * (base - base.mean())  # paints are paler than colours drawn at random
        other = np.clip(base * self.rng.uniform(0.55, 0.9) + self.rng.normal(0, 0.05, 3), 0, 1)
        pattern = self.rng.choice(patterns)
        scale = self.rng.uniform(0.12, 0.5)
        return np.array([pattern, scale, *base, *other, self.rng.integers(1, 1 << 20)], dtype=float)

    def put(
        self,
        center: ArrayLike,
        size: ArrayLike,
        material: Array,
        yaw: float = 0.0,
        offset: Pair = (0.0, 0.0),
        kind: str | None = None,
    ) -> None:
        """Add a box of `size` (3,) [m] turned by `yaw` at `center` (3,), relative to the corner [m].

        The `offset` of the centre is along the box's own x and y [m]; a `kind` is that of what follows too.
        """
        self.kind = kind or self.kind
        along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        middle = np.asarray(center) + offset[0] * along + offset[1] * across + self.corner
        self.boxes.append(np.array([*middle, *(np.asarray(size) / 2), yaw]))
        self.materials.append(material)
        self.labels.append(LABEL_NAMES.index(self.kind))

    def leave_clear(self, first: int) -> None:
        """Take back the boxes from number `first` on if one of them is in a place that is to be left free."""
        for box in self.boxes[first:]:
            c = abs(np.cos(box[6]))
            s = abs(np.sin(box[6]))
            half = np.array([c * box[3] + s * box[4], s * box[3] + c * box[4], box[5]])
            middle = box[:3] - self.corner
            if any(((middle - half < high) & (middle + half > low)).all() for low, high in self.clear):
                del self.boxes[first:], self.materials[first:], self.labels[first:]
                return

    def room(self, size: Array, light: Array) -> "Room":
        """Return the room of `size` (3,) [m] of all boxes, its lamp at `light` (3,) [m]."""
        boxes = np.stack(self.boxes)
        return Room(self.corner, size, boxes, np.stack(self.materials), light, np.array(self.labels))


class Door(NamedTuple):
    """An opening of a room's wall, from the floor up."""

    axis: int  # that the wall crosses: 0 is x
    is_far: bool  # the wall is at the far end of the axis
    middle: float  # along the wall [m]
    width: float = 1.0  # [m]
    height: float = 2.1  # [m]

    def clear(self, size: Array, depth: float) -> tuple[Array, Array]:
        """Least and greatest corner (3,) of what is in the door and up to `depth` [m] before it."""
        wall = self.axis
        low = np.array([0.0, 0.0, 0.02])
        high = np.full(3, self.height)
        low[1 - wall] = self.middle - 0.5 * self.width - 0.1
        high[1 - wall] = self.middle + 0.5 * self.width + 0.1
        low[wall] = size[wall] - depth if self.is_far else -0.2
        high[wall] = size[wall] + 0.2 if self.is_far else depth
        return low, high


class Room(NamedTuple):
    """A closed room full of boxes, or an open place; z up."""

    corner: Array  # (3,) least corner of the free space [m]
    size: Array  # (3,) [m]
    boxes: Array  # (B, 7) center (3) [m], half size (3) [m], yaw [rad]
    materials: Array  # (B, 9) pattern, scale [m], two colours (3) in [0, 1], seed
    light: Array  # (3,) position of the lamp [m], or (B, 3) of each box's
    labels: Int64s  # (B,) see LABEL_NAMES
    sky: tuple[float, float, float] | None = (
        None  # its colour in [0, 1] above an open place; then `light` is a sun
    )

    def clearance(self, position: Array) -> float:
        """Distance [m] from `position` (3,) to the nearest surface; negative inside a box, unseen by rays."""
        return float(box_distances(self.boxes, position).min())


def box_distances(boxes: Array, position: Array) -> Array:
    """Return the distance (B,) [m] from `position` (3,) to each box (B, 7); negative inside of it."""
    offset = position - boxes[:, :3]
    c = np.cos(boxes[:, 6])
    s = np.sin(boxes[:, 6])
    along = c * offset[:, 0] + s * offset[:, 1]
    across = c * offset[:, 1] - s * offset[:, 0]
    beyond = np.abs(np.stack([along, across, offset[:, 2]], axis=1)) - boxes[:, 3:6]
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


def put_shell(b: RoomBuilder, size: Array, doors: Sequence[Door] = ()) -> None:
    """Floor, ceiling and four walls, open at the doors."""
    x, y, z = size
    d = WALL_THICKNESS
    ceiling = b.paint((PLAIN,), 0.75, 0.95)
    extent = [x + 2 * d, y + 2 * d, d]
    b.put([x / 2, y / 2, -d / 2], extent, b.paint((PLANKS, TILES), 0.35, 0.75), kind="floor")
    b.put([x / 2, y / 2, z + d / 2], extent, ceiling, kind="ceiling")
    put_walls(b, size, doors)


def put_walls(b: RoomBuilder, size: Array, doors: Sequence[Door]) -> None:
    """Four walls, each of one paint, open at the doors."""
    b.kind = "wall"
    for wall in itertools.product((0, 1), (False, True)):
        own = [door for door in doors if (door.axis, door.is_far) == wall]
        put_wall(b, size, wall, b.paint((PLAIN, PLAIN, STRIPES, TILES), 0.5, 0.9), own)


def put_wall(
    b: RoomBuilder, size: Array, wall: tuple[int, bool], paint: Array, doors: Sequence[Door]
) -> None:
    """Add the wall at the near or far end of an axis: pieces next to its doors and above them."""
    axis, is_far = wall
    along = 1 - axis

    def put_piece(begin: float, end: float, bottom: float) -> None:
        center = size / 2
        center[axis] = size[axis] + WALL_THICKNESS / 2 if is_far else -WALL_THICKNESS / 2
        center[along] = (begin + end) / 2
        center[2] = (bottom + size[2]) / 2
        extent = np.full(3, WALL_THICKNESS)
        extent[along] = end - begin
        extent[2] = size[2] - bottom
        b.put(center, extent, paint)

    begin = 0.0
    for door in sorted(doors, key=lambda door: door.middle):
        left = door.middle - door.width / 2
        right = door.middle + door.width / 2
        put_piece(begin, left, 0.0)
        put_piece(left, right, door.height)
        begin = right
    put_piece(begin, size[along], 0.0)


def put_hangings(b: RoomBuilder, size: Array) -> None:
    """Pictures, a door and windows: thin boxes on the walls."""
    draw = b.rng.uniform
    for axis in (0, 1):
        along = 1 - axis
        for side in (0.0, size[axis]):
            for kind in b.rng.permutation(["picture", "picture", "window", "door"])[: b.rng.integers(2, 5)]:
                width, height, middle, patterns, low, high = {
                    "picture": (draw(0.4, 1.1), draw(0.3, 0.8), draw(1.3, 1.8), (PICTURE,), 0.1, 1.0),
                    "window": (draw(0.8, 1.4), draw(0.8, 1.1), 1.5, (CHECKS,), 0.7, 1.0),
                    "door": (0.9, 2.0, 1.0, (PLAIN, PLANKS), 0.2, 0.6),
                }[kind]
                center = np.full(3, min(middle, size[2] - height / 2))
                center[axis] = side
                center[along] = b.rng.uniform(width / 2, size[along] - width / 2)
                extent = np.full(3, 0.03)
                extent[along] = width
                extent[2] = height
                b.put(center, extent, b.paint(patterns, low, high), kind=str(kind))
                b.leave_clear(len(b.boxes) - 1)


def put_table(b: RoomBuilder, at: Array, yaw: float) -> None:
    """Add a table with an object on it, at (2,) of the floor."""
    length, width, height = b.rng.uniform([0.9, 0.6, 0.5], [1.6, 0.9, 0.8])
    wood = b.paint((PLANKS, PLAIN), 0.2, 0.7)
    b.put([*at, height], [length, width, 0.04], wood, yaw)
    for x, y in itertools.product((-1, 1), (-1, 1)):
        offset = (x * (length / 2 - 0.05), y * (width / 2 - 0.05))
        b.put([*at, height / 2], [0.06, 0.06, height], wood, yaw, offset)
    b.put([*at, height + 0.12], b.rng.uniform(0.1, 0.25, 3), b.paint((CHECKS, PICTURE), 0.1, 1.0), yaw)


def put_shelf(b: RoomBuilder, at: Array, yaw: float) -> None:
    """Add a shelf with books, at (2,) of the floor."""
    height = b.rng.uniform(1.2, 2.0)
    frame = b.paint((PLANKS, PLAIN), 0.2, 0.8)
    b.put([*at, height / 2], [0.9, 0.02, height], frame, yaw)
    for level in np.arange(0.05, height, 0.35):
        b.put([*at, level], [0.9, 0.35, 0.03], frame, yaw)
        x = b.rng.uniform(-0.2, 0.2)
        books = [b.rng.uniform(0.3, 0.5), 0.2, b.rng.uniform(0.15, 0.28)]
        b.put([*at, level + books[2] / 2], books, b.paint((STRIPES,), 0.1, 0.9), yaw, (x, 0.0))


def put_sofa(b: RoomBuilder, at: Array, yaw: float) -> None:
    """Add a sofa, at (2,) of the floor."""
    length = b.rng.uniform(1.2, 2.0)
    cloth = b.paint((PLAIN, STRIPES, CHECKS), 0.15, 0.8)
    b.put([*at, 0.22], [length, 0.8, 0.44], cloth, yaw)
    b.put([*at, 0.5], [length, 0.15, 0.9], cloth, yaw, (0.0, 0.35))


def put_crate(b: RoomBuilder, at: Array, yaw: float) -> None:
    """Add a crate, at (2,) of the floor."""
    size = b.rng.uniform([0.3, 0.3, 0.3], [0.7, 0.7, 1.3])
    b.put([*at, size[2] / 2], size, b.paint((PLANKS, CHECKS, PICTURE, PLAIN), 0.15, 0.9), yaw)


def put_furniture(
    b: RoomBuilder, size: Array, moves: np.random.Generator | None = None, area: float = 3.0
) -> None:
    """Add a rug and a piece of furniture per `area` [m2]; with `moves` half of them stand elsewhere."""
    num_pieces = max(3, round(size[0] * size[1] / area))
    seeds = b.rng.integers(0, 1 << 30, num_pieces)
    rug = [size[0] * b.rng.uniform(0.3, 0.6), size[1] * b.rng.uniform(0.3, 0.6), 0.01]
    b.put([size[0] / 2, size[1] / 2, 0.005], rug, b.paint((CHECKS, STRIPES, PICTURE), 0.1, 0.8), kind="rug")
    b.leave_clear(len(b.boxes) - 1)
    pieces = {"table": put_table, "shelf": put_shelf, "sofa": put_sofa, "crate": put_crate}
    kinds = ("table", "shelf", "sofa", "crate", "crate")
    for seed in seeds:  # each of its own stream, so that a piece that moves stays what it is
        b.rng = np.random.default_rng(seed)
        b.kind = kinds[b.rng.integers(len(kinds))]
        where = moves if moves is not None and moves.random() < 0.5 else np.random.default_rng([seed, 1])
        at = where.uniform([0.5, 0.5], size[:2] - 0.5)
        yaw = float(where.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]) + where.normal(0, 0.2))
        first = len(b.boxes)
        pieces[b.kind](b, at, yaw)
        b.leave_clear(first)


def make_room(seed: int, size: Array, corner: Array, changed: int = 0, doors: Sequence[Door] = ()) -> Room:
    """Make the room of `seed`; each `changed` above 0 has the same shell, other furniture and more crates."""
    shell_rng = np.random.default_rng([seed, 0])
    b = RoomBuilder(shell_rng, np.asarray(corner, dtype=float))
    size = np.asarray(size, dtype=float)
    b.clear = [door.clear(size, DOOR_ROOM) for door in doors]
    put_shell(b, size, doors)
    put_hangings(b, size)
    b.rng = np.random.default_rng([seed, 1])
    moves = np.random.default_rng([seed, 2, changed]) if changed else None
    put_furniture(b, size, moves)
    if moves is not None:
        b.rng = moves
        b.kind = "crate"
        for _ in range(3):
            put_crate(b, moves.uniform([0.5, 0.5], size[:2] - 0.5), float(moves.uniform(0, np.pi)))
    return b.room(size, b.corner + size * [*shell_rng.uniform(0.35, 0.65, 2), 0.93])


def join_rooms(rooms: Sequence[Room]) -> Room:
    """Return the first of several rooms with the boxes of all, each lit as in its own room."""
    return rooms[0]._replace(
        boxes=np.concatenate([room.boxes for room in rooms]),
        materials=np.concatenate([room.materials for room in rooms]),
        light=np.concatenate([np.broadcast_to(room.light, (len(room.boxes), 3)) for room in rooms]),
        labels=np.concatenate([room.labels for room in rooms]),
    )
