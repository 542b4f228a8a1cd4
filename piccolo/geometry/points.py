"""Points as kernels read them: structure of arrays, colours packed."""

from dataclasses import dataclass

import numpy as np

from ..system.arrays import Array, Array32, Bytes, Int32s, Integers
from ..system.errors import InputError
from .colors import pack_rgbx
from .pose import Pose, multiply, rotate_vector

FARTHEST_POINT = 1e7  # [m] from the local origin; squares stay finite in float32 and the loss is inf beyond


@dataclass(frozen=True)
class PackedPoints:
    """Coloured points, one contiguous array a coordinate, in the order in which they are to be summed."""

    x: Array32  # (N,) [m]
    y: Array32  # (N,) [m]
    z: Array32  # (N,) [m]
    rgbx: Int32s  # (N,) as pack_rgbx

    def __len__(self) -> int:
        return len(self.x)

    def stack(self) -> Array32:
        """Return the positions (N, 3) [m]."""
        return np.stack([self.x, self.y, self.z], axis=1)

    def take(self, indices: Integers | slice) -> "PackedPoints":
        """Return the points at `indices`, in that order."""
        return PackedPoints(self.x[indices], self.y[indices], self.z[indices], self.rgbx[indices])

    def subsample(self, count: int) -> "PackedPoints":
        """Return at most `count` points, evenly spread in space if they are in Morton order."""
        if len(self) <= count:
            return self
        return self.take(np.linspace(0, len(self) - 1, count).astype(np.int64))


@dataclass(frozen=True)
class MapFrame:
    """A frame near the points, z up: x_map = R_map_from_world (x_world - origin_world)."""

    R_map_from_world: Array  # (3, 3) turns the axis that points up to z; identity where z is up
    origin_world: Array  # (3,) [m] in whole metres along the map's axes

    def from_world(self, pose: Pose) -> Pose:
        """Transform a pose of the world to this frame; InputError if it is too far away for float32."""
        center_world = pose.center_world
        if not np.abs(center_world - self.origin_world).max() < FARTHEST_POINT:
            found = f"found a camera at {center_world.tolist()}"
            raise InputError(f"{found}, wanted one within {FARTHEST_POINT:.0e} m of the cloud")
        R = self.R_map_from_world
        center_map = rotate_vector(R, center_world - self.origin_world)
        return Pose(multiply(pose.R_cam_from_world, R.T), center_map)

    def to_world(self, pose: Pose) -> Pose:
        """Transform a pose of this frame to the world."""
        R = self.R_map_from_world
        center_world = rotate_vector(R.T, pose.center_world) + self.origin_world
        return Pose(multiply(pose.R_cam_from_world, R), center_world)


@dataclass(frozen=True)
class LocalCloud(MapFrame):
    """The points of a cloud."""

    points: PackedPoints  # in this frame
    warnings: tuple[str, ...]


def pack_points(points: Array32, colors: Bytes) -> PackedPoints:
    """Pack points (N, 3) [m] with colours (N, 3)."""
    x, y, z = np.ascontiguousarray(points.T, dtype=np.float32)
    return PackedPoints(x, y, z, pack_rgbx(colors))
