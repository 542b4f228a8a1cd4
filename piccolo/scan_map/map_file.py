"""A prepared map on disk: a NumPy archive, mapped into memory unless another process may truncate it.

A file of another format is refused, and so is one damaged in any byte, as each member of the archive has a
checksum. A map may come from anybody, who can compute checksums too. So every index that a kernel takes from
a map is checked, every number is bounded, and the octree is compared with the grid of its voxels. A checked
file is remembered, and not checked again.
FORMAT changes only with the names, types or meaning of the arrays, so that map files remain valid after other
updates. The cache also compares the sources that make maps, and prepares a map again when they have changed.
"""

import math
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..cloud.octree import Octree
from ..cloud.readers.npz import naming_damage
from ..cloud.voxels import NUM_LEVELS, PHASE, QUANTUM_BITS, WINDOW
from ..geometry.pose import check_rotation
from ..geometry.sphere import make_grid
from ..system.arrays import Array, Array32, Int32s, Values
from ..system.errors import InputError
from ..system.files.array_archive import ArrayArchive, write_archive
from ..system.files.atomic import IS_WINDOWS, replacing
from ..system.files.cache import (
    WRITABLE,
    is_own,
    make_key,
    mark_used,
    own_names,
    private_folder,
    recall,
    remember,
)
from ..system.kernels.jit import F0, inline_kernel, kernel
from ..views.candidate_views import WIDE_RINGS, CandidateViews
from .drawn_places import DrawnPlaces
from .scan_map import MAX_SCANS, ScanMap, is_name, sparse_candidates

Arrays = dict[str, Values]
WIDE_CELLS = len(make_grid(WIDE_RINGS))
# Type and shape of each array. All axes of the same name have the same length.
LAYOUT: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "octree_nodes": ("<f4", ("nodes", 6)),
    "octree_first_child": ("<i4", ("links",)),
    "octree_level_start": ("<i4", (NUM_LEVELS + 1,)),
    "octree_leaf_size": ("<f8", ()),
    "R_map_from_world": ("<f8", (3, 3)),
    "origin_world": ("<f8", (3,)),
    "surface_variance": ("<f8", (3, 3)),
    "layers": ("<f8", (3, 3)),
    "centers": ("<f8", ("candidates", 3)),
    "scan_of_candidate": ("<u2", ("candidates",)),
    "sparse": ("<i8", ("sparse",)),
    "wide_features": ("|i1", ("sparse", 3 * WIDE_CELLS)),
    "wide_seen": ("|u1", ("sparse", WIDE_CELLS)),
    "has_shape": ("|b1", ()),
    "scan_sha256": ("<U64", ()),
    "crs": ("|u1", ("characters",)),  # UTF-8
}
SHA256 = re.compile("[0-9a-f]{64}")
ROTATION_ROUNDING = 1e-9  # largest error of the elements of a rotation or variance
LEAF_SIZES = 1e-3, 0.1  # [m] least and most
FARTHEST_ORIGIN = 1e12  # [m] largest coordinate of the map's origin in the world
VOXEL_MARGIN = 10.0  # [m] that points may lie beyond the voxels' window
BRIGHTEST_COLOR = np.float32(1.0 + 1e-6)  # 1 and rounding
LARGEST_DEVIATION = 1.0  # [m] of points from their surfaces
FARTHEST_LAYERS = 0.2, 1.0  # largest turn [rad] and move [m] between layers, by axis
MAX_CRS = 4 * 20_000  # [byte]
MAX_WARNINGS = 1000  # lines
MAX_WARNING = 5000  # characters of a line
FORMAT = "piccolo-map/11"
NAME = own_names("piccolo-map")  # pattern of file names in a cache
# fields of ScanMap that are not stored as one array of the same name
OTHERS = ("octree", "scan_names", "warnings", "crs", "is_partial", "views", "places")
ARRAYS = [f.name for f in fields(ScanMap) if f.name not in OTHERS]
MEMBERS = {*LAYOUT, "format", "scan_names", "warnings"}
WANTED = "wanted a whole map of tools/prepare_map.py"


