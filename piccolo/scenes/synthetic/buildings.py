"""Seeded clouds of places that mislead a search for up: clutter, roofs, stairs, missing floors, open ground.

Surfaces are sampled evenly, without a scanner's shadows but with its noise; of boxes and openings, tops and
undersides as scanners 1.2 to 1.9 m high see them. z is up. Places of odd seeds have
holes in the ground, where the scanner stood.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from ...geometry.pose import Array
from ...runtime.threads import Workers
from . import halls, interiors, outdoors
from .repeated import make_repeated
from .surfaces import DENSITY, SurfaceSampler, with_station_holes
from .world import make_world, random_size, scan_room, scan_world

ROOM_POINTS = 80_000
CLUTTER_FRACTION = 0.4
MARGIN = 0.05  # of a floor or ceiling that is taken away [m]


def _room(seed: int) -> Array:
    rng = np.random.default_rng([seed, 60])
    num_rooms = int(rng.integers(1, 3))
    world = make_world(seed, random_size(rng), num_rooms)
    return scan_world(world, ROOM_POINTS * num_rooms, Workers())[0].astype(np.float64)


def _cluttered(seed: int) -> Array:
    """A room of whose points 40 % are on small pieces at random angles, heaped up on its floor."""
    points = _room(seed)
    s = SurfaceSampler(np.random.default_rng([seed, 61]))
    low, high = points.min(axis=0), points.max(axis=0)
    num_clutter = len(points) * CLUTTER_FRACTION / (1.0 - CLUTTER_FRACTION)
    while sum(map(len, s.parts)) < num_clutter:
        at = s.rng.uniform(low, high)
        at[2] = low[2] + (high[2] - low[2]) * s.rng.beta(1.2, 2.0)
        a, b = s.rng.normal(size=(2, 3)) * 0.3
        s.parallelogram(at, a, b)
    return np.concatenate([points, s.points().clip(low, high)])


def _open_room(seed: int, is_open_above: bool) -> Array:
    """A room without its ceiling, or without its floor."""
    points = _room(seed)
    z = points[:, 2]
    return np.compress(z < z.max() - MARGIN if is_open_above else z > z.min() + MARGIN, points, axis=0)


def _attic(seed: int) -> Array:
    """Low walls, a slanted roof on both sides, furniture."""
    s = SurfaceSampler(np.random.default_rng([seed, 62]))
    x, y, wall = s.rng.uniform([5.0, 4.0, 0.4], [10.0, 8.0, 1.4])
    ridge = wall + 0.5 * y * np.tan(s.rng.uniform(0.5, 0.9))
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, y, 0])
    s.parallelogram([0, 0, 0], [x, 0, 0], [0, 0, wall])
    s.parallelogram([0, y, 0], [x, 0, 0], [0, 0, wall])
    s.parallelogram([0, 0, wall], [x, 0, 0], [0, y / 2, ridge - wall])
    s.parallelogram([0, y, wall], [x, 0, 0], [0, -y / 2, ridge - wall])
    for end in (0.0, x):
        yz = s.rng.uniform([0, 0], [y, ridge], (int(DENSITY * y * ridge), 2))
        roof = wall + (ridge - wall) * (1.0 - np.abs(2.0 * yz[:, 0] / y - 1.0))
        yz = yz[yz[:, 1] < roof]
        s.add(np.column_stack([np.full(len(yz), end), yz]))
    s.furnish(np.zeros(3), np.array([x, y, 0.0]), int(x * y / 5))
    return s.points()


def _stairwell(seed: int) -> Array:
    """Flights with steps, their undersides, landings and walls."""
    s = SurfaceSampler(np.random.default_rng([seed, 63]))
    width, tread, rise = s.rng.uniform([0.9, 0.25, 0.16], [1.3, 0.30, 0.19])
    num_steps, num_flights = int(s.rng.integers(8, 12)), int(s.rng.integers(2, 5))
    length, height = num_steps * tread, num_steps * rise
    x, y, z = length + 2 * width, 2 * width + 0.2, num_flights * height
    for flight in range(num_flights):
        at_y, sign = (0.0, 1.0) if flight % 2 == 0 else (width + 0.2, -1.0)
        begin = width if flight % 2 == 0 else width + length
        for k in range(num_steps):
            foot = np.array([begin + sign * k * tread, at_y, flight * height + k * rise])
            s.parallelogram(foot, [0, width, 0], [0, 0, rise])
            s.parallelogram(foot + np.array([0, 0, rise]), [0, width, 0], [sign * tread, 0, 0])
        if flight:
            s.parallelogram([begin, at_y, flight * height - 0.2], [0, width, 0], [sign * length, 0, height])
        landing = 0.0 if flight % 2 else x - width
        s.parallelogram([landing, 0, (flight + 1) * height], [width, 0, 0], [0, y, 0])
    s.shell(x, y, z + 2.3)
    return s.points()


def _bare(seed: int) -> Array:
    """A closed box with nothing in it: no honest answer is sure."""
    s = SurfaceSampler(np.random.default_rng([seed, 66]))
    s.shell(*s.rng.uniform([3.0, 3.0, 2.2], [8.0, 7.0, 4.0]))
    return s.points()


def _corridor(seed: int) -> Array:
    rng = np.random.default_rng([seed, 67])
    (corridor,) = make_repeated("corridor", seed, random_size(rng))
    return scan_room(corridor, 2 * ROOM_POINTS, rng, Workers())[0].astype(np.float64)


_KINDS: dict[str, Callable[[int], Array]] = {
    "room": _room,
    "clutter": _cluttered,
    "no ceiling": partial(_open_room, is_open_above=True),
    "no floor": partial(_open_room, is_open_above=False),
    "attic": _attic,
    "stairs": _stairwell,
    "outdoors": outdoors.outdoors,
    "aerial": outdoors.aerial,
    "front": outdoors.front,
    "corridor": _corridor,
    "bare": _bare,
    "showroom": halls.showroom,
    "racks": halls.racks,
    "shop": halls.shop,
    "warehouse": halls.warehouse,
    "garage": halls.garage,
    "church": halls.church,
    "tunnel": halls.tunnel,
    "parking deck": halls.parking,
    "basement": halls.basement,
    "storeys": interiors.storeys,
    "loft": interiors.loft,
    "furnished attic": interiors.furnished_attic,
    "cubicles": interiors.cubicles,
    "hotel": interiors.hotel,
    "lecture hall": interiors.lecture,
    "street": outdoors.street,
    "terrace": outdoors.terrace,
    "gable house": outdoors.gable_house,
    "roof": outdoors.roof,
    "courtyard": outdoors.courtyard,
}
FROM_ABOVE = ("aerial", "roof")  # a drone stands nowhere


def _scanned(kind: str, seed: int) -> Array:
    points = _KINDS[kind](seed)
    has_holes = seed % 2 == 1 and kind not in FROM_ABOVE
    return with_station_holes(points, np.random.default_rng([seed, 69])) if has_holes else points


BUILDINGS: dict[str, Callable[[int], Array]] = {  # points (N, 3) [m] by a seed
    kind: partial(_scanned, kind) for kind in _KINDS
}
