"""Places of poses in words: the scan, the storey, the height above its floor."""

from dataclasses import replace

from ..judge.result import Result
from ..scan_map.scan_map import ScanMap, scan_of


def add_places(scan_map: ScanMap, found: Result) -> Result:
    """Return a result with the scans, the storey (from 1, the lowest) and the height above the floor."""
    pose = found.best_pose
    if pose is None:
        return found
    (storey,), (height,) = scan_map.storeys.at(scan_map.from_world(pose).center_world[None])
    if storey >= 0:
        found = replace(found, storey=int(storey) + 1, height_above_floor=round(float(height), 4))
    if not scan_map.scan_names:
        return found

    alternatives = tuple(replace(a, scan=scan_of(scan_map, a.pose)) for a in found.alternatives)
    return replace(found, scan=scan_of(scan_map, pose), alternatives=alternatives)
