"""The map that is prepared once per cloud: octree, candidate camera positions, their views, scan names."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..cloud.cloud_settings import R_z_from_axis, UpAxis
from ..cloud.gravity import find_up, find_yaw_of_walls
from ..cloud.layers import NO_LAYERS, describe_layers, find_layers
from ..cloud.octree import Octree, build_octree
from ..cloud.stream import CloudStream
from ..cloud.surfaces import displacement, paint_shape, surface_variance
from ..geometry.points import MapFrame, PackedPoints, pack_points
from ..geometry.pose import Pose
from ..system.arrays import Array, Bytes, Int8s, Int64s, Mask, Uint16s
from ..system.errors import InputError
from ..system.jobs.threads import Stopwatch, Workers
from ..views.candidate_views import SEARCH_VIEW, CandidateViews, render_wide
from .camera_positions import COARSE_SPACING, Ball, TooManyPositionsError, candidate_centers
from .drawn_places import DrawnPlaces
from .storeys import Storeys, find_storeys

SHAPE_ALONE = "photos are localized by the shape of the scan, without colours"
LEAST_DEVIATION = 0.004  # of luminance: less comes from rounding colours to 8 bits
MAX_TILT = np.radians(5.0)  # between the floors' normal and the axis taken as up; a larger one is warned of
MAX_SCAN_NAME = 100  # characters
MAX_SCANS = 1000  # in one map


@dataclass(frozen=True)
class ScanMap(MapFrame):
    """A prepared cloud, in the map's frame: z up, with an origin of its own."""

    octree: Octree
    surface_variance: Array  # (3, 3) [m^2] of surfaces, by the scan's noise and doubled surfaces
    layers: Array  # (3, 3) motion between two layers of the surfaces, see `Layers`; 0 if there is one
    centers: Array  # (candidates, 3) [m] possible camera positions
    scan_of_candidate: Uint16s  # (candidates,) index of its scan in scan_names
    sparse: Int64s  # (sparse,) indices of the candidates that are searched, one in a cell of the coarse grid
    wide_features: Int8s  # (sparse, 3 * wide cells) the views from these, channels in levels
    wide_seen: Bytes  # (sparse, wide cells) fraction of each cell that is seen, 255 for all of it
    views: CandidateViews  # on fine cells, rendered when needed; not in files
    places: DrawnPlaces  # positions with pictures of the scan, drawn when needed; not in files
    has_shape: bool = False  # the scan has no colours: the octree's are edges of the surfaces
    scan_names: tuple[str, ...] = ()  # of the scans that were put together; empty if none was named
    warnings: tuple[str, ...] = ()
    scan_sha256: str = ""  # hexadecimal digest of the files or arrays from which it was made
    crs: str = ""  # coordinate system that the scan's file names, as WKT or EPSG:code, or empty
    is_partial: bool = False  # the scan is too large: candidates only where a prior allows; not in files

    @cached_property
    def points(self) -> PackedPoints:
        """The octree's finest voxels as coloured points, in the map's frame."""
        leaves = self.octree.level(self.octree.leaf_size)
        return pack_points(leaves[:, :3], np.round(leaves[:, 3:] * 255.0).astype(np.uint8))

    @cached_property
    def has_intensity(self) -> bool:
        """True for a map without colours whose points differ in intensity."""
        luminance = self.octree.level(COARSE_SPACING)[:, 3:].mean(axis=1)
        return self.has_shape and float(luminance.std()) > LEAST_DEVIATION

    @cached_property
    def displacement(self) -> float:
        """Standard deviation [m] by which surfaces are displaced, each independently of the others."""
        return displacement(self.octree)

    @cached_property
    def storeys(self) -> Storeys:
        """Storeys of the building, in the map's frame."""
        return find_storeys(self.octree)

    @cached_property
    def yaw_of_walls(self) -> float | None:
        """The turn about z [rad], in (-45, 45] deg, that aligns walls with x and y; None without walls."""
        return find_yaw_of_walls(self.octree)

    @cached_property
    def searched_for(self) -> Int64s:
        """The index (candidates,) of the candidate that is searched in each one's cell of the coarse grid."""
        first, cell = sparse_candidates(self.centers)
        return first[cell]

    def narrow(self, is_kept: Mask) -> "ScanMap":
        """Return the map with only those searched candidates that a mask (sparse,) keeps."""
        return replace(
            self,
            sparse=self.sparse[is_kept],
            wide_features=self.wide_features[is_kept],
            wide_seen=self.wide_seen[is_kept],
        )


