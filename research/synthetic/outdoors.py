"""Places outdoors: a yard between houses, a street, a square before a front with towers; under a sun."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from piccolo.system.arrays import Array

from .layout import CHECKS, PICTURE, PLAIN, PLANKS, STRIPES, TILES, Pair, Room, RoomBuilder

PLACE_KINDS = ("yard", "street", "front")
SKY = (0.62, 0.74, 0.9)
SUN = 1e5 * np.array([0.45, 0.3, 0.84])  # [m] so far that its rays are parallel
STOREY = 3.4  # [m]
DEPTH = 8.0  # of a house [m]
PROUD = 0.06  # by which windows, bands and doors stand out [m]
GREEN = (0.2, 0.33, 0.12)
BARK = (0.3, 0.22, 0.16)
ASPHALT = (0.3, 0.3, 0.31)
GLASS = (0.16, 0.19, 0.23)
LAWN_SHARE = 0.5  # of yards


class Place(NamedTuple):
    """An open place, and where in it one walks, drives and looks."""

    kind: str  # one of PLACE_KINDS
    seed: int
    room: Room
    free: Array  # (2, 2) least and greatest corner of the ground where people stand [m]
    way: Array  # (2, 2) begin and end of the way of a car or of a person who scans [m]
    focus: Array | None  # (2,) what people look at [m]; None if they look anywhere


class Front(NamedTuple):
    """A house front's lower left corner as seen from before it, and the direction to its right."""

    corner: Array  # (2,) [m]
    yaw: float  # [rad] of the direction along it; the house lies to its left


def tint(b: RoomBuilder, patterns: tuple[int, ...], color: ArrayLike, scale: Pair) -> Array:
    """Draw a row of Room.materials whose colours are near one, of patterns of a size in `scale` [m]."""
    base = np.clip(np.asarray(color) * b.rng.uniform(0.8, 1.2) + b.rng.normal(0.0, 0.02, 3), 0.03, 0.97)
    other = np.clip(base * b.rng.uniform(0.55, 0.8), 0.0, 1.0)
    seed = b.rng.integers(1, 1 << 20)
    return np.array([b.rng.choice(patterns), b.rng.uniform(*scale), *base, *other, seed], dtype=float)


def put_on_front(
    b: RoomBuilder, front: Front, middle: ArrayLike, size: ArrayLike, material: Array, out: float = 0.0
) -> None:
    """Add a box at (along, up) of a front [m], of a size (along, across, up), standing out by `out` [m]."""
    along, up = np.asarray(middle, dtype=float)
    extent = np.asarray(size, dtype=float)
    center = np.array([*front.corner, up])
    b.put(center, extent, material, front.yaw, (along, 0.5 * extent[1] - out))


def put_house(b: RoomBuilder, front: Front, length: float, height: float) -> None:
    """Add a house: wall, bands between storeys, windows with sills and frames, and a door."""
    draw = b.rng.uniform
    b.kind = "facade"
    plaster = draw(0.4, 0.85, 3)
    plaster = plaster.mean() + 0.5 * (plaster - plaster.mean())
    wall = tint(b, (PLAIN, TILES, PLAIN, PLANKS), plaster, (0.25, 0.6))
    put_on_front(b, front, [length / 2, height / 2], [length, DEPTH, height], wall)
    trim = tint(b, (PLAIN,), np.clip(1.25 * plaster, 0.0, 0.95), (0.3, 0.6))
    stone = tint(b, (TILES,), 0.7 * plaster, (0.4, 0.8))
    put_on_front(b, front, [length / 2, 0.5], [length, DEPTH, 1.0], stone, 0.5 * PROUD)
    put_on_front(b, front, [length / 2, height - 0.2], [length, DEPTH, 0.4], trim, 4.0 * PROUD)
    bay = draw(2.2, 3.2)
    count = max(int(length / bay), 1)
    width = draw(0.9, 1.4)
    tall = draw(1.4, 2.0)
    door = int(b.rng.integers(count))
    for storey in range(int((height - 0.8) / STOREY)):
        if storey:
            put_on_front(b, front, [length / 2, storey * STOREY], [length, 0.3, 0.25], trim, PROUD)
        for k in range(count):
            along = (k + 0.5) * length / count + draw(-0.06, 0.06)
            if storey == 0 and k == door:
                wood = b.paint((PLANKS, PICTURE), 0.1, 0.6)
                put_on_front(b, front, [along, 1.2], [1.3, 0.3, 2.4], wood, PROUD)
                continue
            put_window(b, front, [along, storey * STOREY + 1.9], (width, tall), trim)
    put_clutter(b, front, length, height)


