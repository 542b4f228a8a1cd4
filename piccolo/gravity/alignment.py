"""The transform that turns a cloud's z up, and what it is based on."""

from dataclasses import dataclass, replace

import numpy as np

from ..cloud import CloudStream
from ..cloud.octree import build_octree
from ..cloud.settings import UpAxis
from ..cloud.voxels import Voxels
from ..geometry.pose import Array, orthonormal, yaw_rotation
from .alignment_file import Alignment
from .manhattan import manhattan_yaw
from .normals import PointNormals, estimate_normals
from .planes import Plane, classify_planes, ransac_planes, refine_up
from .up import Up, find_up, named_axis, rotation_to_z_up

SPACING = 0.08  # of the points used [m]
NO_CONVENTION = 0.0  # log-odds of z up: a scan that is to be aligned may lie anyhow


@dataclass(frozen=True)
class AlignmentReport:
    """An alignment with the evidence for it."""

    alignment: Alignment
    up_scan: Array  # (3,) unit vector that points up, in the scan's frame
    plane_rms_angle: float | None  # of level and upright planes to up [rad]
    yaw: float | None  # turn about z that put the walls along the axes [rad]
    planes: list[Plane]  # in the scan's frame, metres


def find_alignment(
    cloud: CloudStream, up: UpAxis, along_walls: bool
) -> tuple[AlignmentReport, tuple[str, ...]]:
    """The turn of a cloud that makes z up, about the middle of its box in whole metres; and warnings.

    An axis given as `up` is taken as it is; `auto` finds it. With `along_walls` the dominant walls come to
    stand along x and y by the smallest turn about z.
    """
    voxels = cloud.voxels(np.eye(3))
    sample = normals_of(voxels)
    planes = ransac_planes(sample)
    if up == "auto":
        found = find_up(sample, NO_CONVENTION)
        direction, rms_angle = refine_up(found.direction_world, planes)
    else:
        found, rms_angle = Up(named_axis(up), 1.0, f"up is the axis {up}, as given"), None
        direction = found.direction_world
    planes = classify_planes(planes, sample, direction)
    R = rotation_to_z_up(direction)
    yaw = manhattan_yaw(planes, R) if along_walls else None
    if yaw is not None:
        R = np.einsum("ij,jk->ik", yaw_rotation(-yaw), R)
    T = _rotation_about(voxels.origin, orthonormal(R))
    alignment = Alignment(T, 1.0, found.confidence, found.reason).in_unit(cloud.scale)
    in_scan = [
        replace(plane, offset=plane.offset + float(np.einsum("i,i->", plane.normal_world, voxels.origin)))
        for plane in planes
    ]
    return AlignmentReport(alignment, direction, rms_angle, yaw, in_scan), voxels.warnings


def normals_of(voxels: Voxels) -> PointNormals:
    """Normals of a cloud thinned to SPACING."""
    return estimate_normals(build_octree(voxels).level(SPACING)[:, :3])


def _rotation_about(origin: Array, R: Array) -> Array:
    """The transform (4, 4) that turns by R (3, 3) about a point (3,)."""
    T = np.eye(4)
    T[:3, :3] = R + 0.0
    T[:3, 3] = origin - np.einsum("ij,j->i", R, origin) + 0.0
    return T
