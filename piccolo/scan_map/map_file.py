"""A prepared map on disk: a NumPy archive, mapped into memory if no other process can truncate it meanwhile.

A file of another format, or damaged in any byte (each member of an archive has a checksum), is refused;
`map_validation.py` checks the contents of undamaged files. The identity of a checked file is remembered.
FORMAT changes with the meaning of the arrays, so that a file outlives an update; the cache also knows the
sources by which a map was made, and makes it again when they have changed.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..cloud.octree import Octree
from ..cloud.readers.npz import naming_damage
from ..errors import InputError
from ..files.array_archive import ArrayArchive, write_archive
from ..files.atomic import replacing
from ..files.cache import WRITABLE, is_own, make_key, mark_used, own_names, private_folder, recall, remember
from ..local_features.feature_map import FeatureMap
from ..views.candidate_views import CandidateViews
from .map_validation import LAYOUT, check_arrays, clean_warnings
from .scan_map import ScanMap, defer_features

FORMAT = "piccolo-map/8"
NAME = own_names("piccolo-map")  # in a cache
OTHERS = ("octree", "local_features", "scan_names", "warnings", "crs", "is_partial", "views", "late")
ARRAYS = [f.name for f in fields(ScanMap) if f.name not in OTHERS]
MEMBERS = {*LAYOUT, "format", "scan_names", "warnings"}
WANTED = "wanted a whole map of tools/prepare_map.py"


def save_map(scan_map: ScanMap, path: Path) -> None:
    """Write a map to `path` atomically."""
    members: dict[str, NDArray[Any]] = {
        "format": np.array(FORMAT),
        "scan_names": np.array(scan_map.scan_names, dtype=np.str_),
        "warnings": np.array(scan_map.warnings, dtype=np.str_),
        "crs": np.frombuffer(scan_map.crs.encode(), np.uint8),
    }
    members.update((name, np.asarray(getattr(scan_map, name))) for name in ARRAYS)
    for label, part in (("octree", scan_map.octree), ("local", scan_map.local_features)):
        members.update((f"{label}_{name}", np.asarray(value)) for name, value in part._asdict().items())
    with replacing(path) as file:
        write_archive(file, members)


def is_map_file(path: Path) -> bool:
    """Return True if the file begins as `save_map` writes it, in any version; clouds may be archives too.

    The first member's name or value is enough, so that a damaged map is still refused as a map.
    """
    with path.open("rb") as file:
        head = file.read(512)
    has_name = head.startswith(b"format.npy", 30)  # behind its header
    has_value = FORMAT.partition("/")[0].encode("utf-32-le") in head
    return head.startswith(b"PK\x03\x04") and (has_name or has_value)


@contextmanager
def hold_unchanged(path: Path, is_copied: bool) -> Iterator[Path | None]:
    """Provide a map's file that may be mapped: itself, or a copy in the user's cache; else None.

    A file in the cache, where only the user may write, is only ever replaced whole. Any other may be
    truncated or overwritten in place at any time, which would kill, or mislead, a process that has mapped it.
    A copy in which the caller finds damage is removed.
    """
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
    """Copy a file into a folder unless its current copy is there; None if that fails."""
    with path.open("rb") as file:
        copy = folder / f"{make_key('copy', os.fstat(file.fileno()))}.piccolo-map"
        try:
            if not copy.exists():
                with replacing(copy) as out:
                    shutil.copyfileobj(file, out, 1 << 22)
        except OSError:  # as where the disk is full: it is read instead
            return None
    mark_used(copy)
    return copy


def load_map(path: Path, remembers: bool = False) -> ScanMap:
    """Read a map that `save_map` wrote, or map it into memory; InputError for any other file.

    All of it is read and checked; with `remembers` only once, as long as the file is unchanged.
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
    own: dict[str, Any] = {
        name: arrays[name] for name in ARRAYS if name not in ("has_labels", "has_shape", "scan_sha256")
    }
    parts: dict[str, Any] = {name: arrays[f"octree_{name}"] for name in Octree._fields}
    octree = Octree(**{**parts, "leaf_size": float(arrays["octree_leaf_size"])})
    scan_map = ScanMap(
        octree=octree,
        views=CandidateViews(octree, arrays["centers"]),
        local_features=FeatureMap(**{name: arrays[f"local_{name}"] for name in FeatureMap._fields}),
        has_labels=bool(arrays["has_labels"]),
        has_shape=bool(arrays["has_shape"]),
        scan_names=tuple(map(str, arrays["scan_names"])),
        warnings=warnings,
        scan_sha256=str(arrays["scan_sha256"]),
        crs=arrays["crs"].tobytes().decode(),
        **own,
    )
    return defer_features(scan_map) if scan_map.lacks_features else scan_map