def put_window(b: RoomBuilder, front: Front, middle: Sequence[float], size: Pair, trim: Array) -> None:
    """Add a window: frame, panes of glass or curtains, sill, and shutters at some."""
    draw = b.rng.uniform
    width, tall = size
    along, up = middle
    put_on_front(b, front, middle, [width + 0.24, 0.3, tall + 0.24], trim, PROUD)
    curtain = b.paint((STRIPES, PICTURE, CHECKS), 0.3, 0.9)
    pane = curtain if draw() < 0.35 else tint(b, (PICTURE, CHECKS), GLASS, (0.4, 0.8))
    put_on_front(b, front, middle, [width, 0.3, tall], pane, PROUD + 0.02)
    if draw() < 0.5:  # a blind that is half down
        fallen = draw(0.2, 0.8) * tall
        blind = b.paint((STRIPES, PLAIN), 0.4, 0.9)
        put_on_front(b, front, [along, up + 0.5 * (tall - fallen)], [width, 0.3, fallen], blind, PROUD + 0.03)
    sill = [along, up - 0.5 * tall - 0.16]
    put_on_front(b, front, sill, [width + 0.4, 0.3, 0.08], trim, 3.0 * PROUD)


def put_clutter(b: RoomBuilder, front: Front, length: float, height: float) -> None:
    """Add to a front what no other has: signs, pipes, stains of other plaster."""
    draw = b.rng.uniform
    for _ in range(b.rng.integers(2, 5)):
        middle = [draw(0.6, length - 0.6), draw(2.4, 3.4)]
        sign = b.paint((PICTURE, STRIPES, CHECKS), 0.05, 1.0)
        put_on_front(b, front, middle, [draw(0.5, 1.8), 0.3, draw(0.3, 0.7)], sign, 2.0 * PROUD)
    pipe = tint(b, (PLAIN,), (0.45, 0.42, 0.38), (0.3, 0.5))
    put_on_front(b, front, [draw(0.2, length - 0.2), height / 2], [0.12, 0.3, height], pipe, 2.5 * PROUD)


def put_tree(b: RoomBuilder, at: ArrayLike) -> None:
    """Add a tree at (2,) of the ground: a trunk, and a crown of turned boxes."""
    draw = b.rng.uniform
    b.kind = "tree"
    x, y = np.asarray(at, dtype=float)
    trunk = draw(1.8, 3.0)
    b.put([x, y, trunk / 2], [0.3, 0.3, trunk], tint(b, (STRIPES, PLANKS), BARK, (0.1, 0.3)))
    radius = draw(1.2, 2.2)
    for _ in range(16):
        offset = b.rng.normal(0.0, 0.5 * radius, 3) * [1.0, 1.0, 0.8]
        extent = draw(0.5, 1.4, 3)
        center = np.array([x, y, trunk + radius]) + offset
        center[2] = max(center[2], trunk)
        b.put(center, extent, tint(b, (PICTURE, CHECKS), GREEN, (0.15, 0.4)), draw(0.0, np.pi))


def put_car(b: RoomBuilder, at: ArrayLike, yaw: float) -> None:
    """Add a car at (2,) of the ground."""
    b.kind = "car"
    x, y = np.asarray(at, dtype=float)
    paint = b.paint((PLAIN,), 0.05, 0.9)
    b.put([x, y, 0.68], [4.3, 1.75, 0.66], paint, yaw)
    b.put([x, y, 1.23], [2.3, 1.6, 0.5], tint(b, (PICTURE,), GLASS, (0.4, 0.8)), yaw, (-0.2, 0.0))
    b.put([x, y, 1.5], [2.1, 1.5, 0.06], paint, yaw, (-0.2, 0.0))
    rubber = tint(b, (PLAIN,), (0.08, 0.08, 0.08), (0.2, 0.3))
    for along in (-1.35, 1.35):
        b.put([x, y, 0.32], [0.64, 1.78, 0.62], rubber, yaw, (along, 0.0))
    plate = b.paint((STRIPES, CHECKS), 0.3, 1.0)
    b.put([x, y, 0.6], [4.34, 0.5, 0.12], plate, yaw)


