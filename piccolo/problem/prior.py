"""The user's prior knowledge of a photo's pose, which leaves fewer positions and rotations to search."""

import numpy as np

from ..photo.photo import Prior
from ..scan_map.camera_positions import COARSE_SPACING, Ball, heights_above_floor
from ..scan_map.scan_map import ScanMap, candidates_within
from ..system.arrays import Array, Mask


def allow_by_option(scan_map: ScanMap, prior: Prior) -> dict[str, Mask]:
    """Return the mask (N,) of candidates that each option allows, with a margin of half a grid spacing."""
    allowed: dict[str, Mask] = {}
    if prior.near is not None and prior.radius is not None:
        allowed["`near`"] = distances_to(scan_map, prior.near) <= prior.radius + COARSE_SPACING / 2
    if prior.height is not None:
        heights = heights_above_floor(scan_map.octree, scan_map.centers)
        low, high = prior.height
        is_high_enough = heights >= low - COARSE_SPACING / 2
        allowed["`height`"] = is_high_enough & (heights <= high + COARSE_SPACING / 2)
    if prior.within:
        allowed["`within`"] = candidates_within(scan_map, prior.within)
    return allowed


def ball_of(prior: Prior) -> Ball | None:
    """Return the ball, in the world, in which the camera was; None if the prior names none with a z."""
    if prior.near is None or prior.near[2] is None or prior.radius is None:
        return None
    return Ball(np.array(prior.near, float), prior.radius)


def distances_to(scan_map: ScanMap, near: tuple[float, float, float | None]) -> Array:
    """Return the distance (N,) [m] of each candidate from a place of the world; horizontal if z is None."""
    x, y, z = near
    centers_world = scan_map.centers @ scan_map.R_map_from_world + scan_map.origin_world
    offsets = centers_world[:, :2] - (x, y) if z is None else centers_world - (x, y, z)
    return np.asarray(np.linalg.norm(offsets, axis=1))


def nothing_allowed(scan_map: ScanMap, prior: Prior) -> str:
    """Return a warning that no candidate is left: how many each option allows, and the one nearest."""
    num = len(scan_map.centers)
    if num == 0:
        return "the scan: found no place for a camera (free space 0.3 to 2.4 m above a surface, closed in)"
    counts = [f"{name} allows {mask.sum()}" for name, mask in allow_by_option(scan_map, prior).items()]
    text = f"no position is left of the scan's {num}: {', '.join(counts)}"
    if prior.near is None:
        return text
    distances = distances_to(scan_map, prior.near)
    k = int(distances.argmin())
    x, y, z = scan_map.R_map_from_world.T @ scan_map.centers[k] + scan_map.origin_world
    return f"{text}; the nearest to `near` is {x:.2f} {y:.2f} {z:.2f}, {distances[k]:.2f} m away"


def apply_prior(scan_map: ScanMap, prior: Prior) -> ScanMap:
    """Return the map with only those cells of the coarse grid where the prior allows a candidate."""
    is_allowed = np.ones(len(scan_map.centers), dtype=bool)
    for mask in allow_by_option(scan_map, prior).values():
        is_allowed &= mask
    if is_allowed.all():
        return scan_map
    return scan_map.narrow(np.isin(scan_map.sparse, scan_map.searched_for[is_allowed]))


def allow_rotations(R_cam_from_world: Array, prior: Prior) -> Array:
    """Return those of some rotations (N, 3, 3) whose heading the prior allows.

    If it allows none, those with the nearest heading are returned. Rotations are from the world's axes.
    """
    if prior.heading_deg is None:
        return R_cam_from_world
    off = heading_errors(R_cam_from_world, prior.heading_deg)
    return np.asarray(R_cam_from_world[off <= max(np.radians(prior.tolerance_deg), float(off.min()))])


def heading_errors(R_cam_from_world: Array, heading_deg: float) -> Array:
    """Return the angles (N,) [rad] between a heading and the image centres of rotations (N, 3, 3)."""
    forward = R_cam_from_world[:, 0]  # of the camera's +x, in the world
    heading = np.arctan2(forward[:, 0], forward[:, 1])
    return np.asarray(np.abs((heading - np.radians(heading_deg) + np.pi) % (2.0 * np.pi) - np.pi))
