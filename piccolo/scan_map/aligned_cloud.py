"""A cloud turned so that the axis which its file or the user names is z, as an octree."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..cloud.octree import Octree, build_octree
from ..cloud.settings import R_z_from_axis, UpAxis
from ..cloud.voxels import Voxels
from ..geometry.pose import Array
from ..gravity.alignment import find_up

MAX_TILT = np.radians(5.0)  # of what seems to be up to what is taken for it, that goes without saying


class Voxelized(Protocol):
    """A cloud in memory, or in files that are read anew."""

    @property
    def up(self) -> UpAxis:
        """The axis that points up by its file."""

    def voxels(self, R_map_from_world: Array) -> Voxels:
        """Its points averaged voxel by voxel, in axes turned by a rotation (3, 3)."""


@dataclass(frozen=True)
class AlignedCloud:
    """A cloud as an octree with z up; the other fields as in ScanMap."""

    octree: Octree
    R_map_from_world: Array
    origin_world: Array
    warnings: tuple[str, ...]


def read_aligned(cloud: Voxelized, up: UpAxis | Array) -> AlignedCloud:
    """A cloud as octree: a named axis is up, with `auto` the file's; or a rotation (3, 3) makes z up."""
    R_map_from_world = R_z_from_axis(up, cloud.up) if isinstance(up, str) else up
    voxels = cloud.voxels(R_map_from_world)
    octree = build_octree(voxels)
    origin_world = R_map_from_world.T @ voxels.origin
    is_doubtful = isinstance(up, str) and up == "auto"
    doubts = doubts_about_up(octree, R_map_from_world, cloud.up) if is_doubtful else ()
    return AlignedCloud(octree, R_map_from_world, origin_world, voxels.warnings + doubts)


def doubts_about_up(octree: Octree, R_map_from_world: Array, taken: UpAxis) -> tuple[str, ...]:
    """A line if the floors plainly face another way than the map's z, with the axis nearest to their way."""
    axis, sense, reason, _ = find_up(octree)
    cosine = sense * axis[2]
    if sense == 0.0 or cosine > np.cos(MAX_TILT):
        return ()
    up_world = R_map_from_world.T @ (sense * axis)
    k = int(np.abs(up_world).argmax())
    nearest = f"{'-' if up_world[k] < 0.0 else ''}{'xyz'[k]}"
    angle = np.degrees(np.arccos(max(cosine, -1.0)))
    text = f"the floors face {angle:.0f} deg away from {taken}, which is taken for up ({reason})"
    return (f"{text}; set up={nearest}, or turn the scan by tools/align_gravity.py",)
