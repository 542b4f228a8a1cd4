"""Another scan in a map: only what it changes is prepared anew.

Candidates stay where they are, views and local features are made anew where the new scan is seen, and all
else keeps every bit.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree, build_octree
from ..cloud.surface_noise import surface_variance
from ..cloud.voxels import LEAF_SIZE, WINDOW, Voxels, join_voxels
from ..errors import InputError
from ..geometry.pose import Array
from ..geometry.sphere import make_grid
from ..local_features.feature_map import MOST_VIEWS, FeatureMap, extend_feature_map
from ..local_features.view_positions import view_positions
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .aligned_cloud import Voxelized
from .camera_positions import CLEARANCE_VOXEL, MIN_CLEARANCE, Box, candidate_centers
from .named_scans import check_name
from .scan_map import (
    SEARCH_VIEW,
    ScanMap,
    Views,
    ranges_of,
    render_candidates,
    sparse_candidates,
    widen,
)

REACH = 3.0  # [m] beside the new scan there may be new places for a camera
NEARER = 0.9  # of two scans the one in front is nearer by this
# Fractions of the sphere in which a view shows the new scan, else it stays, or its features do: what they
# miss, new views have from nearer.
LEAST_CHANGED, LEAST_FOR_FEATURES = 0.01, 0.1
FAR_APART = 500.0  # [m] between scans that perhaps have no common coordinates
COARSE_VOXEL = 2.56  # [m]
ROWS = 8192  # views compared at a time


class Candidates(NamedTuple):
    """Candidates of a map and a new scan: those of the map that stay, and then new ones."""

    rows: NDArray[np.int64]  # (S,) of the map's candidates, those that stay
    centers: NDArray[np.float64]  # (N, 3) [m]
    fraction: Array  # (N,) of the sphere in which the new scan is in front; of new ones 1
    is_new: NDArray[np.bool_]  # (N,) more of the sphere shows the new scan in front than the others

    @property
    def changed(self) -> NDArray[np.int64]:
        """Indices of those whose views are to be made anew."""
        return np.flatnonzero(self.fraction > LEAST_CHANGED)


def add_scan(old: ScanMap, cloud: Voxelized, name: str, workers: Workers, watch: Stopwatch) -> ScanMap:
    """A map and another scan in the same coordinates, under a name of its own."""
    check_name(name, old.scan_names)
    with watch.stage("read"):
        new, warnings = read_beside(old, cloud)
    for warning in warnings:
        workers.warn(warning)
    with watch.stage("prepare"):
        leaves = old.octree.level(LEAF_SIZE), new.level(LEAF_SIZE)
        octree = build_octree(join_voxels(*leaves, old.R_map_from_world @ old.origin_world))
        found = joined_candidates(old, new, octree, workers)
        offsets, unit, levels, is_seen = views = joined_views(old, octree, found, workers)
        sparse = sparse_candidates(found.centers)
        wide_features, wide_seen = widen(levels, is_seen, sparse)
        return replace(
            old,
            octree=octree,
            surface_variance=surface_variance(octree),
            centers=found.centers,
            offsets=offsets,
            offset_unit=unit,
            features=levels,
            is_seen=is_seen,
            scan_of_candidate=scans_of(old, found),
            sparse=sparse,
            wide_features=wide_features,
            wide_seen=wide_seen,
            local_features=joined_features(old, octree, found, views, workers),
            scan_names=(*old.scan_names, name),
            warnings=tuple(dict.fromkeys(old.warnings + warnings)),
        )


def read_beside(old: ScanMap, cloud: Voxelized) -> tuple[Octree, tuple[str, ...]]:
    """The octree of a scan alone, in a map's frame, and warnings."""
    if old.octree.leaf_size != LEAF_SIZE:
        found = f"found a map of voxels of {old.octree.leaf_size} m"
        raise InputError(f"--add: {found}, wanted {LEAF_SIZE} m; prepare it again")
    voxels = cloud.voxels(old.R_map_from_world)
    nodes = voxels.nodes.copy()
    nodes[:, :3] += voxels.origin - np.rint(old.R_map_from_world @ old.origin_world)
    if (farthest := float(np.abs(nodes[:, :3]).max())) > WINDOW * LEAF_SIZE:
        found = f"found a scan {farthest / 1000.0:.0f} km from the map's"
        raise InputError(f"--add: {found}, wanted one coordinate system")
    first, second = old.octree.level(COARSE_VOXEL)[:, :3], nodes[:, :3]
    gap = np.maximum(second.min(axis=0) - first.max(axis=0), first.min(axis=0) - second.max(axis=0))
    warnings = voxels.warnings
    if (apart := float(np.linalg.norm(np.maximum(gap, 0.0)))) > FAR_APART:
        warnings += (f"the scan lies {apart:.0f} m from the map's; both need one coordinate system",)
    return build_octree(Voxels(voxels.codes, nodes, voxels.origin)), warnings


