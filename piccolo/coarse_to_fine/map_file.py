"""A prepared map on disk: a NumPy archive, and the cache of such files.

A file of another format, or damaged in any byte (each member of an archive has a checksum), is never trusted.
FORMAT changes with what the arrays mean, so that a file outlives an update; the cache also knows the sources
by which a map was made, and makes it anew when they have changed.
"""

import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np

from ..cloud.octree import Octree
from ..errors import InputError
from ..runtime.atomic import replacing
from .scan_map import ScanMap

FORMAT = "piccolo-map/2"
ARRAYS = [f.name for f in fields(ScanMap) if f.name not in ("octree", "warnings", "is_partial")]
ZIP_MAGIC = b"PK\x03\x04"
# The first member of a map: its name and where that stands, and the beginning of its value somewhere behind.
FIRST_NAME, FIRST_NAME_AT = b"format.npy", 30
FIRST_VALUE, FIRST_VALUE_WITHIN = FORMAT.partition("/")[0].encode("utf-32-le"), 512


def save_map(scan_map: ScanMap, path: Path) -> None:
    """Write a map to `path`, whole or not at all."""
    members = {name: getattr(scan_map, name) for name in ARRAYS}
    members.update({f"octree_{name}": value for name, value in scan_map.octree._asdict().items()})
    with replacing(path) as file:
        np.savez(
            file,
            format=np.array(FORMAT),
            warnings=np.array(scan_map.warnings, dtype=np.str_),
            allow_pickle=False,
            **members,
        )


def is_map_file(path: Path) -> bool:
    """True if the file begins as `save_map` writes it, of whatever version; clouds may be archives too.

    The first member's name or its value is enough, so that a damaged map is still refused as a map.
    """
    with path.open("rb") as file:
        head = file.read(FIRST_VALUE_WITHIN)
    has_name = head.startswith(FIRST_NAME, FIRST_NAME_AT)
    return head.startswith(ZIP_MAGIC) and (has_name or FIRST_VALUE in head)


def load_map(path: Path) -> ScanMap:
    """Read what `save_map` wrote; InputError for anything else."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            members = {name: archive[name] for name in archive.files}
        if str(members["format"]) != FORMAT:
            found = members["format"]
            raise InputError(
                f"{path}: a map of format {found}, but this version reads {FORMAT}; prepare it again"
            )
        octree = Octree(
            nodes=members["octree_nodes"],
            first_child=members["octree_first_child"],
            level_start=members["octree_level_start"],
            leaf_size=float(members["octree_leaf_size"]),
        )
        warnings = tuple(str(line) for line in members["warnings"])
        return ScanMap(octree=octree, warnings=warnings, **{name: members[name] for name in ARRAYS})
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: found {error}, wanted a whole map by tools/prepare_map.py") from error