@inline_kernel
def is_in_range(node: Array32, reach: float) -> bool:
    """Return True if a node (6,) is within `reach` of zero along each axis and has a valid colour."""
    is_one = True
    for k in range(3):
        is_one = is_one and abs(node[k]) <= reach and F0 <= node[3 + k] <= BRIGHTEST_COLOR
    return is_one


@kernel
def first_misplaced(
    nodes: Array32, first_child: Int32s, level_start: Int32s, origin: Array, leaf_size: float, reach: float
) -> int:
    """Return the first node outside its parent's voxel, beyond `reach` [m] or without valid colour, or -1.

    The child links must be valid. `origin` (3,) [m] is the map's origin in the grid that all levels share.
    """
    num_levels = len(level_start) - 1
    for node in range(len(nodes)):
        if not is_in_range(nodes[node], reach):
            return node
    for level in range(num_levels - 1):
        size = leaf_size * 2.0 ** (num_levels - 1 - level)
        for parent in range(level_start[level], level_start[level + 1]):
            for k in range(3):
                x = np.float64(nodes[parent, k])
                low = math.floor((x + origin[k]) / size) * size - origin[k]
                rounding = 1e-5 + 4e-7 * abs(x)  # float32
                for child in range(first_child[parent], first_child[parent + 1]):
                    if not (low - rounding <= nodes[child, k] <= low + size + rounding):
                        return child
    return -1


def check_arrays(path: Path, arrays: Arrays) -> None:
    """Refuse arrays that `save_map` can't have written; the warnings of the map are not checked here."""
    sizes: dict[str, int] = {}
    for name, (dtype, shape) in LAYOUT.items():
        found = arrays[name]
        wanted = len(shape) == found.ndim and tuple(
            sizes.setdefault(axis, length) if isinstance(axis, str) else axis
            for axis, length in zip(shape, found.shape, strict=True)
        )
        if found.dtype.str != dtype or found.shape != wanted:
            _refuse(path, f"{name} of type {found.dtype} and shape {found.shape}")
    _check_frame(path, arrays)
    _check_octree(path, arrays)
    _check_views(path, arrays)
    _check_scans(path, arrays)
    if not SHA256.fullmatch(str(arrays["scan_sha256"])):
        _refuse(path, "a scan_sha256 that is no digest")
    text = arrays["crs"].tobytes()
    if len(text) > MAX_CRS or not text.decode().isprintable():
        _refuse(path, "a crs that is no text")


def _refuse(path: Path, found: str) -> None:
    raise InputError(f"{path}: found {found}, wanted a map of tools/prepare_map.py; prepare it again")


def _reach(arrays: Arrays) -> float:
    """Return the largest coordinate [m] that a point of a map may have."""
    return WINDOW * float(arrays["octree_leaf_size"]) + VOXEL_MARGIN


def _check_frame(path: Path, arrays: Arrays) -> None:
    """Check rotation and variance, and that the origin has whole metres along the map's axes."""
    R = check_rotation(arrays["R_map_from_world"], ROTATION_ROUNDING, f"{path}: R_map_from_world of the map")
    origin: Array = arrays["origin_world"]
    if not (np.abs(origin).max() < FARTHEST_ORIGIN and np.abs(R @ origin - np.rint(R @ origin)).max() < 1e-3):
        _refuse(path, f"an origin_world of {origin.tolist()}")
    T: Array = arrays["surface_variance"]
    is_one = np.isfinite(T).all() and np.allclose(T, T.T, rtol=0.0, atol=ROTATION_ROUNDING)
    if not (is_one and -ROTATION_ROUNDING <= np.linalg.eigvalsh(T)[0] <= np.trace(T) <= LARGEST_DEVIATION**2):
        _refuse(path, f"a surface_variance of {T.tolist()}")


