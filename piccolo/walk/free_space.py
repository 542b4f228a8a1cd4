"""How far it is to walk from place to place: through free space, never through a wall."""

from collections import OrderedDict
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..coarse_to_fine.scan_map import SEARCH_VIEW, ScanMap
from ..geometry.pose import Array
from ..geometry.sphere import cell_of

REACH = (
    0.95  # [m] between candidates that may be neighbours: those of one grid cell of 0.6 m, not of all corners
)
SLACK = 0.1  # [m] by which a surface may be nearer than a neighbour, as views are coarse
NEAR = 0.5  # [m] cameras keep 0.25 m from a wall: nearer ones have none between them
DETOUR, ENDS = 1.1, 0.6  # paths along a grid are so much longer; and to its nodes [m]
MAX_SOURCES = 256  # whose distances are kept


class FreeSpace:
    """A map's candidates as a graph, with an edge where two neighbours see each other."""

    def __init__(self, scan_map: ScanMap) -> None:
        self.scan_map = scan_map
        self._known = OrderedDict[int, tuple[float, NDArray[np.float64]]]()

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # only walks wait for it

        return cKDTree(self.scan_map.centers)

    @cached_property
    def _graph(self) -> Any:
        """Sparse matrix (candidates, candidates) of lengths [m]."""
        from scipy.sparse import coo_matrix  # noqa: PLC0415

        first, second = self._tree.query_pairs(REACH, output_type="ndarray").T
        length = np.linalg.norm(self.scan_map.centers[second] - self.scan_map.centers[first], axis=1)
        is_open = sees(self.scan_map, first, second) & sees(self.scan_map, second, first)
        edges = length[is_open], (first[is_open], second[is_open])
        return coo_matrix(edges, (len(self.scan_map.centers),) * 2).tocsr()

    def distance(self, start: Array, ends: Array, limit: float) -> Array:
        """Metres (N,) from a place (3,) to others (N, 3) of the map's frame; inf beyond a limit."""
        straight = np.linalg.norm(ends - start, axis=1)
        walked = straight.copy()
        far = (straight > NEAR) & (straight <= limit)
        if far.any():
            _, nodes = self._tree.query(np.concatenate([start[None], ends[far]]))
            along = self._from(int(nodes[0]), DETOUR * (limit + 2.0 * ENDS))[nodes[1:]]
            walked[far] = np.maximum(straight[far], along / DETOUR - ENDS)
        walked[straight > limit] = np.inf
        return np.asarray(walked)

    def _from(self, node: int, limit: float) -> NDArray[np.float64]:
        """Lengths (candidates,) of the shortest paths from a node, inf beyond the limit [m]."""
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

        known = self._known.get(node)
        if known is None or known[0] < limit:
            found = dijkstra(self._graph, directed=False, indices=node, limit=limit)
            self._known[node] = known = limit, np.asarray(found)
            if len(self._known) > MAX_SOURCES:
                self._known.popitem(last=False)
        return known[1]


def sees(scan_map: ScanMap, first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.bool_]:
    """True (N,) where nothing that a candidate sees is nearer than a neighbour in that direction."""
    m = scan_map
    toward = m.centers[second] - m.centers[first]
    length = np.linalg.norm(toward, axis=1)
    cell = cell_of((toward / length[:, None]).astype(np.float32), SEARCH_VIEW.num_rings)
    offsets = m.offsets[first, :, cell].astype(np.float32)
    ranges = np.linalg.norm(offsets, axis=1) * m.offset_unit[first]
    return np.asarray(~m.is_seen[first, cell] | (ranges > length - SLACK))