def sparse_candidates(centers: Array) -> tuple[Int64s, Int64s]:
    """Return the indices (S,) of the candidates that come first in their cells of the coarse grid.

    `centers` (N, 3) [m] are all candidates. Return also, for each (N,), the index of its cell among the S.
    """
    cells = np.floor(centers / COARSE_SPACING).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    codes = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0, initial=0) + 1))
    _, first, cell = np.unique(codes, return_index=True, return_inverse=True)
    return first, cell.reshape(-1)


def find_candidates(
    octree: Octree, R_map_from_world: Array, origin_world: Array, part: Ball | None, workers: Workers
) -> tuple[Array, tuple[str, ...]]:
    """Find candidates (N, 3) [m] in the map's frame; return them with warnings.

    If the scan is too large as a whole, they are only in `part`, a ball of the world, and a warning says so.
    The map's frame is given by R_map_from_world (3, 3) and origin_world (3,) [m].
    """
    try:
        return candidate_centers(octree, workers), ()
    except TooManyPositionsError:
        if part is None:
            raise
    here = f"prepared within {part.radius:g} m of `near`, for this run only"
    text = f"the scan is too large as a whole: {here}"
    part_map = Ball(R_map_from_world @ (part.center - origin_world), part.radius)
    centers = candidate_centers(octree, workers, part_map)
    workers.warn(text)
    return centers, (text,)


def prepare_map(
    cloud: CloudStream,
    workers: Workers,
    up: UpAxis | Array = "auto",
    watch: Stopwatch | None = None,
    part: Ball | None = None,
) -> ScanMap:
    """Prepare a map of a cloud; if it has no colours, the edges of its surfaces take their place.

    `up` names the axis that is up, with "auto" that of the file's format; or it is a rotation (3, 3)
    R_map_from_world that makes z up. If the scan is too large as a whole, only `part`, a ball of the world,
    is prepared; raise TooManyPositionsError if there is none.
    """
    watch = watch or Stopwatch()
    R_map_from_world = R_z_from_axis(up, cloud.up) if isinstance(up, str) else up
    with watch.stage("read"):
        voxels = cloud.voxels(R_map_from_world, Workers(workers.num_threads))  # the reading is shown
        octree = build_octree(voxels)
        origin_world = R_map_from_world.T @ voxels.origin
        warnings = voxels.warnings
        if isinstance(up, str) and up == "auto":
            warnings += check_up(octree, R_map_from_world, cloud.up)
    has_shape = not cloud.has_colors
    if has_shape:
        warnings += (SHAPE_ALONE,)
    for warning in warnings:  # before the long steps, which take longer still in a wrong unit
        workers.warn(warning)
    with watch.stage("prepare"):
        if has_shape:
            octree = paint_shape(octree, workers)
        layers, found = look_for_layers(octree, R_map_from_world, origin_world, workers)
        centers, notes = find_candidates(octree, R_map_from_world, origin_world, part, workers)
        sparse, _ = sparse_candidates(centers)
        wide = render_wide(octree, centers[sparse], SEARCH_VIEW, workers)
        return ScanMap(
            octree=octree,
            R_map_from_world=R_map_from_world,
            origin_world=origin_world,
            surface_variance=surface_variance(octree),
            layers=layers,
            centers=centers,
            scan_of_candidate=np.zeros(len(centers), np.uint16),
            sparse=sparse,
            wide_features=wide.features,
            wide_seen=wide.seen,
            views=CandidateViews(octree, centers),
            places=DrawnPlaces(octree, centers),
            warnings=warnings + found + notes,
            is_partial=bool(notes),
            has_shape=has_shape,
        )


def look_for_layers(
    octree: Octree, R_map_from_world: Array, origin_world: Array, workers: Workers
) -> tuple[Array, tuple[str, ...]]:
    """Return the motion (3, 3) between two layers of a scan with a warning; zero and no warning without."""
    found = find_layers(octree, workers)
    if found is None:
        return NO_LAYERS, ()
    text = describe_layers(found, R_map_from_world.T @ found.place + origin_world)
    workers.warn(text)
    return found.motion, (text,)


