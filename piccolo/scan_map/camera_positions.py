"""Possible positions of a camera, in free space at its height above a surface, and walks between them."""

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

MIN_CLEARANCE = 0.25  # [m] a camera is not nearer to a surface
MIN_COVERAGE = 0.55  # fraction of the sphere that shows something: flat ground or a roof alone fills half
OPEN_COVERAGE = 0.3  # the same where hardly any place is closed in: open land
MIN_ENCLOSED = 0.2  # fraction of the free places that are closed in, else the land counts as open
FREE_SPACE_VIEW = ViewConfig(num_rings=12, stats_rings=12, sigma_deg=22.0, voxel_per_range=1 / 8)
MIN_CAMERA_HEIGHT = 0.3  # [m] above a surface that can carry a tripod or a person
MAX_CAMERA_HEIGHT = 2.4
SUPPORT_RADIUS = 0.9  # [m] the floor right below a scanner is never scanned
STOREY = 2.6  # [m] a floor is not farther below a camera
SURFACE_VOXEL = 0.16  # [m]
COARSE_SPACING = 0.6  # [m] of the grid; the half of it where surfaces are near
CLEARANCE_VOXEL = 0.08  # [m]
NEAR_SURFACE = 0.3  # [m] clearance below which the grid is refined
MAX_POSITIONS = 250_000  # looked at, and views rendered: some ten minutes on two cores, 1.9 GB
ADVICE = (
    "the most that are searched; if its unit is not the metre, set `units`, else say where the camera was "
    "(`near` and `radius`) or cut out a part"
)
BASES = 1 << 14  # cells on surfaces, around which others are supported, or centres, at a time
LONG = 60.0  # [s] a warning says how long the views take, if more
COST_OF_VIEW = 4.0  # time of a position's coverage and view, relative to its coverage
GRID_REACH = (
    math.sqrt(2.5) * COARSE_SPACING
)  # [m] to neighbours in the grid: across edges (sqrt 2), not corners
TUBE_RADIUS = MIN_CLEARANCE / 2.0  # [m] of a free way
DETOUR = 1.0 / math.cos(math.pi / 8.0)  # paths along edges and across squares are at most so much longer


def top_surfaces(octree: Octree) -> Array32:
    """Return the voxel means (N, 3) above which the next two voxels are empty."""
    xyz = octree.level(SURFACE_VOXEL)[:, :3]
    ijk = np.floor(xyz / SURFACE_VOXEL).astype(np.int64)
    ijk -= ijk.min(axis=0) - 1
    shape = ijk.max(axis=0) + 4
    code = (ijk[:, 0] * shape[1] + ijk[:, 1]) * shape[2] + ijk[:, 2]
    is_covered = np.isin(code + 1, code) | np.isin(code + 2, code)
    return np.asarray(xyz[~is_covered])


class Ball(NamedTuple):
    """Points within a radius [m] of a place (3,)."""

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
    """A scan of land, or in another unit: it has more camera positions than are searched."""

    def __init__(self, what: str) -> None:
        super().__init__(f"the scan: {what} leave more than {MAX_POSITIONS} camera positions, {ADVICE}")