def joined_candidates(old: ScanMap, new: Octree, octree: Octree, workers: Workers) -> Candidates:
    """The candidates of a map and a new scan, by the octrees of the new one alone and of both."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

    points = new.level(CLEARANCE_VOXEL)[:, :3]
    clearance, _ = cKDTree(points).query(old.centers, distance_upper_bound=2.0 * MIN_CLEARANCE)
    rows = np.flatnonzero(clearance > MIN_CLEARANCE)
    box = Box(points.min(axis=0) - REACH, points.max(axis=0) + REACH)
    positions = candidate_centers(octree, workers, box)
    gap, _ = cKDTree(old.centers).query(positions)
    more = positions[box.holds(positions) & (gap > 0.0)]
    in_front, behind = fractions_in_front(old, new, rows, workers)
    views = render_candidates(old.octree, more, SEARCH_VIEW, workers, "look around")
    of_more = compared(new, more, ranges_of(*views[:2], views[3]), workers)
    fraction = np.concatenate([in_front, np.ones(len(more))])
    is_new = np.concatenate([in_front > behind, of_more[0] > of_more[1]]) & (fraction > LEAST_CHANGED)
    return Candidates(rows, np.concatenate([old.centers[rows], more]), fraction, is_new)


def fractions_in_front(
    old: ScanMap, new: Octree, rows: NDArray[np.int64], workers: Workers
) -> tuple[Array, Array]:
    """What `compared` says of some of a map's candidates (S,)."""
    parts = [np.empty((2, 0))]
    for lo in range(0, len(rows), ROWS):
        some = rows[lo : lo + ROWS]
        ranges = ranges_of(old.offsets[some], old.offset_unit[some], old.is_seen[some])
        parts.append(np.stack(compared(new, old.centers[some], ranges, workers)))
    in_front, behind = np.concatenate(parts, axis=1)
    return in_front, behind


def compared(
    new: Octree, centers: Array, ranges: NDArray[np.float32], workers: Workers
) -> tuple[Array, Array]:
    """Fractions of the sphere (N,) about each centre (N, 3) where a new scan is in front, and behind.

    Of the others ranges (N, cells) [m] are known, 0 where nothing is seen.
    """
    offsets, unit, _, is_seen = render_candidates(new, centers, SEARCH_VIEW, workers, "compare views")
    ranges_new = np.where(is_seen, ranges_of(offsets, unit, is_seen), np.inf)
    ranges_old = np.where(ranges > 0.0, ranges, np.inf)
    area = make_grid(SEARCH_VIEW.num_rings).solid_angle.astype(np.float64)
    area /= area.sum()
    return (ranges_new < NEARER * ranges_old) @ area, (ranges_old < NEARER * ranges_new) @ area


def joined_views(old: ScanMap, octree: Octree, found: Candidates, workers: Workers) -> Views:
    """Views as of render_candidates: the map's, and those that have changed anew."""
    anew = render_candidates(octree, found.centers[found.changed], SEARCH_VIEW, workers)
    kept: list[NDArray[Any]] = [old.offsets, old.offset_unit, old.features, old.is_seen]
    views: list[Any] = []
    for known, rendered in zip(kept, anew, strict=True):
        joined = np.empty((len(found.centers), *known.shape[1:]), known.dtype)
        joined[: len(found.rows)] = known[found.rows]
        joined[found.changed] = rendered
        views.append(joined)
    return (views[0], views[1], views[2], views[3])


def scans_of(old: ScanMap, found: Candidates) -> NDArray[np.uint16]:
    """The scan of each candidate (N,): as it was, of new places that of the nearest, or the new one."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

    num_known = len(found.rows)
    scans = np.zeros(len(found.centers), np.uint16)
    if num_known:
        _, nearest = cKDTree(found.centers[:num_known]).query(found.centers)
        scans = old.scan_of_candidate[found.rows][nearest]
        scans[:num_known] = old.scan_of_candidate[found.rows]
    scans[found.is_new] = len(old.scan_names)
    return scans


def joined_features(
    old: ScanMap, octree: Octree, found: Candidates, views: Views, workers: Workers
) -> FeatureMap:
    """Features of the map's views, taken anew where these have changed, and of as many more as are needed."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

    view_centers = old.local_features.view_centers
    gap, place = cKDTree(found.centers).query(view_centers)
    has_place = gap == 0.0  # it is that of a candidate which stays
    is_kept = has_place.copy()
    is_kept[has_place] = found.fraction[place[has_place]] <= LEAST_FOR_FEATURES
    looked_at = np.concatenate([place[has_place], found.changed])
    offsets, unit, _, is_seen = (values[looked_at] for values in views)
    ranges = ranges_of(offsets, unit, is_seen)
    num_known = int(np.count_nonzero(has_place))
    more = view_positions(found.centers[looked_at], ranges, SEARCH_VIEW.num_rings, num_known)
    anew = np.concatenate([place[has_place & ~is_kept], looked_at[more]])
    if np.count_nonzero(is_kept) + len(anew) > MOST_VIEWS:
        raise InputError(f"--add: found more than {MOST_VIEWS} views with features, the most of one map")
    return extend_feature_map(old.local_features, is_kept, octree, found.centers[anew], workers)
