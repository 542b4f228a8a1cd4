"""Possible positions of a camera: free space at a camera's height above a surface; and paths between them."""

import math
import time
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..cloud.octree import Octree
from ..geometry.sphere import whole_areas
from ..system.arrays import Array, Array32, Floats, Int64s, Mask
from ..system.errors import InputError
from ..system.jobs.threads import Workers
from ..views.view import VIEWS_A_TASK, ViewConfig, ranges_around

MIN_CLEARANCE = 0.25  # [m] from a camera to the nearest surface, at least
MIN_COVERAGE = 0.55  # least fraction of the sphere with points: flat ground or a roof alone fills half
OPEN_COVERAGE = 0.3  # the same in open land, where hardly any position reaches MIN_COVERAGE
MIN_ENCLOSED = 0.2  # if a smaller fraction of positions reaches MIN_COVERAGE, the land is open
FREE_SPACE_VIEW = ViewConfig(num_rings=12, stats_rings=12, sigma_deg=22.0, voxel_per_range=1 / 8)
MIN_CAMERA_HEIGHT = 0.3  # [m] above a surface that can carry a tripod or a person
MAX_CAMERA_HEIGHT = 2.4  # [m]
SUPPORT_RADIUS = 0.9  # [m] across to that surface: right below a scanner nothing is scanned
STOREY = 2.6  # [m] from a camera down to its floor, at most
SURFACE_VOXEL = 0.16  # [m] of the surfaces that can carry a camera
COARSE_SPACING = 0.6  # [m] of the grid of positions; half of this near surfaces
CLEARANCE_VOXEL = 0.08  # [m] of the points from which clearance is measured
NEAR_SURFACE = 0.3  # [m] clearance below which the grid is refined
MAX_POSITIONS = 250_000  # at most: to test and to render so many takes ten minutes on two cores, 1.9 GB
ADVICE = (
    "the most that are searched; if its unit is not the metre, set `units`, else say where the camera was "
    "(`near` and `radius`) or cut out a part"
)
BASES = 1 << 14  # cells of surfaces, or centres, that are processed at a time
LONG = 60.0  # [s] a warning tells how long the preparation takes if it takes longer
COST_OF_VIEW = 4.0  # time of a position's coverage and view, divided by that of its coverage alone
# [m] to neighbours in the grid: those across edges (sqrt 2) count, those across corners (sqrt 3) do not
GRID_REACH = math.sqrt(2.5) * COARSE_SPACING
TUBE_RADIUS = MIN_CLEARANCE / 2.0  # [m] of the tube that must be free along a path
DETOUR = 1.0 / math.cos(math.pi / 8.0)  # longest path in the grid, divided by the straight distance


def top_surfaces(octree: Octree) -> Array32:
    """Return the mean points (N, 3) [m] of the voxels above which two voxels are empty."""
    xyz = octree.level(SURFACE_VOXEL)[:, :3]
    ijk = np.floor(xyz / SURFACE_VOXEL).astype(np.int64)
    ijk -= ijk.min(axis=0) - 1
    shape = ijk.max(axis=0) + 4
    code = (ijk[:, 0] * shape[1] + ijk[:, 1]) * shape[2] + ijk[:, 2]
    is_covered = np.isin(code + 1, code) | np.isin(code + 2, code)
    return np.asarray(xyz[~is_covered])


class Ball(NamedTuple):
    """Points within a radius [m] of a centre (3,) [m]."""

    center: Array
    radius: float

    def holds(self, points: Floats, margin: float = 0.0) -> Mask:
        """Return a mask (N,) of points (N, 3) or (N, 2) inside, or at most a margin [m] outside."""
        distance = np.linalg.norm(points - self.center[: points.shape[1]], axis=1)
        return np.asarray(distance <= self.radius + margin)


class Box(NamedTuple):
    """Points between two corners (3,) [m]."""

    low: Array
    high: Array

    def holds(self, points: Floats, margin: float = 0.0) -> Mask:
        """Return a mask (N,) of points (N, 3) or (N, 2) inside, or at most a margin [m] outside."""
        k = points.shape[1]
        is_inside = (points >= self.low[:k] - margin) & (points <= self.high[:k] + margin)
        return np.asarray(is_inside.all(axis=1))


class TooManyPositionsError(InputError):
    """The scan has too many camera positions: it is of open land, or its unit is not the metre."""

    def __init__(self, cause: str) -> None:
        super().__init__(f"the scan: {cause} leave more than {MAX_POSITIONS} camera positions, {ADVICE}")


