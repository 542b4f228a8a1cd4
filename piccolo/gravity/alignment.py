"""The transform that turns a scan upright: vertical and walls by its planes, up by word or by evidence."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..cloud import CloudStream
from ..cloud.octree import Octree, build_octree
from ..cloud.settings import R_z_from_axis, UpAxis
from ..geometry.pose import Array, orthonormal, rotation_to_z, yaw_rotation
from .planes import SPACING, Planes, dot, estimate_normals, ransac_planes
from .sense import LEVEL_ANGLE, find_sense

MAX_LEAN = np.radians(15.0)  # of the vertical to a direction that is said to be up
SNAP_ANGLE = np.radians(0.2)  # of the vertical to such a direction that is then taken itself
AGREE_ANGLE = np.radians(3.0)  # of a plane to level or upright, that counts for the vertical
MIN_ALIGNED = 0.6  # fraction of the planes' area that is level or upright: roofs are neither
MAX_FLATNESS = 0.75  # height to the lesser width of a scan, above which a wall may be its floor
# up (3,) by a photo in the scan turned by its vertical (3,), None if it isn't localized; and why
FindByPhoto = Callable[[Array], tuple[Array | None, str]]


class Alignment(NamedTuple):
    """A rigid transform of a scan, and what it is based on."""

    T_aligned_from_scan: Array  # (4, 4) [m], about the middle of the cloud's box in whole metres
    up_scan: Array | None  # (3,) unit; None where it isn't known
    reason: str  # one line
    yaw: float | None  # turn about z that puts the dominant walls along x and y [rad]; None without walls
    warnings: tuple[str, ...]


def find_alignment(
    cloud: CloudStream, up: UpAxis | None, find_by_photo: FindByPhoto | None, along_walls: bool
) -> Alignment:
    """Return the least turn that makes z up, and with `along_walls` the least further one about z.

    Up is told by a photo; or by a named axis, but for the file's own (`auto`) where plain evidence is against
    it; or, with None, by the scanners' poses or plain evidence.
    """
    voxels = cloud.voxels(np.eye(3))
    axis, sense, reason, planes = find_up(build_octree(voxels))
    scanners = cloud.station_axes
    said: Array | None = sense * axis if sense else None
    if find_by_photo:
        said, reason = find_by_photo(axis)
    elif up:
        named = R_z_from_axis(up, cloud.up)[2]
        if up == "auto" and said is not None and said @ named < np.cos(MAX_LEAN):
            said, reason = None, f"the floors do not face {cloud.up}, by their {reason}"
        else:
            said, reason = named, "up is the named axis"
    elif len(scanners) and dot(scanners, scanners[0]).min() > np.cos(MAX_LEAN):
        said, reason = scanners[0], "the scanners stood upright"
    up_scan = None if said is None else level(planes, said)
    R = np.eye(3) if up_scan is None else rotation_to_z(up_scan)
    yaw = wall_yaw(planes, R) if along_walls else None
    T = np.eye(4)
    T[:3, :3] = orthonormal(R if yaw is None else yaw_rotation(-yaw) @ R) + 0.0
    T[:3, 3] = voxels.origin - np.einsum("ij,j->i", T[:3, :3], voxels.origin) + 0.0
    return Alignment(T, up_scan, reason, yaw, voxels.warnings)


def find_up(octree: Octree) -> tuple[Array, float, str, Planes]:
    """Return a scan's vertical (3,), the sign of up along it or 0 if that is not plain, why, and the planes.

    The vertical is square to the largest area, and along it the scan is lower than it is wide.
    """
    cloud = estimate_normals(octree.level(SPACING)[:, :3])
    planes = ransac_planes(cloud)
    if not len(planes.areas):
        return np.array([0.0, 0.0, 1.0]), 0.0, "there are no dominant planes", planes
    level_areas, aligned_areas = _areas_by(planes)
    largest = int(level_areas.argmax())
    axis = _refine(planes, planes.normals[largest])
    places = np.einsum("ni,ji->nj", cloud.points, np.linalg.svd(axis[None])[2][1:])
    across = places @ np.linalg.eigh(np.cov(places.T))[1][:, 0]
    height, width = (np.ptp(np.quantile(x, [0.01, 0.99])) for x in (dot(cloud.points, axis), across))
    if aligned_areas[largest] < MIN_ALIGNED:
        return axis, 0.0, "too many planes are neither level nor upright", planes
    if height > MAX_FLATNESS * width:
        return axis, 0.0, f"{height:.1f} m high and {width:.1f} m wide, a wall may be the floor", planes
    return axis, *find_sense(cloud, planes, axis), planes


def level(planes: Planes, said: Array) -> Array:
    """Return the vertical (3,) near a direction that is said to be up; that itself if none is, or it fits."""
    is_near = np.abs(dot(planes.normals, said)) > np.cos(MAX_LEAN)
    is_vertical = is_near & (_areas_by(planes)[1] > MIN_ALIGNED)
    if not is_vertical.any():
        return said
    axis = _refine(planes, planes.normals[is_vertical.argmax()])
    cosine = float(axis @ said)
    return said if abs(cosine) > np.cos(SNAP_ANGLE) else axis * np.sign(cosine)


def _areas_by(planes: Planes) -> tuple[Array, Array]:
    """Return what fraction of the planes' area is level, and level or upright, by the normal of each (P,)."""
    cosines = np.abs(planes.normals @ planes.normals.T)
    areas = planes.areas / planes.areas.sum()
    is_level = cosines > np.cos(LEVEL_ANGLE)
    return is_level @ areas, (is_level | (cosines < np.sin(LEVEL_ANGLE))) @ areas


def _refine(planes: Planes, axis: Array) -> Array:
    """Return the vertical (3,) by least squares on the planes that are nearly level or upright."""
    cosines = np.abs(dot(planes.normals, axis))
    signs = 1.0 * (cosines < np.sin(AGREE_ANGLE)) - (cosines > np.cos(AGREE_ANGLE))
    spread = np.einsum("n,ni,nj->ij", signs * planes.areas, planes.normals, planes.normals)
    return np.asarray(np.linalg.eigh(spread)[1][:, 0])


def wall_yaw(planes: Planes, R_level_from_scan: Array) -> float | None:
    """Return the smallest turn about z [rad], in (-45, 45] deg, that puts dominant walls along x and y."""
    x, y, z = R_level_from_scan @ planes.normals.T
    is_wall = np.abs(z) < np.sin(LEVEL_ANGLE)
    if not is_wall.any():
        return None
    k = (is_wall * _areas_by(planes)[1]).argmax()  # a wall to which most others are parallel or square
    turns = -np.arctan2(y[k], x[k]) / (0.5 * np.pi)
    return float(turns - np.ceil(turns - 0.5)) * 0.5 * np.pi
