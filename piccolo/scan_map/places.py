"""What was found, with the scan, the storey and the height above the floor at which it lies."""

from dataclasses import replace

from ..confidence.localization import Localization
from .named_scans import with_scans
from .scan_map import ScanMap


def with_places(scan_map: ScanMap, found: Localization) -> Localization:
    """What was found, with where it lies; storeys count from 1, the lowest."""
    if found.pose is None:
        return found
    center = scan_map.from_world(found.pose).center_world
    (storey,), (height,) = scan_map.storeys.at(center[None])
    if storey >= 0:
        found = replace(found, storey=int(storey) + 1, height_above_floor=round(float(height), 4))
    return with_scans(scan_map, found)