def find_supported_cells(surfaces: Array32, within: Ball | Box | None = None) -> Int64s:
    """Return the cells (N, 3) of the coarse grid whose centres are at a camera's height above a surface.

    `surfaces` (M, 3) [m] are points of these surfaces. Only cells `within` a part of the scan are returned,
    with a margin of a grid spacing. Raise TooManyPositionsError if there are more than MAX_POSITIONS; memory
    is allocated for no more.
    """
    s = COARSE_SPACING
    reach = int(np.ceil(SUPPORT_RADIUS / s))
    if within is not None:
        surfaces = surfaces[within.holds(surfaces[:, :2], SUPPORT_RADIUS + 2 * s)]
    if len(surfaces) == 0:
        return np.empty((0, 3), np.int64)
    base = np.floor(surfaces / s).astype(np.int64)
    base[:, 2] = np.ceil((surfaces[:, 2] + MIN_CAMERA_HEIGHT) / s - 0.5)
    around = np.arange(-reach, reach + 1)
    layers = np.arange(int(np.ceil((MAX_CAMERA_HEIGHT - MIN_CAMERA_HEIGHT) / s)))
    steps = np.stack(np.meshgrid(around, around, layers, indexing="ij"), axis=-1).reshape(-1, 3)
    gap = np.maximum(np.abs(steps[:, :2]) - 0.5, 0.0) * s
    steps = steps[np.hypot(gap[:, 0], gap[:, 1]) < SUPPORT_RADIUS]
    low = base.min(axis=0) - reach
    shape = base.max(axis=0) - low + reach + len(layers)
    weights = np.array([shape[1] * shape[2], shape[2], 1])  # one number for a cell, in the order of its three
    codes = np.unique((base - low) @ weights)
    found = np.empty(0, np.int64)
    for begin in range(0, len(codes), BASES):
        around_some = np.unique(codes[begin : begin + BASES, None] + steps @ weights)
        cells = np.stack(np.unravel_index(around_some, shape), axis=1) + low
        if within is not None:
            around_some = around_some[within.holds((cells + 0.5) * s, s)]
        found = np.union1d(found, around_some)
        if len(found) > MAX_POSITIONS:
            size = "{:.0f} x {:.0f} x {:.0f} m".format(*np.ptp(surfaces, axis=0))
            raise TooManyPositionsError(f"surfaces of {size}")
    return np.asarray(np.stack(np.unravel_index(found, shape), axis=1) + low)


def coverage(octree: Octree, centers: Floats, workers: Workers) -> Array:
    """Return the fraction (N,) of the sphere around each centre (N, 3) [m] in which points are seen.

    The resolution is low (FREE_SPACE_VIEW).
    """
    area = whole_areas(FREE_SPACE_VIEW.num_rings).astype(np.int64)

    def glance(lo: int) -> Array:
        is_filled = ranges_around(octree, centers[lo : lo + VIEWS_A_TASK], FREE_SPACE_VIEW) > 0.0
        return np.asarray(is_filled @ area / area.sum())

    parts = workers.map(glance, range(0, len(centers), VIEWS_A_TASK), "find free space")
    return np.concatenate([np.empty(0), *parts])


def nearest_distances(tree: Any, centers: Floats, workers: Workers) -> Array:
    """Return the distance (N,) [m] of each centre (N, 3) from the nearest point of a cKDTree.

    The threads are those of `Workers`: the tree's own would go on in freed memory if a signal ended the work.
    """
    begins = range(0, len(centers), BASES)
    alone = Workers(workers.num_threads)  # without progress: the work is too short to show it
    parts = alone.map(lambda lo: tree.query(centers[lo : lo + BASES])[0], begins, "")
    return np.concatenate([np.empty(0), *parts])


