"""A prepared map on disk: a NumPy archive, and the cache of such files.

A file of another format, or damaged in any byte (each member of an archive has a checksum), is never trusted;
`map_validation.py` checks what is whole.
FORMAT changes with what the arrays mean, so that a file outlives an update; the cache also knows the sources
by which a map was made, and makes it anew when they have changed.
"""

import math
import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..cloud.octree import Octree
from ..cloud.readers.npz import damage_named
from ..errors import InputError
from ..local_features.feature_map import FeatureMap
from ..runtime.atomic import replacing
from .map_validation import LAYOUT, check_arrays, clean_warnings
from .scan_map import ScanMap

FORMAT = "piccolo-map/4"
OTHERS = ("octree", "local_features", "warnings", "crs", "is_partial")
ARRAYS = [f.name for f in fields(ScanMap) if f.name not in OTHERS]
MEMBERS = {*LAYOUT, "format", "warnings"}
WANTED = "wanted a whole map by tools/prepare_map.py"
ZIP_MAGIC = b"PK\x03\x04"
# The first member of a map: its name and where that stands, and the beginning of its value somewhere behind.
FIRST_NAME, FIRST_NAME_AT = b"format.npy", 30
FIRST_VALUE, FIRST_VALUE_WITHIN = FORMAT.partition("/")[0].encode("utf-32-le"), 512


def save_map(scan_map: ScanMap, path: Path) -> None:
    """Write a map to `path`, whole or not at all."""
    members = {name: getattr(scan_map, name) for name in ARRAYS}
    for label, part in (("octree", scan_map.octree), ("local", scan_map.local_features)):
        members.update({f"{label}_{name}": value for name, value in part._asdict().items()})
    with replacing(path) as file:
        np.savez(
            file,
            format=np.array(FORMAT),
            warnings=np.array(scan_map.warnings, dtype=np.str_),
            crs=np.frombuffer(scan_map.crs.encode(), np.uint8),
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
    """Read what `save_map` wrote; InputError for anything else, before more is read than the file holds."""
    with damage_named(path, WANTED), path.open("rb") as file, zipfile.ZipFile(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        size = sum(info.file_size for info in archive.infolist())
        if size > path.stat().st_size:
            raise ValueError(f"arrays of {size} bytes")
        if "format" in members and (found := str(_read(archive, members["format"]))) != FORMAT:
            text = f"a map of format {found[:40]!r}, but this version reads {FORMAT}; prepare it again"
            raise InputError(f"{path}: {text}")
        if set(members) != MEMBERS or len(archive.infolist()) != len(MEMBERS):
            raise ValueError(f"not the arrays of a map: {sorted(MEMBERS ^ set(members))}")
        arrays = {name: _read(archive, info) for name, info in members.items()}
        check_arrays(path, arrays)
        warnings = clean_warnings(path, arrays["warnings"])
    own: dict[str, Any] = {name: arrays[name] for name in ARRAYS if name not in ("has_labels", "scan_sha256")}
    return ScanMap(
        octree=Octree(
            nodes=arrays["octree_nodes"],
            first_child=arrays["octree_first_child"],
            level_start=arrays["octree_level_start"],
            leaf_size=float(arrays["octree_leaf_size"]),
        ),
        local_features=FeatureMap(*(arrays[f"local_{name}"] for name in FeatureMap._fields)),
        has_labels=bool(arrays["has_labels"]),
        warnings=warnings,
        scan_sha256=str(arrays["scan_sha256"]),
        crs=arrays["crs"].tobytes().decode(),
        **own,
    )


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """The array in a member as `np.savez` writes it: not compressed, and as long as its header says."""
    with archive.open(info) as member, catch_warnings():
        simplefilter("error")  # NumPy warns of headers that it had to mend
        if info.compress_type != zipfile.ZIP_STORED or npy.read_magic(member) != (1, 0):
            raise ValueError(f"{info.filename} in another way than NumPy's savez has it")
        shape, is_fortran, dtype = npy.read_array_header_1_0(member)
        promised, found = math.prod(shape) * dtype.itemsize, info.file_size - member.tell()
        if is_fortran or dtype.hasobject or promised != found:
            raise ValueError(f"{info.filename} of {found} bytes, which promises {dtype} of shape {shape}")
        member.seek(0)
        return np.asarray(npy.read_array(member, allow_pickle=False))