def find_supported_cells(surfaces: Array32, within: Ball | Box | None = None) -> Int64s:
    """Return cells (N, 3) of the coarse grid with centres at a camera's height above a surface (M, 3).

    Only cells `within` a part of the scan are returned, with a margin of a grid spacing.
    TooManyPositionsError if they are more than MAX_POSITIONS; memory is allocated for no more.
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
    weights = np.array([shape[1] * shape[2], shape[2], 1])  # one number a cell sorts as its three do
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
    """Return the filled fraction of the sphere (N,) around each centre (N, 3), at a low resolution."""
    area = whole_areas(FREE_SPACE_VIEW.num_rings).astype(np.int64)

    def glance(lo: int) -> Array:
        is_filled = ranges_around(octree, centers[lo : lo + VIEWS_A_TASK], FREE_SPACE_VIEW) > 0.0
        return np.asarray(is_filled @ area / area.sum())

    parts = workers.map(glance, range(0, len(centers), VIEWS_A_TASK), "find free space")
    return np.concatenate([np.empty(0), *parts])


def nearest_distances(tree: Any, centers: Floats, workers: Workers) -> Array:
    """Return the distance (N,) [m] of each centre (N, 3) from the nearest point of a cKDTree.

    It uses own threads: if a signal ends the work, the tree's threads would go on running in freed memory.
    """
    begins = range(0, len(centers), BASES)
    alone = Workers(workers.num_threads)  # too short a work to be shown
    parts = alone.map(lambda lo: tree.query(centers[lo : lo + BASES])[0], begins, "")
    return np.concatenate([np.empty(0), *parts])


def warn_if_long(octree: Octree, centers: Floats, workers: Workers) -> None:
    """Estimate from a sample the time to render views from the centres (N, 3); warn if it is long."""
    sample = centers[:: 1 + len(centers) // VIEWS_A_TASK]
    alone = Workers()
    coverage(octree, sample[:1], alone)  # compiled
    begin = time.perf_counter()
    coverage(octree, sample, alone)
    seconds = (time.perf_counter() - begin) / max(len(sample), 1) * len(centers) * COST_OF_VIEW
    if seconds > LONG * workers.num_threads:
        minutes = seconds / workers.num_threads / 60.0
        workers.warn(f"the scan: {len(centers)} camera positions, about {minutes:.0f} min to prepare, once")


def candidate_centers(octree: Octree, workers: Workers, within: Ball | Box | None = None) -> Array:
    """Find positions (N, 3) [m] in free space, 0.6 m apart, or 0.3 m where surfaces are near.

    `within` and TooManyPositionsError are as of `find_supported_cells`.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

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

    # Nothing of a cell is free if its centre is deeper in a surface than the cell is wide.
    half = COARSE_SPACING / 2
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    is_split = is_tight & (clearance + 0.87 * COARSE_SPACING > MIN_CLEARANCE)
    finer = (2 * cells[is_split][:, None] + corners).reshape(-1, 3)
    middle = (finer + 0.5) * half
    clearance = nearest_distances(tree, middle, workers)
    middle = middle[clearance > MIN_CLEARANCE]
    if len(middle) > MAX_POSITIONS:
        raise TooManyPositionsError("narrow places")
    return np.concatenate([kept, middle[coverage(octree, middle, workers) > min_coverage]])


def heights_above_floor(octree: Octree, centers: Array) -> Array:
    """Return heights (N,) [m] of centres (N, 3) above the floor: the lowest surface below in their storey.

    inf if there is none within SUPPORT_RADIUS and STOREY.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

    surfaces = top_surfaces(octree)
    near = cKDTree(surfaces[:, :2]).query_ball_point(centers[:, :2], SUPPORT_RADIUS)
    heights = np.full(len(centers), np.inf)
    for k, indices in enumerate(near):
        gaps = centers[k, 2] - surfaces[indices, 2]
        heights[k] = gaps[(gaps > 0.0) & (gaps < STOREY)].max(initial=-np.inf)
    return np.where(np.isfinite(heights), heights, np.inf)


class FreeSpace:
    """A map's candidates (N, 3) [m] as a graph, with edges between neighbours along free ways."""

    def __init__(self, octree: Octree, centers: Array, workers: Workers) -> None:
        self.octree = octree
        self.centers = centers
        self.workers = workers

    def prepare(self) -> None:
        """Build the graph, a second of work in a large building, before somebody waits for a distance."""
        _ = self._graph

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # only walks wait for it

        return cKDTree(self.centers)

    @cached_property
    def _graph(self) -> Any:
        """Sparse matrix (candidates, candidates) of the edges' lengths [m].

        A way is free if a tube around it fits into the empty balls around its ends and its middle.
        """
        from scipy.sparse import coo_matrix  # noqa: PLC0415  # only walks wait for it
        from scipy.spatial import cKDTree  # noqa: PLC0415

        centers = self.centers
        points = self.octree.level(CLEARANCE_VOXEL)[:, :3]
        surfaces = cKDTree(points, balanced_tree=False, compact_nodes=False)

        def covered(places: Array) -> Array:
            """Return half the length (N,) [m] of the longest tube in the ball around each place (N, 3)."""
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
        return max(int(near), 1) / max(len(self.centers), 1)