def warn_if_long(octree: Octree, centers: Floats, workers: Workers) -> None:
    """Estimate from a sample how long coverage and views of the centres (N, 3) take; warn if it is long."""
    sample = centers[:: 1 + len(centers) // VIEWS_A_TASK]
    alone = Workers()
    coverage(octree, sample[:1], alone)  # compiles the kernels
    begin = time.perf_counter()
    coverage(octree, sample, alone)
    seconds = (time.perf_counter() - begin) / max(len(sample), 1) * len(centers) * COST_OF_VIEW
    if seconds > LONG * workers.num_threads:
        minutes = seconds / workers.num_threads / 60.0
        workers.warn(f"the scan: {len(centers)} camera positions, about {minutes:.0f} min to prepare, once")


def candidate_centers(octree: Octree, workers: Workers, within: Ball | Box | None = None) -> Array:
    """Find positions (N, 3) [m] in free space, 0.6 m apart, or 0.3 m near surfaces.

    `within` and TooManyPositionsError are as in `find_supported_cells`.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when a scan is prepared

    cells = find_supported_cells(top_surfaces(octree), within)
    points = octree.level(CLEARANCE_VOXEL)[:, :3]
    if within is not None:
        points = points[within.holds(points, 3 * COARSE_SPACING)]  # farther ones are not near
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    middle = (cells + 0.5) * COARSE_SPACING
    warn_if_long(octree, middle, workers)
    clearance = nearest_distances(tree, middle, workers)
    is_free = clearance > MIN_CLEARANCE
    fraction = np.zeros(len(middle))  # not computed where there is no free space
    fraction[is_free] = coverage(octree, middle[is_free], workers)
    is_open = np.mean(fraction[is_free] > MIN_COVERAGE) < MIN_ENCLOSED if is_free.any() else False
    min_coverage = OPEN_COVERAGE if is_open else MIN_COVERAGE
    is_enclosed = fraction > min_coverage
    is_tight = (clearance < NEAR_SURFACE) & (is_enclosed | ~is_free)
    kept = middle[~is_tight & is_free & is_enclosed]

    half = COARSE_SPACING / 2
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    finer = (2 * cells[is_tight][:, None] + corners).reshape(-1, 3)
    middle = (finer + 0.5) * half
    clearance = nearest_distances(tree, middle, workers)
    middle = middle[clearance > MIN_CLEARANCE]
    if len(middle) > MAX_POSITIONS:
        raise TooManyPositionsError("narrow places")
    return np.concatenate([kept, middle[coverage(octree, middle, workers) > min_coverage]])


def heights_above_floor(octree: Octree, centers: Array) -> Array:
    """Return the heights (N,) [m] of centres (N, 3) above their floors, the lowest surface below each.

    Surfaces within SUPPORT_RADIUS horizontally and STOREY vertically count; the height is inf without any.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when heights are needed

    surfaces = top_surfaces(octree)
    near = cKDTree(surfaces[:, :2]).query_ball_point(centers[:, :2], SUPPORT_RADIUS)
    heights = np.full(len(centers), np.inf)
    for k, indices in enumerate(near):
        gaps = centers[k, 2] - surfaces[indices, 2]
        heights[k] = gaps[(gaps > 0.0) & (gaps < STOREY)].max(initial=-np.inf)
    return np.where(np.isfinite(heights), heights, np.inf)


class FreeSpace:
    """A map's candidates (N, 3) [m] as a graph, with edges between neighbours joined by a free path."""

    def __init__(self, octree: Octree, centers: Array, workers: Workers) -> None:
        self.octree = octree
        self.centers = centers
        self.workers = workers

    def prepare(self) -> None:
        """Build the graph now, not at the first distance: in a large building it takes a second."""
        _ = self._graph

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only for walks

        return cKDTree(self.centers)

    @cached_property
    def _graph(self) -> Any:
        """Sparse matrix (candidates, candidates) of the edges' lengths [m].

        A straight path is free if a tube around it fits into the empty balls around its ends and its middle.
        """
        from scipy.sparse import coo_matrix  # noqa: PLC0415  # imported only for walks
        from scipy.spatial import cKDTree  # noqa: PLC0415

        centers = self.centers
        points = self.octree.level(CLEARANCE_VOXEL)[:, :3]
        surfaces = cKDTree(points, balanced_tree=False, compact_nodes=False)

        def covered(places: Array) -> Array:
            """Return half the length (N,) [m] of the longest tube in the empty ball at each place (N, 3)."""
            distance = nearest_distances(surfaces, places, self.workers)
            return np.sqrt(np.maximum(distance**2 - TUBE_RADIUS**2, 0.0))

        pairs = self._tree.query_pairs(GRID_REACH, output_type="ndarray")
        length = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
        uncovered = length - covered(centers)[pairs].sum(axis=1)
        some = uncovered > 0.0
        uncovered[some] -= 2.0 * covered(centers[pairs[some]].mean(axis=1))
        is_free = uncovered <= 0.0
        one_way = coo_matrix((length[is_free], pairs[is_free].T), (len(centers), len(centers)))
        return (one_way + one_way.T).tocsr()

    def distances(self, starts: Array, ends: Array, limit: float) -> Array:
        """Return walking distances (S, N) [m] from starts (S, 3) to ends (N, 3) [m]; inf beyond a limit.

        A distance is a lower bound: the straight one, or the path between the nearest candidates, less what a
        path in the grid may be longer.
        """
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

        straight = np.linalg.norm(ends[None] - starts[:, None], axis=2)
        walked = straight.copy()  # nearby places have no surface between them: both keep clear of it
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
        """Return the fraction of candidates within a radius [m] of a place (3,) [m]; one at least counts."""
        near = self._tree.query_ball_point(center, radius, return_length=True)
        return max(int(near), 1) / max(len(self.centers), 1)
