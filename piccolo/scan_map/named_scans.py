"""Maps of several scans, buildings or storeys: their names, and the one in which a pose lies."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array, Mask
from ..confidence.localization import Localization
from ..errors import InputError
from ..geometry.pose import Pose
from .scan_map import ScanMap

MAX_NAME = 100  # characters
MAX_SCANS = 1000  # of a map


def is_name(name: str) -> bool:
    """Return True for one line of text that can be printed."""
    return 1 <= len(name) <= MAX_NAME and name.isprintable() and name == name.strip()


def check_name(name: str, taken: Sequence[str]) -> None:
    """Refuse an invalid or duplicate name of a scan, or one scan too many."""
    if not is_name(name):
        raise InputError(f"`name`: found {name[:200]!r}, wanted 1 to {MAX_NAME} printable characters")
    if name in taken:
        raise InputError(f"`name`: found {name!r}, which the map has already: {_list_names(taken)}")
    if len(taken) >= MAX_SCANS:
        raise InputError(f"`add`: found a map of {len(taken)} scans, the most that one holds")


def name_scan(scan_map: ScanMap, name: str) -> ScanMap:
    """Name the scan of a map of one scan."""
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
    named_so = [k for k, name in enumerate(scan_map.scan_names) if name in within]
    return np.isin(scan_map.scan_of_candidate, named_so)


def find_scan_at(scan_map: ScanMap, center_map: Array) -> str | None:
    """Return the scan in which a place (3,) lies, by the nearest candidate; None if there are no names."""
    if not (scan_map.scan_names and len(scan_map.centers)):
        return None
    offsets = scan_map.centers - center_map
    nearest = np.einsum("ij,ij->i", offsets, offsets).argmin()
    return scan_map.scan_names[int(scan_map.scan_of_candidate[nearest])]


def add_places(scan_map: ScanMap, found: Localization) -> Localization:
    """Return a result with the scans, the storey (from 1, the lowest) and the height above the floor."""
    pose = found.pose
    if pose is None:
        return found
    (storey,), (height,) = scan_map.storeys.at(scan_map.from_world(pose).center_world[None])
    if storey >= 0:
        found = replace(found, storey=int(storey) + 1, height_above_floor=round(float(height), 4))
    if not scan_map.scan_names:
        return found

    alternatives = tuple(replace(a, scan=scan_of(scan_map, a.pose)) for a in found.alternatives)
    return replace(found, scan=scan_of(scan_map, pose), alternatives=alternatives)


def scan_of(scan_map: ScanMap, pose: Pose) -> str | None:
    """Return the scan in which a pose of the world lies."""
    return find_scan_at(scan_map, scan_map.from_world(pose).center_world)
