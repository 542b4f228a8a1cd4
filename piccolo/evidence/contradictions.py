"""Contradictions between a pose and the prior knowledge of it."""

import math

from ..geometry.pose import MAX_ANGLE, MAX_DISTANCE, Pose
from ..judge.reasons import Contradiction, Reason
from ..photo.photo import Prior
from ..problem.prior import heading_errors
from ..scan_map.camera_positions import heights_above_floor
from ..scan_map.scan_map import ScanMap, find_scan_at

STEEP = 0.2  # cosine of an elevation: a camera that looks up or down more steeply has no heading


def contradictions(scan_map: ScanMap, pose: Pose, prior: Prior) -> tuple[Contradiction, ...]:
    """List how a pose of the map's frame contradicts the prior by more than a right pose may be off."""
    if prior.is_empty:
        return ()
    world = scan_map.to_world(pose)
    found: list[Contradiction] = []
    if prior.within and (scan := find_scan_at(scan_map, pose.center_world)) not in prior.within:
        found.append(Contradiction(Reason.WITHIN, scan, ", ".join(map(repr, prior.within))))
    if prior.near is not None and prior.radius is not None:
        given = [value for value in prior.near if value is not None]
        gap = math.dist(world.center_world[: len(given)], given)
        if gap > prior.radius + MAX_DISTANCE:
            found.append(Contradiction(Reason.NEAR, gap, (prior.radius,)))
    if prior.height is not None:
        height = float(heights_above_floor(scan_map.octree, pose.center_world[None])[0])
        low, high = prior.height
        if not low - MAX_DISTANCE <= height <= high + MAX_DISTANCE:
            found.append(Contradiction(Reason.HEIGHT, height, prior.height))
    return (*found, *find_contradicted_heading(world, prior))


def find_contradicted_heading(pose_world: Pose, prior: Prior) -> list[Contradiction]:
    """Return how a pose contradicts a given heading; a camera that looks steeply up or down has none."""
    forward = pose_world.R_cam_from_world[0]
    if prior.heading_deg is None or math.hypot(forward[0], forward[1]) < STEEP:
        return []
    off = math.degrees(float(heading_errors(pose_world.R_cam_from_world[None], prior.heading_deg)[0]))
    if off <= prior.tolerance_deg + math.degrees(MAX_ANGLE):
        return []
    return [Contradiction(Reason.HEADING, off, (prior.tolerance_deg,))]
