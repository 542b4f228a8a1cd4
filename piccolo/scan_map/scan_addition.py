"""Addition of another scan to a map: only what it changes is prepared again.

Candidates stay at their positions, unless the new scan fills them. Views that show the new scan are rendered
again; all others keep every bit.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..cloud.octree import Octree, build_octree
from ..cloud.stream import CloudStream
from ..cloud.surfaces import surface_variance
from ..cloud.voxels import LEAF_SIZE, WINDOW, Voxels, join_voxels
from ..geometry.sphere import whole_areas
from ..system.arrays import Array, Int64s, Mask, Uint16s, Values
from ..system.errors import InputError
from ..system.jobs.threads import Stopwatch, Workers
from ..views.candidate_views import SEARCH_VIEW, CandidateViews, WideViews, render_wide
from ..views.view import VIEWS_A_TASK, ranges_around
from .camera_positions import CLEARANCE_VOXEL, MIN_CLEARANCE, Box, candidate_centers
from .drawn_places import DrawnPlaces
from .scan_map import ScanMap, check_name, look_for_layers, sparse_candidates

BESIDE_SCAN = 3.0  # [m] up to here around the new scan there may be new candidates
NEARER = 0.9  # a scan is in front of another if its range is less than this times the other's
LEAST_CHANGED = 0.01  # of the sphere: a view that shows less of the new scan stays as it is
FAR_APART = 500.0  # [m] scans farther apart may not have the same coordinate system: a warning says so
COARSE_VOXEL = 2.56  # [m] by which the extent of a map is found


class Candidates(NamedTuple):
    """The N candidates of a map and a new scan: first the S of the map that stay, then new ones."""

    rows: Int64s  # (S,) indices, among the map's candidates, of those that stay
    centers: Array  # (N, 3) [m]
    fraction: Array  # (N,) of the sphere in which the new scan is in front; 1 for new candidates
    is_new: Mask  # (N,) the new scan is in front of the others in more of the sphere than behind them

    @property
    def rows_to_render(self) -> Int64s:
        """Indices of the candidates whose views must be rendered, as they show the new scan."""
        return np.flatnonzero(self.fraction > LEAST_CHANGED)


def add_scan(old: ScanMap, cloud: CloudStream, name: str, workers: Workers, watch: Stopwatch) -> ScanMap:
    """Add another scan in the map's coordinate system to the map, under a name of its own."""
    check_name(name, old.scan_names)
    with watch.stage("read"):
        new, warnings = read_added_scan(old, cloud)
    for warning in warnings:
        workers.warn(warning)
    with watch.stage("prepare"):
        own, added = (o.level(LEAF_SIZE) for o in (old.octree, new))
        octree = build_octree(join_voxels(own, added, old.R_map_from_world @ old.origin_world))
        layers, notes = look_for_layers(octree, old.R_map_from_world, old.origin_world, workers)
        found = join_candidates(old, new, octree, workers)
        sparse, _ = sparse_candidates(found.centers)
        wide = join_views(old, octree, found, sparse, workers)
        return replace(
            old,
            octree=octree,
            surface_variance=surface_variance(octree),
            layers=layers,
            centers=found.centers,
            scan_of_candidate=assign_scans(old, found),
            sparse=sparse,
            wide_features=wide.features,
            wide_seen=wide.seen,
            views=CandidateViews(octree, found.centers),
            places=DrawnPlaces(octree, found.centers),
            scan_names=(*old.scan_names, name),
            warnings=tuple(dict.fromkeys(old.warnings + warnings + notes)),
        )


def read_added_scan(old: ScanMap, cloud: CloudStream) -> tuple[Octree, tuple[str, ...]]:
    """Read a scan into an octree of its own, in the map's frame; return it with warnings."""
    if old.octree.leaf_size != LEAF_SIZE:
        found = f"found a map of voxels of {old.octree.leaf_size} m"
        raise InputError(f"`add`: {found}, wanted {LEAF_SIZE} m; prepare it again")
    voxels = cloud.voxels(old.R_map_from_world)
    nodes = voxels.nodes.copy()
    nodes[:, :3] += voxels.origin - np.rint(old.R_map_from_world @ old.origin_world)
    if (farthest := float(np.abs(nodes[:, :3]).max())) > WINDOW * LEAF_SIZE:
        found = f"found a scan {farthest / 1000.0:.0f} km from the map's"
        raise InputError(f"`add`: {found}, wanted one coordinate system")
    own = old.octree.level(COARSE_VOXEL)[:, :3]
    added = nodes[:, :3]
    gap = np.maximum(added.min(axis=0) - own.max(axis=0), own.min(axis=0) - added.max(axis=0))
    warnings = voxels.warnings
    if (apart := float(np.linalg.norm(np.maximum(gap, 0.0)))) > FAR_APART:
        warnings += (f"the scan lies {apart:.0f} m from the map's; both need one coordinate system",)
    return build_octree(Voxels(voxels.codes, nodes, voxels.origin)), warnings