def put_pole(b: RoomBuilder, at: ArrayLike) -> None:
    """Add a pole with a lamp and a sign, at (2,) of the ground."""
    b.kind = "pole"
    x, y = np.asarray(at, dtype=float)
    height = b.rng.uniform(4.0, 7.0)
    metal = tint(b, (PLAIN,), (0.4, 0.42, 0.4), (0.3, 0.5))
    b.put([x, y, height / 2], [0.14, 0.14, height], metal)
    b.put([x, y, height], [0.9, 0.3, 0.15], metal, b.rng.uniform(0.0, np.pi))
    sign = b.paint((PICTURE, STRIPES), 0.05, 1.0)
    b.put([x, y, b.rng.uniform(2.0, 3.0)], [0.6, 0.05, 0.6], sign, b.rng.uniform(0.0, np.pi))


def put_ground(b: RoomBuilder, low: Array, high: Array, material: Array, top: float = 0.0) -> None:
    """Add a piece of ground between two corners (2,), whose top is at a height [m]."""
    middle = 0.5 * (low + high)
    b.kind = "floor"
    b.put([*middle, top - 0.25], [*(high - low), 0.5], material)


def put_patches(b: RoomBuilder, low: Array, high: Array, count: int) -> None:
    """Add manholes, mended asphalt, drains and leaves to a ground."""
    b.kind = "floor"
    for _ in range(count):
        x, y = b.rng.uniform(low, high)
        extent = [*b.rng.uniform(0.4, 2.5, 2), 0.02]
        patch = b.paint((PICTURE, TILES, CHECKS, PLAIN), 0.15, 0.6)
        b.put([x, y, 0.0], extent, patch, b.rng.uniform(0.0, np.pi))


def put_row(b: RoomBuilder, front: Front, length: float, heights: Pair) -> None:
    """Add a row of houses of different widths and heights along a front."""
    begin = 0.0
    along = np.array([np.cos(front.yaw), np.sin(front.yaw)])
    while begin < length:
        own = min(b.rng.uniform(9.0, 16.0), length - begin)
        if length - begin - own < 4.0:
            own = length - begin
        put_house(b, Front(front.corner + begin * along, front.yaw), own, b.rng.uniform(*heights))
        begin += own


def make_yard(b: RoomBuilder) -> tuple[Array, Array, Array | None]:
    """Put a yard of some 40 x 35 m between houses, with trees; return its `free`, `way` and `focus`."""
    draw = b.rng.uniform
    x, y = draw([34.0, 30.0], [44.0, 38.0])
    paving = tint(b, (TILES,), (0.5, 0.47, 0.43), (0.3, 0.6))
    put_ground(b, np.array([-DEPTH, -DEPTH]), np.array([x + DEPTH, y + DEPTH]), paving)
    if draw() < LAWN_SHARE:
        lawn = tint(b, (PICTURE,), (0.3, 0.42, 0.18), (0.3, 0.6))
        put_ground(b, np.array([0.25 * x, 0.25 * y]), np.array([0.75 * x, 0.7 * y]), lawn, 0.08)
    put_patches(b, np.zeros(2), np.array([x, y]), 14)
    for corner, yaw, length in (([x, 0], np.pi, x), ([x, y], -0.5 * np.pi, y)):
        put_row(b, Front(np.array(corner, dtype=float), yaw), length, (10.0, 15.0))
    for corner, yaw, length in (([0, y], 0.0, x), ([0, 0], 0.5 * np.pi, y)):
        put_row(b, Front(np.array(corner, dtype=float), yaw), length, (10.0, 15.0))
    for _ in range(b.rng.integers(4, 8)):
        put_tree(b, draw([4.0, 4.0], [x - 4.0, y - 4.0]))
    for _ in range(2):
        put_car(b, draw([4.0, 3.0], [x - 4.0, 5.0]), draw(-0.2, 0.2))
    put_pole(b, [0.5 * x, 0.2 * y])
    free = np.array([[3.0, 3.0], [x - 3.0, y - 3.0]])
    return free, np.array([[0.15 * x, 0.3 * y], [0.85 * x, 0.6 * y]]), None


