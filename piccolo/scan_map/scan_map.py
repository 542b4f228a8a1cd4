"""What is prepared once per cloud: octree, places where a camera can be, and coarsely what it sees there."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree
from ..cloud.settings import UpAxis
from ..cloud.soa import PackedPoints, pack_points
from ..cloud.surface_noise import surface_variance
from ..geometry.pose import Array, Pose
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..local_features.feature_map import FeatureMap, make_feature_map
from ..local_features.view_positions import Look, view_positions
from ..scan_map.prior import NOTHING_KNOWN, Prior
from ..views.candidate_views import SEARCH_VIEW, CandidateViews, render_wide
from ..views.view import ViewConfig, ranges_around
from .aligned_cloud import AlignedCloud, Voxelized, read_aligned
from .camera_positions import COARSE_SPACING, Ball, TooManyPositionsError, candidate_centers
from .late_features import LateFeatures
from .storeys import Storeys, find_storeys


@dataclass(frozen=True)
class ScanMap:
    """A prepared cloud, in a frame of its own: x_map = R_map_from_world @ (x_world - origin_world), z up."""

    octree: Octree
    R_map_from_world: Array  # (3, 3), identity where the cloud's z is up
    origin_world: Array  # (3,) [m] middle of the leaves' box, in whole metres along the map's axes
    surface_variance: Array  # (3, 3) [m^2] that the scan's noise and doubled surfaces give to a position
    centers: NDArray[np.float64]  # (candidates, 3) [m]
    scan_of_candidate: NDArray[np.uint16]  # (candidates,) index of its name in scan_names
    sparse: NDArray[np.int64]  # candidates that are searched: no two share a cell of the coarse grid
    wide_features: NDArray[np.int8]  # (sparse, 3 * wide cells) what is seen from them, channels in levels
    wide_seen: NDArray[np.uint8]  # (sparse, wide cells) fraction seen of each, 255 for all
    views: CandidateViews  # of fine cells, made when they are asked for; not in files
    local_features: FeatureMap  # none of any view where they are made late; asked for by `features_now`
    has_labels: bool = False  # colours are those of labels
    scan_names: tuple[str, ...] = ()  # of the scans put together; none if none was named
    warnings: tuple[str, ...] = ()
    scan_sha256: str = ""  # of the files or arrays that it was made from, in hexadecimal digits
    crs: str = ""  # coordinate system that the scan's file names, as WKT or EPSG:code; empty if none
    is_partial: bool = False  # of a scan too large as a whole: candidates where a prior asks; not in files
    late: LateFeatures | None = None  # of a map that was prepared without local features; not in files

    @cached_property
    def points(self) -> PackedPoints:
        """The leaves of the octree as coloured points, in the map's frame."""
        leaves = self.octree.level(self.octree.leaf_size)
        return pack_points(leaves[:, :3], np.round(leaves[:, 3:] * 255.0).astype(np.uint8))

    @cached_property
    def storeys(self) -> Storeys:
        """The storeys, in the map's frame."""
        return find_storeys(self.octree)

    @cached_property
    def searched_for(self) -> NDArray[np.int64]:
        """The candidate (candidates,) of each one's cell of the coarse grid that is searched in its place."""
        first, cell = sparse_candidates(self.centers)
        return first[cell]

    def narrowed(self, is_kept: NDArray[np.bool_]) -> "ScanMap":
        """The same in which some (sparse,) of the candidates are searched."""
        return replace(
            self,
            sparse=self.sparse[is_kept],
            wide_features=self.wide_features[is_kept],
            wide_seen=self.wide_seen[is_kept],
        )

    @property
    def lacks_features(self) -> bool:
        """True if no view was looked at for local features, though there are some."""
        return len(self.local_features.view_centers) == 0 < len(self.centers)

    def features_now(self, workers: Workers) -> FeatureMap:
        """The local features, made now where they are late."""
        return self.late.get(workers) if self.late else self.local_features

    def to_world(self, pose: Pose) -> Pose:
        """A pose of the map's frame in the world."""
        R_map_from_world = self.R_map_from_world
        center_world = R_map_from_world.T @ pose.center_world + self.origin_world
        return Pose(pose.R_cam_from_world @ R_map_from_world, center_world)

    def from_world(self, pose: Pose) -> Pose:
        """A pose of the world in the map's frame."""
        center = self.R_map_from_world @ (pose.center_world - self.origin_world)
        return Pose(pose.R_cam_from_world @ self.R_map_from_world.T, center)


