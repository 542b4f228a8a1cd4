"""What is prepared once per cloud: octree, places where a camera can be, and what it sees from each."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree
from ..cloud.settings import UpAxis
from ..cloud.soa import PackedPoints, pack_points
from ..cloud.surface_noise import surface_variance
from ..geometry.pose import Array, Pose
from ..geometry.sphere import SEARCH_RINGS, averaging, make_grid
from ..local_features.feature_map import FeatureMap, make_feature_map
from ..local_features.view_positions import view_positions
from ..runtime.memory import check_memory
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .aligned_cloud import AlignedCloud, Voxelized, read_once
from .camera_positions import BLOCK, COARSE_SPACING, Ball, TooManyPositionsError, candidate_centers
from .late_features import LateFeatures
from .settings import NOTHING_KNOWN, Prior
from .storeys import Storeys, find_storeys
from .view import ViewConfig, render_block, thread_scratch

WIDE_RINGS = 12
SEARCH_VIEW = ViewConfig(num_rings=SEARCH_RINGS, stats_rings=16, sigma_deg=22.0, voxel_per_range=1 / 15)
BYTES_PER_CELL = 6 + 3 + 1 + 4  # of a view: offsets, channels, seen; and what is made of them for a search
# of some centres, as ScanMap holds them: offsets, their units, channels and seen cells
Views = tuple[NDArray[np.int16], NDArray[np.float32], NDArray[np.int8], NDArray[np.bool_]]


@dataclass(frozen=True)
class ScanMap:
    """A prepared cloud, in a frame of its own: x_map = R_map_from_world @ (x_world - origin_world), z up."""

    octree: Octree
    R_map_from_world: Array  # (3, 3), identity where the cloud's z is up
    origin_world: Array  # (3,) [m] middle of the leaves' box, in whole metres along the map's axes
    surface_variance: Array  # (3, 3) [m^2] that the scan's noise and doubled surfaces give to a position
    centers: NDArray[np.float64]  # (candidates, 3) [m]
    offsets: NDArray[np.int16]  # (candidates, 3, cells) from the centre to what is seen, in units of
    offset_unit: NDArray[np.float32]  # (candidates,) [m]
    features: NDArray[np.int8]  # (candidates, 3, cells) channels in levels, 0 where nothing is seen
    is_seen: NDArray[np.bool_]  # (candidates, cells)
    scan_of_candidate: NDArray[np.uint16]  # (candidates,) index of its name in scan_names
    sparse: NDArray[np.int64]  # candidates of which no two share a cell of the coarse grid
    wide_features: NDArray[np.int8]  # (sparse, 3 * wide cells) means over wider cells, for SO(3)
    wide_seen: NDArray[np.uint8]  # (sparse, wide cells) fraction seen of each, 255 for all
    local_features: FeatureMap  # none of any view where they are made late; asked for by `features_now`
    has_labels: bool = False  # colours are those of labels
    scan_names: tuple[str, ...] = ()  # of the scans put together; none if none was named
    warnings: tuple[str, ...] = ()
    scan_sha256: str = ""  # of the files or arrays that it was made from, in hexadecimal digits
    crs: str = ""  # coordinate system that the scan's file names, as WKT or EPSG:code; empty if none
    is_partial: bool = False  # of a scan too large as a whole: candidates where a prior asks; not in files
    whole: "ScanMap | None" = None  # with all candidates, of a map narrowed by a prior; not in files
    late: LateFeatures | None = None  # of a map that was prepared without local features; not in files

    @cached_property
    def points(self) -> PackedPoints:
        """The leaves of the octree as coloured points, in the map's frame."""
        return _as_points(self.octree.level(self.octree.leaf_size))

    @cached_property
    def coarse_points(self) -> PackedPoints:
        """The same from voxels four times as wide: enough for views of a few degrees."""
        return _as_points(self.octree.level(4.0 * self.octree.leaf_size))

    @cached_property
    def storeys(self) -> Storeys:
        """The storeys, in the map's frame."""
        return find_storeys(self.octree)

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


def _as_points(nodes: NDArray[np.float32]) -> PackedPoints:
    return pack_points(nodes[:, :3], np.round(nodes[:, 3:] * 255.0).astype(np.uint8))


