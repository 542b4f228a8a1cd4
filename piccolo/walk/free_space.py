"""Walking distances from place to place, through free space and never through a wall."""

import math
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from ..geometry.sphere import find_cell
from ..jobs.threads import Workers
from ..scan_map.camera_positions import COARSE_SPACING, MIN_CLEARANCE
from ..scan_map.scan_map import ScanMap
from ..views.candidate_views import SEARCH_VIEW
from ..views.view import BLOCK, ranges_around

REACH = 1.6 * COARSE_SPACING  # [m] to neighbours in the grid: across edges, not all corners
SLACK = 0.1  # [m] by which a surface may be nearer than a neighbour, as views are coarse
DETOUR = 1.0 / math.cos(math.pi / 8.0)  # paths along edges and across squares are at most so much longer


class FreeSpace:
    """A map's candidates as a graph, with edges between neighbours that see each other."""

    def __init__(self, scan_map: ScanMap, workers: Workers) -> None:
        self.scan_map = scan_map
        self.workers = workers

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # only walks wait for it

        return cKDTree(self.scan_map.centers)

    @cached_property
    def _graph(self) -> Any:
        """Sparse matrix (candidates, candidates) of the edges' lengths [m]."""
        from scipy.sparse import coo_matrix  # noqa: PLC0415

        m = self.scan_map
        pairs = self._tree.query_pairs(REACH, output_type="ndarray")
        both = np.concatenate([pairs, pairs[:, ::-1]])  # there and back
        order = np.argsort(both[:, 0], kind="stable")
        seen = np.empty(len(both), np.int64)
        seen[order] = look_past(m, both[order, 0], both[order, 1], self.workers)
        is_free = seen[: len(pairs)] + seen[len(pairs) :] > 0
        first, second = pairs[is_free].T
        length = np.linalg.norm(m.centers[second] - m.centers[first], axis=1)
        ends = np.concatenate([first, second]), np.concatenate([second, first])
        return coo_matrix((np.tile(length, 2), ends), (len(m.centers),) * 2).tocsr()

    def distances(self, starts: Array, ends: Array, limit: float) -> Array:
        """Return distances (S, N) [m] from places (S, 3) to others (N, 3) in the map; inf beyond a limit."""
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

        straight = np.linalg.norm(ends[None] - starts[:, None], axis=2)
        walked = straight.copy()  # nothing is between places so near that both keep clear of it
        far = (straight > 2.0 * MIN_CLEARANCE) & (straight <= limit)
        rows = np.flatnonzero(far.any(axis=1))
        if len(rows):
            _, end = self._tree.query(ends)
            nodes, node = np.unique(self._tree.query(starts[rows])[1], return_inverse=True)
            along = dijkstra(self._graph, indices=nodes, limit=DETOUR * (limit + 2.0 * COARSE_SPACING))[node][
                :, end
            ]
            walked[rows] = np.where(
                far[rows], np.maximum(straight[rows], along / DETOUR - COARSE_SPACING), walked[rows]
            )
        walked[walked > limit] = np.inf
        return np.asarray(walked)

    def fraction_within(self, center: Array, radius: float) -> float:
        """Return the fraction of candidates within a radius [m] of a place (3,), counting at least one."""
        near = self._tree.query_ball_point(center, radius, return_length=True)
        return max(int(near), 1) / max(len(self.scan_map.centers), 1)


def look_past(
    scan_map: ScanMap, first: NDArray[Any], second: NDArray[Any], workers: Workers
) -> NDArray[np.int64]:
    """Return 1 (N,) if a candidate sees past its neighbour, 0 if it sees nothing, -2 if its view is blocked.

    `first` (N,) and `second` (N,) are the pairs' candidates, `first` in ascending order. The way is free if
    the sum of both directions is above 0: neither is blocked, and at least one sees past.
    """
    m = scan_map
    toward = m.centers[second] - m.centers[first]
    length = np.linalg.norm(toward, axis=1)
    cell = find_cell((toward / length[:, None]).astype(np.float32), SEARCH_VIEW.num_rings)
    nodes = np.unique(first)

    def ranges_from(lo: int) -> NDArray[np.float32]:
        some = nodes[lo : lo + BLOCK]
        part = slice(*np.searchsorted(first, [some[0], some[-1] + 1]))
        ranges = ranges_around(m.octree, m.centers[some], SEARCH_VIEW)
        return ranges[np.searchsorted(some, first[part]), cell[part]]

    parts = workers.map(ranges_from, range(0, len(nodes), BLOCK), "find ways")
    ranges = np.concatenate([np.empty(0, np.float32), *parts])
    return np.where(ranges > 0.0, np.where(ranges > length - SLACK, 1, -2), 0)