def sparse_candidates(centers: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the candidates (N, 3) [m] that come first in their cells of the coarse grid.

    And for each candidate (N,) which of these it is that lies in the same cell.
    """
    cells = np.floor(centers / COARSE_SPACING).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    codes = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0, initial=0) + 1))
    _, first, cell = np.unique(codes, return_index=True, return_inverse=True)
    return first, cell.reshape(-1)


def candidates_of(
    aligned: AlignedCloud, prior: Prior, workers: Workers
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Candidates (N, 3) [m]; of a scan too large as a whole those near the prior's place, and a warning."""
    try:
        return candidate_centers(aligned.octree, workers), ()
    except TooManyPositionsError:
        if prior.near_world is None or prior.radius is None:
            raise
    near = aligned.R_map_from_world @ (np.array(prior.near_world) - aligned.origin_world)
    centers = candidate_centers(aligned.octree, workers, Ball(near, prior.radius))
    text = (
        f"the scan is too large as a whole: prepared within {prior.radius:g} m of --near, for this run only"
    )
    workers.warn(text)
    return centers, (text,)


def prepare_map(
    cloud: Voxelized,
    workers: Workers,
    up: UpAxis | Array = "auto",
    watch: Stopwatch | None = None,
    view: ViewConfig = SEARCH_VIEW,
    prior: Prior = NOTHING_KNOWN,
    has_features: bool = True,
) -> ScanMap:
    """Everything about a cloud that does not depend on the panorama; local features may come late.

    Of a scan too large as a whole, what the prior allows; TooManyPositionsError if it names no place.
    """
    watch = watch or Stopwatch()
    with watch.stage("read"):
        aligned = read_aligned(cloud, up)
    for warning in aligned.warnings:  # now: a wrong unit makes what follows long
        workers.warn(warning)
    with watch.stage("prepare"):
        octree = aligned.octree
        centers, notes = candidates_of(aligned, prior, workers)
        sparse, _ = sparse_candidates(centers)
        wide = render_wide(octree, centers[sparse], view, workers)
        local_features = make_feature_map(octree, centers[:0], Workers())
    scan_map = ScanMap(
        octree=octree,
        R_map_from_world=aligned.R_map_from_world,
        origin_world=aligned.origin_world,
        surface_variance=surface_variance(octree),
        centers=centers,
        scan_of_candidate=np.zeros(len(centers), np.uint16),
        sparse=sparse,
        wide_features=wide.features,
        wide_seen=wide.seen,
        views=CandidateViews(octree, centers, view),
        local_features=local_features,
        warnings=aligned.warnings + notes,
        is_partial=bool(notes),
    )
    if not has_features:
        return with_late_features(scan_map)
    with watch.stage("prepare"):
        return replace(scan_map, local_features=find_local_features(scan_map, workers))


def find_local_features(scan_map: ScanMap, workers: Workers) -> FeatureMap:
    """The features of the views from few of a map's candidates, chosen by what they see."""
    octree, centers = scan_map.octree, scan_map.centers
    chosen = view_positions(centers, seen_by(octree, centers), SEARCH_VIEW.num_rings)
    return make_feature_map(octree, centers[chosen], workers)


def seen_by(octree: Octree, centers: NDArray[np.float64]) -> Look:
    """How far one sees from each of some centres (N, 3), by its index."""
    return lambda k: ranges_around(octree, centers[k : k + 1], SEARCH_VIEW)[0]


def with_features(scan_map: ScanMap, workers: Workers) -> ScanMap:
    """A map that has its local features."""
    return replace(scan_map, local_features=scan_map.features_now(workers), late=None)


def with_late_features(scan_map: ScanMap) -> ScanMap:
    """A map without local features, which makes them when they are first asked for."""
    return replace(scan_map, late=LateFeatures(lambda workers: find_local_features(scan_map, workers)))
