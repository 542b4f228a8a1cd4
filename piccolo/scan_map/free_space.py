"""Walking distances from place to place, through free space and never through a wall."""

import math
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Array
from ..jobs.threads import Workers
from .camera_positions import CLEARANCE_VOXEL, COARSE_SPACING, MIN_CLEARANCE, nearest_distances
from .scan_map import ScanMap

REACH = math.sqrt(2.5) * COARSE_SPACING  # [m] to neighbours in the grid: across edges (sqrt 2), not corners
TUBE_RADIUS = MIN_CLEARANCE / 2.0  # [m] of a free way
DETOUR = 1.0 / math.cos(math.pi / 8.0)  # paths along edges and across squares are at most so much longer


class FreeSpace:
    """A map's candidates as a graph, with edges between neighbours along free ways."""

    def __init__(self, scan_map: ScanMap, workers: Workers) -> None:
        self.scan_map = scan_map
        self.workers = workers

    def prepare(self) -> None:
        """Build the graph, a second of work in a large building, before somebody waits for a distance."""
        _ = self._graph

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # only walks wait for it

        return cKDTree(self.scan_map.centers)

    @cached_property
    def _graph(self) -> Any:
        """Sparse matrix (candidates, candidates) of the edges' lengths [m].

        A way is free if a tube around it fits into the empty balls around its ends and its middle.
        """
        from scipy.sparse import coo_matrix  # noqa: PLC0415  # only walks wait for it
        from scipy.spatial import cKDTree  # noqa: PLC0415

        centers = self.scan_map.centers
        points = self.scan_map.octree.level(CLEARANCE_VOXEL)[:, :3]
        surfaces = cKDTree(points, balanced_tree=False, compact_nodes=False)

        def covered(places: Array) -> Array:
            """Return half the length (N,) [m] of the longest tube in the ball around each place (N, 3)."""
            distance = nearest_distances(surfaces, places, self.workers)
            return np.sqrt(np.maximum(distance**2 - TUBE_RADIUS**2, 0.0))

        pairs = self._tree.query_pairs(REACH, output_type="ndarray")
        length = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
        uncovered = length - covered(centers)[pairs].sum(axis=1)
        some = uncovered > 0.0
        uncovered[some] -= 2.0 * covered(centers[pairs[some]].mean(axis=1))
        is_free = uncovered <= 0.0
        one_way = coo_matrix((length[is_free], pairs[is_free].T), (len(centers), len(centers)))
        return (one_way + one_way.T).tocsr()

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