def _check_octree(path: Path, arrays: Arrays) -> None:
    """Check the octree: each node above the leaves has one to eight children, all within its voxel.

    The children of a level must be the next level. The layers of surfaces must not be far apart.
    """
    nodes = arrays["octree_nodes"]
    first_child = arrays["octree_first_child"]
    start = arrays["octree_level_start"]
    leaf_size = float(arrays["octree_leaf_size"])
    if not LEAF_SIZES[0] <= leaf_size <= LEAF_SIZES[1]:
        _refuse(path, f"leaves of {leaf_size} m")
    if start[0] != 0 or start[-1] != len(nodes) or not (start[:-1] < start[1:]).all():
        _refuse(path, f"levels that begin at {start.tolist()} of {len(nodes)} nodes")
    num_children = np.diff(first_child)
    is_tree = len(first_child) == len(nodes) + 1 and (first_child[start[:-1]] == start[1:]).all()
    inner, leaves = np.split(num_children, [start[-2]])
    if not (is_tree and inner.min() >= 1 and inner.max() <= 8 and not leaves.any()):
        _refuse(path, "invalid child links of the octree")
    origin_map = np.rint(arrays["R_map_from_world"] @ arrays["origin_world"])
    origin = origin_map + PHASE / (1 << QUANTUM_BITS) * leaf_size
    misplaced = first_misplaced(nodes, first_child, start, origin, leaf_size, _reach(arrays))
    if misplaced >= 0:
        _refuse(path, f"an octree whose node {misplaced} is {nodes[misplaced].tolist()}")
    middle, turn, move = np.abs(arrays["layers"]).max(axis=1)
    if not (middle <= _reach(arrays) and turn <= FARTHEST_LAYERS[0] and move <= FARTHEST_LAYERS[1]):
        _refuse(path, f"layers of {arrays['layers'].tolist()}")


def _check_views(path: Path, arrays: Arrays) -> None:
    """Check that candidates lie in the scan, that views have valid levels, and that `sparse` is right."""
    if not np.abs(arrays["centers"]).max(initial=0.0) <= _reach(arrays):
        _refuse(path, "a candidate at no finite place or too far away")
    for name, (dtype, _) in LAYOUT.items():
        if dtype == "|i1" and arrays[name].min(initial=0) < -127:
            _refuse(path, f"{name} below -127")
    if not np.array_equal(arrays["sparse"], sparse_candidates(arrays["centers"])[0]):
        _refuse(path, "sparse candidates that are not those of the coarse grid")


def _check_scans(path: Path, arrays: Arrays) -> None:
    """Check that the scans' names are valid and distinct, and that each candidate is in one of them."""
    found = arrays["scan_names"]
    index = arrays["scan_of_candidate"]
    if found.dtype.kind != "U" or found.ndim != 1 or len(found) > MAX_SCANS:
        _refuse(path, f"scan_names of type {found.dtype} and shape {found.shape}")
    names = list(map(str, found))
    if len(set(names)) < len(names) or not all(map(is_name, names)):
        _refuse(path, "invalid or duplicate names of scans")
    if index.max(initial=0) >= max(len(names), 1):
        _refuse(path, f"a candidate in scan {index.max()} of {len(names)}")


def clean_warnings(path: Path, warnings: Values) -> tuple[str, ...]:
    """Return the warnings of a map without control characters, limited in number and length."""
    if warnings.dtype.kind != "U" or warnings.ndim != 1:
        _refuse(path, f"warnings of type {warnings.dtype} and shape {warnings.shape}")
    lines = (str(line)[:MAX_WARNING] for line in warnings[:MAX_WARNINGS])
    return tuple("".join(c if c.isprintable() else "?" for c in line) for line in lines)


def save_map(scan_map: ScanMap, path: Path) -> None:
    """Write a map to `path` atomically."""
    members: dict[str, Values] = {
        "format": np.array(FORMAT),
        "scan_names": np.array(scan_map.scan_names, dtype=np.str_),
        "warnings": np.array(scan_map.warnings, dtype=np.str_),
        "crs": np.frombuffer(scan_map.crs.encode(), np.uint8),
    }
    members.update((name, np.asarray(getattr(scan_map, name))) for name in ARRAYS)
    octree = scan_map.octree._asdict()
    members.update((f"octree_{name}", np.asarray(value)) for name, value in octree.items())
    with replacing(path) as file:
        write_archive(file, members)


