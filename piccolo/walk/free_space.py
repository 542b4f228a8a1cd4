"""Walking distances from place to place, through free space and never through a wall."""

import math
from typing import Any

import numpy as np

from ..geometry.pose import Array
from ..jobs.threads import Workers
from ..scan_map.camera_positions import CLEARANCE_VOXEL, COARSE_SPACING, MIN_CLEARANCE, nearest_distances
from ..scan_map.scan_map import ScanMap

REACH = math.sqrt(2.5) * COARSE_SPACING  # [m] to neighbours in the grid: across edges (sqrt 2), not corners
TUBE_RADIUS = MIN_CLEARANCE / 2.0  # [m] of a free way
DETOUR = 1.0 / math.cos(math.pi / 8.0)  # paths along edges and across squares are at most so much longer


class FreeSpace:
    """A map's candidates as a graph, with edges between neighbours along free ways."""

    def __init__(self, scan_map: ScanMap, workers: Workers) -> None:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # only walks wait for it

        self.num_places = len(scan_map.centers)
        self.tree = cKDTree(scan_map.centers)
        self.graph = make_graph(scan_map, self.tree, workers)

    def distances(self, starts: Array, ends: Array, limit: float) -> Array:
        """Return distances (S, N) [m] from places (S, 3) to others (N, 3) in the map; inf beyond a limit."""
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

        straight = np.linalg.norm(ends[None] - starts[:, None], axis=2)
        walked = straight.copy()  # nothing is between places so near that both keep clear of it
        far = (straight > 2.0 * MIN_CLEARANCE) & (straight <= limit)
        rows = np.flatnonzero(far.any(axis=1))
        if len(rows):
            _, end = self.tree.query(ends)
            nodes, node = np.unique(self.tree.query(starts[rows])[1], return_inverse=True)
            along = dijkstra(self.graph, indices=nodes, limit=DETOUR * (limit + 2.0 * COARSE_SPACING))[node][
                :, end
            ]
            walked[rows] = np.where(
                far[rows], np.maximum(straight[rows], along / DETOUR - COARSE_SPACING), walked[rows]
            )
        walked[walked > limit] = np.inf
        return np.asarray(walked)

    def fraction_within(self, center: Array, radius: float) -> float:
        """Return the fraction of candidates within a radius [m] of a place (3,), counting at least one."""
        near = self.tree.query_ball_point(center, radius, return_length=True)
        return max(int(near), 1) / max(self.num_places, 1)


def make_graph(scan_map: ScanMap, tree: Any, workers: Workers) -> Any:
    """Return the lengths [m] of the edges between candidates, as a sparse matrix; `tree` is of their centers.

    A way is free if a tube around it fits into the empty balls around its ends and its middle.
    """
    from scipy.sparse import coo_matrix  # noqa: PLC0415  # only walks wait for it
    from scipy.spatial import cKDTree  # noqa: PLC0415

    centers = scan_map.centers
    points = scan_map.octree.level(CLEARANCE_VOXEL)[:, :3]
    surfaces = cKDTree(points, balanced_tree=False, compact_nodes=False)

    def covered(places: Array) -> Array:
        """Return half the length (N,) [m] of the longest tube in the ball around each place (N, 3)."""
        distance = nearest_distances(surfaces, places, workers)
        return np.sqrt(np.maximum(distance**2 - TUBE_RADIUS**2, 0.0))

    pairs = tree.query_pairs(REACH, output_type="ndarray")
    length = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
    uncovered = length - covered(centers)[pairs].sum(axis=1)
    some = uncovered > 0.0
    uncovered[some] -= 2.0 * covered(centers[pairs[some]].mean(axis=1))
    is_free = uncovered <= 0.0
    one_way = coo_matrix((length[is_free], pairs[is_free].T), (len(centers), len(centers)))
    return (one_way + one_way.T).tocsr()