def make_street(b: RoomBuilder) -> tuple[Array, Array, Array | None]:
    """Put a street of 90 m with houses, parked cars, trees and poles; return its `free`, `way`, `focus`."""
    draw = b.rng.uniform
    length = 90.0
    width = draw(15.0, 20.0)
    low = np.array([-10.0, -DEPTH])
    put_ground(b, low, np.array([length + 10.0, width + DEPTH]), tint(b, (PLAIN,), ASPHALT, (0.4, 0.8)))
    for edge in (0.0, width - 3.0):
        paving = tint(b, (TILES,), (0.52, 0.5, 0.47), (0.3, 0.5))
        put_ground(b, np.array([-10.0, edge]), np.array([length + 10.0, edge + 3.0]), paving, 0.12)
    for x in np.arange(0.0, length, 6.0):
        b.put([x, width / 2, 0.0], [3.0, 0.15, 0.02], tint(b, (PLAIN,), (0.85, 0.85, 0.82), (0.3, 0.6)))
    put_patches(b, np.array([0.0, 3.0]), np.array([length, width - 3.0]), 25)
    put_row(b, Front(np.array([length, 0.0]), np.pi), length, (8.0, 17.0))
    put_row(b, Front(np.array([0.0, width]), 0.0), length, (8.0, 17.0))
    put_row(b, Front(np.array([length + 6.0, width + DEPTH]), -0.5 * np.pi), width + 2.0 * DEPTH, (9.0, 14.0))
    for side in (4.0, width - 4.0):
        for x in np.arange(4.0, length - 4.0, 6.0):
            if draw() < 0.6:
                put_car(b, [x + draw(-0.5, 0.5), side], draw(-0.05, 0.05))
    for x in np.arange(8.0, length, 17.0):
        put_tree(b, [x + draw(-2.0, 2.0), width - 1.8])
        put_pole(b, [x + draw(3.0, 8.0), 2.4])
    free = np.array([[6.0, width / 2 - 2.0], [length - 25.0, width / 2 + 2.0]])
    return free, np.array([[2.0, width / 2 - 1.6], [length - 6.0, width / 2 - 1.6]]), None


def put_church(b: RoomBuilder, front: Front, length: float) -> None:
    """Add a front of stone with a gable, portals, columns and windows between two towers."""
    draw = b.rng.uniform
    b.kind = "facade"
    stone = draw(0.45, 0.7) * np.array([1.0, 0.94, 0.85])
    side = draw(6.5, 8.0)
    nave = draw(17.0, 22.0)
    put_on_front(b, front, [length / 2, nave / 2], [length, 12.0, nave], tint(b, (TILES,), stone, (0.5, 0.9)))
    trim = tint(b, (PLAIN, TILES), np.clip(1.2 * stone, 0.0, 0.95), (0.3, 0.6))
    for up in (5.5, 11.5, nave - 0.4):
        put_on_front(b, front, [length / 2, up], [length + 0.3, 1.0, 0.5], trim, 0.3)
    for begin in (0.0, length - side):
        put_tower(b, front, begin, side, stone)
    for along in (0.5 * length, 0.5 * length - 5.0, 0.5 * length + 5.0):
        wood = b.paint((PLANKS, PICTURE), 0.1, 0.5)
        put_on_front(b, front, [along, 2.6], [3.4, 1.0, 5.2], trim, 0.35)
        put_on_front(b, front, [along, 2.1], [2.4, 1.0, 4.2], wood, 0.4)
        put_on_front(b, front, [along, 8.6], [1.9, 1.0, 4.0], b.paint((CHECKS, PICTURE), 0.1, 0.7), 0.12)
    rose = b.paint((PICTURE, CHECKS), 0.1, 0.8)
    put_on_front(b, front, [length / 2, 14.5], [4.2, 1.0, 4.2], rose, 0.15)
    for along in np.linspace(side + 0.6, length - side - 0.6, 6):
        column = tint(b, (PLAIN, TILES), 1.1 * stone, (0.4, 0.8))
        put_on_front(b, front, [along, 0.35 * nave], [0.55, 1.0, 0.7 * nave], column, 0.5)
    for _ in range(8):  # statues in niches
        middle = [draw(0.2 * length, 0.8 * length), draw(5.8, nave - 1.5)]
        put_on_front(b, front, middle, [0.7, 1.0, 1.7], tint(b, (PICTURE,), 0.7 * stone, (0.2, 0.5)), 0.3)