def is_map_file(path: Path) -> bool:
    """Return True if the file begins as a map of any version does; clouds may be NumPy archives too.

    The first member's name or its value is enough: a damaged map must still be refused as a map.
    """
    with path.open("rb") as file:
        head = file.read(512)
    has_name = head.startswith(b"format.npy", 30)  # after the 30 bytes of the member's header
    has_value = FORMAT.partition("/")[0].encode("utf-32-le") in head
    return head.startswith(b"PK\x03\x04") and (has_name or has_value)


@contextmanager
def hold_unchanged(path: Path, is_copied: bool) -> Iterator[Path | None]:
    """Provide a file of a map that can safely be mapped: the map itself, a copy in the user's cache, or None.

    A file in the cache is only ever replaced as a whole, and only the user can write there. Any other file
    may be truncated or overwritten at any time, which would kill or mislead a process that has mapped it. It
    is copied if `is_copied`. If the caller raises an exception, such as for damage, the copy is removed. On
    Windows the result is None: a mapped file could not be replaced.
    """
    if IS_WINDOWS:
        yield None
        return
    if NAME.fullmatch(path.name) and is_own(path.parent.stat(), WRITABLE):
        yield path
        return
    folder = private_folder("maps", NAME) if is_copied else None
    copy = folder and copy_into(path, folder)
    try:
        yield copy
    except BaseException:
        if copy:
            copy.unlink(missing_ok=True)
        raise


def copy_into(path: Path, folder: Path) -> Path | None:
    """Copy a file into a folder unless it has a current copy; return the copy, or None if that fails."""
    with path.open("rb") as file:
        copy = folder / f"{make_key('copy', os.fstat(file.fileno()))}.piccolo-map"
        try:
            if not copy.exists():
                with replacing(copy) as out:
                    shutil.copyfileobj(file, out, 1 << 22)
        except OSError:  # such as a full disk: the caller reads the file instead
            return None
    mark_used(copy)
    return copy


def load_map(path: Path, remembers: bool = False) -> ScanMap:
    """Read a map that `save_map` wrote, or map it into memory. Raise InputError for any other file.

    The whole file is read and checked. With `remembers` an unchanged file is checked only once.
    """
    what = f"checked as {FORMAT} by {__version__}"
    with naming_damage(path, WANTED), hold_unchanged(path, remembers) as place:
        archive = ArrayArchive(place or path, is_mapped=place is not None)
        if "format" in archive.members and (found := str(archive.array("format"))) != FORMAT:
            text = f"a map of format {found[:40]!r}, but this version reads {FORMAT}; prepare it again"
            raise InputError(f"{path}: {text}")
        if set(archive.members) != MEMBERS:
            raise ValueError(f"not the arrays of a map: {sorted(MEMBERS ^ set(archive.members))}")
        arrays = {name: archive.array(name) for name in archive.members}
        if not (remembers and recall(what, archive.status) is not None):
            for name in archive.members:
                archive.check(name)
            check_arrays(path, arrays)
            if remembers:
                remember(what, archive.status, "")
        warnings = clean_warnings(path, arrays["warnings"])
    own: dict[str, Any] = {name: arrays[name] for name in ARRAYS if name not in ("has_shape", "scan_sha256")}
    parts: dict[str, Any] = {name: arrays[f"octree_{name}"] for name in Octree._fields}
    octree = Octree(**{**parts, "leaf_size": float(arrays["octree_leaf_size"])})
    return ScanMap(
        octree=octree,
        views=CandidateViews(octree, arrays["centers"]),
        places=DrawnPlaces(octree, arrays["centers"]),
        has_shape=bool(arrays["has_shape"]),
        scan_names=tuple(map(str, arrays["scan_names"])),
        warnings=warnings,
        scan_sha256=str(arrays["scan_sha256"]),
        crs=arrays["crs"].tobytes().decode(),
        **own,
    )
