"""A cloud turned so that up is z, as an octree; read once, also by a process that goes on for another."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..cloud.octree import Octree, build_octree
from ..cloud.settings import UpAxis
from ..cloud.voxels import Voxels
from ..geometry.pose import Array
from ..gravity import MIN_CONFIDENCE, R_z_from_axis, estimate_normals, find_up, rotation_to_z_up
from ..runtime.unfinished import Unfinished

MIN_TILT = np.radians(5.0)  # a cloud whose up is nearer to its z is taken as it is


def align_to_gravity(octree: Octree) -> tuple[Array, tuple[str, ...]]:
    """Rotation (3, 3) that turns the cloud's up to +z, identity if it is there or in doubt; warnings."""
    up = find_up(estimate_normals(octree.level(0.08)[:, :3]))
    tilt = np.arccos(np.clip(up.direction_world[2], -1.0, 1.0))
    if tilt < MIN_TILT:
        return np.eye(3), ()
    text = f"the cloud's z is {np.degrees(tilt):.0f} deg off its up direction"
    if up.confidence < MIN_CONFIDENCE:
        return np.eye(3), (f"perhaps {text} (confidence {up.confidence:.2f}); z is kept, --up sets another",)
    return rotation_to_z_up(up.direction_world), (f"{text}; levelled by its own planes",)


class Voxelized(Protocol):
    """A cloud in memory, or in files that are read anew."""

    def voxels(self, R_map_from_world: Array) -> Voxels:
        """Its points averaged voxel by voxel, in axes turned by a rotation (3, 3)."""


@dataclass(frozen=True)
class AlignedCloud:
    """A cloud as an octree with z up; the other fields as in ScanMap."""

    octree: Octree
    R_map_from_world: Array
    origin_world: Array
    warnings: tuple[str, ...]


def read_aligned(cloud: Voxelized, up: UpAxis) -> AlignedCloud:
    """A cloud whose axis `up` points up, as octree; `auto` asks the cloud, and reads a tilted one anew."""
    more: tuple[str, ...] = ()
    R_map_from_world = R_z_from_axis(up)
    voxels = cloud.voxels(R_map_from_world)
    octree = build_octree(voxels)
    if up == "auto":
        R_map_from_world, more = align_to_gravity(octree)
        if not np.array_equal(R_map_from_world, np.eye(3)):
            del voxels, octree  # their room is needed
            voxels = cloud.voxels(R_map_from_world)
            octree = build_octree(voxels)
    origin_world = R_map_from_world.T @ voxels.origin
    return AlignedCloud(octree, R_map_from_world, origin_world, voxels.warnings + more)


def read_once(cloud: Voxelized, up: UpAxis, work: Unfinished | None) -> AlignedCloud:
    """The same, or what a process that was killed has read."""
    stage = (work or Unfinished()).stage("read", ())
    stage.read()
    if not stage.done:
        a = read_aligned(cloud, up)
        leaf_size, warnings = np.array(a.octree.leaf_size), np.array(a.warnings, np.str_)
        stage.add((*a.octree[:3], leaf_size, a.R_map_from_world, a.origin_world, warnings))
    nodes, first_child, level_start, leaf_size, R_map_from_world, origin_world, warnings = stage.done[0]
    octree = Octree(nodes, first_child, level_start, float(leaf_size))
    return AlignedCloud(octree, R_map_from_world, origin_world, tuple(map(str, warnings)))