def put_tower(b: RoomBuilder, front: Front, begin: float, side: float, stone: Array) -> None:
    """Add a tower with bands, belfry windows and a smaller top, from `begin` along a front."""
    draw = b.rng.uniform
    height = draw(32.0, 40.0)
    middle = begin + side / 2
    wall = tint(b, (TILES,), stone, (0.5, 0.9))
    put_on_front(b, front, [middle, height / 2], [side, side, height], wall, 0.8)
    put_on_front(b, front, [middle, height + 3.0], [0.6 * side, 0.6 * side, 6.0], wall, -0.2 * side)
    trim = tint(b, (PLAIN,), 1.15 * stone, (0.3, 0.6))
    for up in np.arange(5.5, height, draw(5.0, 6.5)):
        put_on_front(b, front, [middle, up], [side + 0.4, side + 0.4, 0.45], trim, 1.0)
        for offset in (-0.22 * side, 0.22 * side):
            glass = b.paint((CHECKS, PICTURE, STRIPES), 0.05, 0.5)
            place = [middle + offset, up + draw(2.2, 2.6)]
            put_on_front(b, front, place, [1.2, 1.0, draw(2.2, 3.2)], glass, 0.9)


def make_front(b: RoomBuilder) -> tuple[Array, Array, Array | None]:
    """Put a church front on a square with low houses at its sides; return `free`, `way` and `focus`."""
    draw = b.rng.uniform
    length = draw(24.0, 30.0)
    reach = draw(30.0, 38.0)
    low = np.array([-16.0, -reach - 6.0])
    put_ground(b, low, np.array([length + 16.0, 14.0]), tint(b, (TILES,), (0.48, 0.46, 0.42), (0.4, 0.8)))
    put_patches(b, np.array([-8.0, -reach]), np.array([length + 8.0, -2.0]), 20)
    put_church(b, Front(np.zeros(2), 0.0), length)
    put_row(b, Front(np.array([-10.0, -reach]), 0.5 * np.pi), reach + 4.0, (7.0, 11.0))
    put_row(b, Front(np.array([length + 10.0, 4.0]), -0.5 * np.pi), reach + 4.0, (7.0, 11.0))
    for x in (-6.0, length + 6.0):
        put_tree(b, [x, -draw(6.0, 20.0)])
        put_pole(b, [x + draw(-1.0, 1.0), -draw(20.0, 28.0)])
    put_car(b, [length + 5.0, -draw(4.0, 12.0)], 0.5 * np.pi)
    free = np.array([[0.0, -reach + 2.0], [length, -12.0]])
    return free, np.array([[-4.0, -18.0], [length + 4.0, -22.0]]), np.array([0.5 * length, 0.0])


def make_place(kind: str, seed: int) -> Place:
    """Make the place of a kind and a seed."""
    b = RoomBuilder(np.random.default_rng([seed, 60, PLACE_KINDS.index(kind)]), np.zeros(3))
    free, way, focus = {"yard": make_yard, "street": make_street, "front": make_front}[kind](b)
    size = np.array([*(free[1] - free[0]), 40.0])
    room = b.room(size, SUN)._replace(sky=SKY)
    return Place(kind, seed, room, free, way, focus)