def render_candidates(
    octree: Octree,
    centers: NDArray[np.float64],
    config: ViewConfig,
    workers: Workers,
    label: str = "render views",
) -> Views:
    """The views from some centres (N, 3) [m]; the label of the progress also tells octrees apart."""
    cells = len(make_grid(config.num_rings))
    num_bytes = len(centers) * cells * BYTES_PER_CELL
    check_memory(num_bytes, f"the scan: {len(centers)} prepared views", "cut out a part of it")
    offsets, unit = np.empty((len(centers), 3, cells), np.int16), np.empty(len(centers), np.float32)
    levels, is_seen = np.empty((len(centers), 3, cells), np.int8), np.empty((len(centers), cells), np.bool_)
    wholes: list[NDArray[Any]] = [offsets, unit, levels, is_seen]
    view, begins = config.arrays, range(0, len(centers), BLOCK)

    def run(lo: int) -> Views:
        part = slice(lo, lo + BLOCK)
        out = offsets[part], unit[part], levels[part], is_seen[part]
        render_block(octree, centers[part], config.voxel_per_range, view, thread_scratch(), *out)
        return out

    for lo, found in zip(begins, workers.collect(run, begins, label, centers), strict=True):
        for whole, part in zip(wholes, found, strict=True):
            whole[lo : lo + BLOCK] = part  # what was made before; the rest is there
    return offsets, unit, levels, is_seen


def ranges_of(
    offsets: NDArray[np.int16], unit: NDArray[np.float32], is_seen: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """How far away (N, cells) [m] is what views show, as ScanMap holds them; 0 where nothing is seen."""
    return np.asarray(np.linalg.norm(offsets.astype(np.float32), axis=1) * unit[:, None] * is_seen)


def sparse_candidates(centers: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the candidates (N, 3) [m] that come first in their cells of the coarse grid."""
    cells = np.floor(centers / COARSE_SPACING).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    codes = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0, initial=0) + 1))
    return np.unique(codes, return_index=True)[1]


def widen(
    levels: NDArray[np.int8], is_seen: NDArray[np.bool_], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int8], NDArray[np.uint8]]:
    """Some rows of views (N, 3, cells) averaged over the wider cells, and the fraction seen of these."""
    matrix = averaging(WIDE_RINGS)
    area = matrix.sum(axis=0)
    features = np.empty((len(rows), 3, len(area)), np.int8)
    fraction = np.empty((len(rows), len(area)), np.uint8)
    for lo in range(0, len(rows), 1024):
        part = rows[lo : lo + 1024]
        mean = levels[part].astype(np.float32) @ matrix / area
        features[lo : lo + 1024] = np.rint(np.clip(mean, -127, 127))
        seen = np.minimum(is_seen[part].astype(np.float32) @ matrix / area, 1.0)
        fraction[lo : lo + 1024] = np.rint(seen * 255.0)
    return features.reshape(len(rows), 3 * len(area)), fraction


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
    up: UpAxis = "auto",
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
        aligned = read_once(cloud, up, workers.work)
    for warning in aligned.warnings:  # now: a wrong unit makes what follows long
        workers.warn(warning)
    with watch.stage("prepare"):
        octree = aligned.octree
        centers, notes = candidates_of(aligned, prior, workers)
        offsets, unit, levels, is_seen = render_candidates(octree, centers, view, workers)
        sparse = sparse_candidates(centers)
        wide_features, wide_seen = widen(levels, is_seen, sparse)
        local_features = make_feature_map(octree, centers[:0], Workers())
    scan_map = ScanMap(
        octree=octree,
        R_map_from_world=aligned.R_map_from_world,
        origin_world=aligned.origin_world,
        surface_variance=surface_variance(octree),
        centers=centers,
        offsets=offsets,
        offset_unit=unit,
        features=levels,
        is_seen=is_seen,
        scan_of_candidate=np.zeros(len(centers), np.uint16),
        sparse=sparse,
        wide_features=wide_features,
        wide_seen=wide_seen,
        local_features=local_features,
        warnings=aligned.warnings + notes,
        is_partial=bool(notes),
    )
    if not has_features:
        return with_late_features(scan_map, view)
    with watch.stage("prepare"):
        return replace(scan_map, local_features=find_local_features(scan_map, view, workers))


def find_local_features(scan_map: ScanMap, view: ViewConfig, workers: Workers) -> FeatureMap:
    """The features of the views from few of a map's candidates, chosen by what they see."""
    m = scan_map
    chosen = view_positions(m.centers, ranges_of(m.offsets, m.offset_unit, m.is_seen), view.num_rings)
    return make_feature_map(m.octree, m.centers[chosen], workers)


def with_features(scan_map: ScanMap, workers: Workers) -> ScanMap:
    """A map that has its local features."""
    return replace(scan_map, local_features=scan_map.features_now(workers), late=None)


def with_late_features(scan_map: ScanMap, view: ViewConfig = SEARCH_VIEW) -> ScanMap:
    """A map without local features, which makes them when they are first asked for."""
    return replace(scan_map, late=LateFeatures(lambda workers: find_local_features(scan_map, view, workers)))
