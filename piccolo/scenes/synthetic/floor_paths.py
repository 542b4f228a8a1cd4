"""Ways for a person through the free space of a building: a grid a storey, joined along the stairs."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from ...geometry.pose import Array
from .floor_plan import Flight
from .office import Office

CELL = 0.1  # [m]
STEP_OVER, HEAD = 0.15, 1.85  # what is between these heights is in a person's way [m]
LEAST, LIKED, PRICE = 0.3, 0.25, 2.0  # distance from things; how it is weighed [m]
LANDING = 0.4  # between the stairs and where one turns [m]


@dataclass(frozen=True)
class FreeSpace:
    """Where a person can walk, and at what cost from cell to cell."""

    office: Office
    origin: Array  # (2,) of the least cell's least corner [m]
    clearance: Array  # (S, Y, X) distance of each cell to what is in the way [m]
    costs: csr_array  # (N, N) over all cells, one triangle
    stairs: dict[tuple[int, int], Flight]  # by the cells before and after them

    def position(self, cell: int) -> Array:
        """The middle (3,) of a cell, on the floor [m]."""
        storey, y, x = np.unravel_index(cell, self.clearance.shape)
        return np.array([*(self.origin + CELL * (np.array([x, y]) + 0.5)), self.office.levels[storey]])

    def cell(self, position: Array) -> int:
        """The cell of a position (3,) on a floor."""
        storey = int(np.abs(self.office.levels - position[2]).argmin())
        x, y = ((position[:2] - self.origin) / CELL).astype(int)
        return int(np.ravel_multi_index((storey, y, x), self.clearance.shape))

    def clearance_at(self, positions: Array) -> Array:
        """The clearance (N,) [m] at positions (N, 3) on floors."""
        return self.clearance.ravel()[[self.cell(position) for position in positions]]

    def cells_of_room(self, number: int) -> NDArray[np.int64]:
        """The cells of a room that a person can stand on."""
        room = self.office.world.rooms[number]
        storey = int(np.abs(self.office.levels - room.corner[2]).argmin())
        low, high = (
            ((end[:2] - self.origin) / CELL).astype(int) for end in (room.corner, room.corner + room.size)
        )
        cells = np.arange(self.clearance.size).reshape(self.clearance.shape)
        inside = storey, slice(low[1], high[1]), slice(low[0], high[0])
        return np.asarray(cells[inside][self.clearance[inside] >= LEAST + CELL])


class Reach(NamedTuple):
    """What can be reached from a cell."""

    space: FreeSpace
    costs: Array  # (N,) inf for what can't
    before: NDArray[np.int32]  # (N,) the cell before each on its way

    def way(self, cell: int) -> Array:
        """Positions (M, 3) on the floor from the start to a cell, with the ends of stairs [m]."""
        cells = [cell]
        while self.before[cells[-1]] >= 0:
            cells.append(int(self.before[cells[-1]]))
        cells.reverse()
        points = [self.space.position(cells[0])]
        for a, b in itertools.pairwise(cells):
            if flight := self.space.stairs.get((min(a, b), max(a, b))):
                points += [flight.foot, flight.top] if a < b else [flight.top, flight.foot]
            points.append(self.space.position(b))
        return np.array(points)


def reach_from(space: FreeSpace, cell: int) -> Reach:
    """The cheapest ways from a cell to all others."""
    costs, before = dijkstra(space.costs, directed=False, indices=cell, return_predecessors=True)
    return Reach(space, costs, before)


def free_space_of(office: Office) -> FreeSpace:
    """Where a person can walk in a building."""
    boxes = office.world.rooms[0].boxes
    rooms = office.world.rooms
    origin = np.min([room.corner[:2] for room in rooms], axis=0) - CELL
    end = np.max([room.corner[:2] + room.size[:2] for room in rooms], axis=0) + CELL
    num_x, num_y = np.ceil((end - origin) / CELL).astype(int)
    is_blocked = np.zeros((len(office.levels), num_y, num_x), np.bool_)
    for is_blocked_here, level in zip(is_blocked, office.levels, strict=True):
        bottoms, tops = boxes[:, 2] - boxes[:, 5], boxes[:, 2] + boxes[:, 5]
        for box in boxes[(tops > level + STEP_OVER) & (bottoms < level + HEAD)]:
            _block(is_blocked_here, box, origin)
    for storey, flight in enumerate(office.flights, start=1):
        middle, half = (flight.foot + flight.top) / 2, (flight.top[1] - flight.foot[1]) / 2
        _block(is_blocked[storey], np.array([*middle, flight.width / 2, half, 0.0, 0.0]), origin)
    clearance = np.stack([CELL * distance_transform_edt(~blocked) for blocked in is_blocked])
    space = FreeSpace(office, origin, clearance, csr_array((1, 1)), {})
    landing = np.array([0.0, LANDING, 0.0])
    stairs = {(space.cell(f.foot - landing), space.cell(f.top + landing)): f for f in office.flights}
    return FreeSpace(office, origin, clearance, _costs(clearance, stairs), stairs)


def _block(is_blocked: NDArray[np.bool_], box: Array, origin: Array) -> None:
    """Mark the cells (Y, X) whose middle is in a box (7,) or less than half a cell off it."""
    reach = float(np.hypot(box[3], box[4])) + CELL
    x0, y0 = np.maximum(((box[:2] - reach - origin) / CELL).astype(int), 0)
    x1, y1 = ((box[:2] + reach - origin) / CELL).astype(int) + 1
    part = is_blocked[y0:y1, x0:x1]
    dy, dx = np.indices(part.shape) + np.array([y0, x0])[:, None, None] + 0.5
    dx, dy = CELL * dx + origin[0] - box[0], CELL * dy + origin[1] - box[1]
    c, s = np.cos(box[6]), np.sin(box[6])
    along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
    part |= (along <= box[3] + CELL / 2) & (across <= box[4] + CELL / 2)


def _costs(clearance: Array, stairs: dict[tuple[int, int], Flight]) -> csr_array:
    """Metres from cell to cell, more where things are near."""
    is_free = clearance >= LEAST
    price = 1.0 + PRICE * np.exp((LEAST - clearance) / LIKED)
    cells = np.arange(clearance.size, dtype=np.int64).reshape(clearance.shape)
    ends: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]] = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        num_y, num_x = clearance.shape[1:]
        here = np.s_[:, : num_y - dy, max(0, -dx) : num_x - max(0, dx)]
        there = np.s_[:, dy:, max(0, dx) : num_x + min(0, dx)]
        both = is_free[here] & is_free[there]
        cost = CELL * np.hypot(dx, dy) * 0.5 * (price[here] + price[there])
        ends.append((cells[here][both], cells[there][both], cost[both]))
    for (below, above), flight in stairs.items():
        length = float(np.linalg.norm(flight.top - flight.foot)) + 2.0 * LANDING
        ends.append((np.array([below]), np.array([above]), np.array([length])))
    first, second, cost = (np.concatenate(values) for values in zip(*ends, strict=True))
    return coo_array((cost, (first, second)), shape=(clearance.size, clearance.size)).tocsr()