def join_candidates(old: ScanMap, new: Octree, octree: Octree, workers: Workers) -> Candidates:
    """Join the candidates of a map and of a new scan.

    `new` is the octree of the new scan alone, `octree` that of both.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when a scan is added

    points = new.level(CLEARANCE_VOXEL)[:, :3]
    clearance, _ = cKDTree(points).query(old.centers, distance_upper_bound=2.0 * MIN_CLEARANCE)
    rows = np.flatnonzero(clearance > MIN_CLEARANCE)
    box = Box(points.min(axis=0) - BESIDE_SCAN, points.max(axis=0) + BESIDE_SCAN)
    positions = candidate_centers(octree, workers, box)
    gap, _ = cKDTree(old.centers).query(positions)
    more = positions[box.holds(positions) & (gap > 0.0)]
    in_front, behind = np.zeros((2, len(rows)))
    scan = Box(points.min(axis=0) - CLEARANCE_VOXEL, points.max(axis=0) + CLEARANCE_VOXEL)
    near = bound_sphere_fraction(scan, old.centers[rows]) > LEAST_CHANGED
    in_front[near], behind[near] = compare_ranges(new, old.octree, old.centers[rows[near]], workers)
    of_more = compare_ranges(new, old.octree, more, workers)
    fraction = np.concatenate([in_front, np.ones(len(more))])
    is_new = np.concatenate([in_front > behind, of_more[0] > of_more[1]]) & (fraction > LEAST_CHANGED)
    return Candidates(rows, np.concatenate([old.centers[rows], more]), fraction, is_new)


def bound_sphere_fraction(box: Box, centers: Array) -> Array:
    """Return an upper bound of the fraction (N,) of the sphere around centres (N, 3) [m] that a box covers.

    It is the fraction that a ball around the box covers. For a centre in the ball it is half, although the
    box may cover more there.
    """
    radius = 0.5 * float(np.linalg.norm(box.high - box.low))
    distance = np.linalg.norm(centers - 0.5 * (box.low + box.high), axis=1)
    sine = np.minimum(radius / np.maximum(distance, radius), 1.0)
    return np.asarray(0.5 * (1.0 - np.sqrt(1.0 - sine**2)))


def compare_ranges(new: Octree, old: Octree, centers: Array, workers: Workers) -> tuple[Array, Array]:
    """Return the fractions (N,) of the sphere in which a new scan is in front of the old, and behind it.

    The spheres are those around centres (N, 3) [m].
    """
    area = whole_areas(SEARCH_VIEW.num_rings).astype(np.float64)

    def compare(lo: int) -> tuple[Array, Array]:
        some = centers[lo : lo + VIEWS_A_TASK]
        of_new, of_old = (ranges_around(octree, some, SEARCH_VIEW) for octree in (new, old))
        of_new[of_new == 0.0] = np.inf
        of_old[of_old == 0.0] = np.inf
        return (of_new < NEARER * of_old) @ area, (of_old < NEARER * of_new) @ area

    parts = list(workers.map(compare, range(0, len(centers), VIEWS_A_TASK), "compare views"))
    in_front, behind = (np.concatenate([np.empty(0), *(part[k] for part in parts)]) for k in range(2))
    return in_front / area.sum(), behind / area.sum()


def join_views(
    old: ScanMap, octree: Octree, found: Candidates, sparse: Int64s, workers: Workers
) -> WideViews:
    """Return the wide views of the sparse candidates: the map's own, or rendered if changed or missing."""
    known = np.full(len(old.centers), -1)  # row of a candidate's view among the map's, or -1
    known[old.sparse] = np.arange(len(old.sparse))
    place = np.full(len(found.centers), -1)
    place[: len(found.rows)] = known[found.rows]
    place[found.rows_to_render] = -1
    is_kept = place[sparse] >= 0
    added = render_wide(octree, found.centers[sparse[~is_kept]], SEARCH_VIEW, workers)

    def join(own: Values, more: Values) -> Values:
        values = np.empty((len(sparse), own.shape[1]), own.dtype)
        values[is_kept] = own[place[sparse[is_kept]]]
        values[~is_kept] = more
        return values

    return WideViews(join(old.wide_features, added.features), join(old.wide_seen, added.seen))


def assign_scans(old: ScanMap, found: Candidates) -> Uint16s:
    """Return the index (N,) of the scan of each candidate.

    It is the new scan's if that is mostly in front; else a candidate of the map keeps its own, and a new one
    has that of the nearest candidate of the map.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when a scan is added

    num_known = len(found.rows)
    scans = np.zeros(len(found.centers), np.uint16)
    if num_known:
        _, nearest = cKDTree(found.centers[:num_known]).query(found.centers)
        scans = old.scan_of_candidate[found.rows][nearest]
        scans[:num_known] = old.scan_of_candidate[found.rows]
    scans[found.is_new] = len(old.scan_names)
    return scans