def change_colors(scan_map: ScanMap, octree: Octree, workers: Workers) -> ScanMap:
    """Return the map with another octree, of the same points in other colours, and its views."""
    wide = render_wide(octree, scan_map.centers[scan_map.sparse], SEARCH_VIEW, workers)
    return replace(
        scan_map,
        octree=octree,
        wide_features=wide.features,
        wide_seen=wide.seen,
        views=CandidateViews(octree, scan_map.centers),
        places=DrawnPlaces(octree, scan_map.centers),
        has_shape=False,
    )


def check_up(octree: Octree, R_map_from_world: Array, taken: UpAxis) -> tuple[str, ...]:
    """Return a warning if the floors clearly do not face the map's z; it names the world's nearest axis."""
    axis, sense, reason, _ = find_up(octree)
    cosine = sense * axis[2]
    if sense == 0.0 or cosine > np.cos(MAX_TILT):
        return ()
    up_world = R_map_from_world.T @ (sense * axis)
    k = int(np.abs(up_world).argmax())
    nearest = f"{'-' if up_world[k] < 0.0 else ''}{'xyz'[k]}"
    angle = np.degrees(np.arccos(max(cosine, -1.0)))
    text = f"the floors face {angle:.0f} deg away from {taken}, which is used as up ({reason})"
    advice = "" if nearest == taken else f"set `up` to {nearest}, or "
    return (f"{text}; {advice}rotate the scan with tools/align_gravity.py",)


def is_name(name: str) -> bool:
    """Return True for a valid name: one printable line without spaces around it, not too long."""
    return 1 <= len(name) <= MAX_SCAN_NAME and name.isprintable() and name == name.strip()


def check_name(name: str, taken: Sequence[str]) -> None:
    """Refuse an invalid name of a new scan, one that is taken, and one scan too many."""
    if not is_name(name):
        raise InputError(f"`name`: found {name[:200]!r}, wanted 1 to {MAX_SCAN_NAME} printable characters")
    if name in taken:
        raise InputError(f"`name`: found {name!r}, which the map has already: {_list_names(taken)}")
    if len(taken) >= MAX_SCANS:
        raise InputError(f"`add`: found a map of {len(taken)} scans, the most that one holds")


def name_scan(scan_map: ScanMap, name: str) -> ScanMap:
    """Return a map of one scan with a name for that scan."""
    check_name(name, ())
    if len(scan_map.scan_names) > 1:
        raise InputError(f"`name`: found a map of several scans: {_list_names(scan_map.scan_names)}")
    return replace(scan_map, scan_names=(name,), scan_of_candidate=np.zeros_like(scan_map.scan_of_candidate))


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))


def check_within(scan_map: ScanMap, within: Sequence[str]) -> None:
    """Refuse names that are not names of the map's scans."""
    names = scan_map.scan_names
    if within and not names:
        wanted = "wanted a map of tools/prepare_map.py with `name`"
        raise InputError(f"`within`: found a scan without names, {wanted}")
    for name in within:
        if name not in names:
            raise InputError(f"`within`: found {name!r}, wanted of {_list_names(names)}")


def candidates_within(scan_map: ScanMap, within: Sequence[str]) -> Mask:
    """Return a mask (N,) of the candidates in the scans of these names."""
    indices = [k for k, name in enumerate(scan_map.scan_names) if name in within]
    return np.isin(scan_map.scan_of_candidate, indices)


def find_scan_at(scan_map: ScanMap, center_map: Array) -> str | None:
    """Return the scan of the candidate nearest to a place (3,) [m]; None if scans have no names."""
    if not (scan_map.scan_names and len(scan_map.centers)):
        return None
    offsets = scan_map.centers - center_map
    nearest = np.einsum("ij,ij->i", offsets, offsets).argmin()
    return scan_map.scan_names[int(scan_map.scan_of_candidate[nearest])]


def scan_of(scan_map: ScanMap, pose: Pose) -> str | None:
    """Return the scan in which a pose in the world lies, by name; None if scans have no names."""
    return find_scan_at(scan_map, scan_map.from_world(pose).center_world)
