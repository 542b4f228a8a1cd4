"""A coloured point cloud in memory."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.point_transforms import rotate_points
from .voxels import Voxels, VoxelTable


@dataclass(frozen=True)
class Cloud:
    """Coloured points near a local origin, in an order that does not depend on the file's."""

    points: NDArray[np.float32]  # (N, 3) world minus origin_world [m], all finite, Morton order
    colors: NDArray[np.uint8]  # (N, 3) RGB
    origin_world: NDArray[np.float64]  # (3,) what was subtracted from the file's coordinates [m]
    num_dropped: int = 0  # points with NaN or infinite coordinates, left out
    warnings: tuple[str, ...] = ()  # one line each, for the user

    def voxels(self, R_map_from_world: NDArray[np.float64]) -> Voxels:
        """The points averaged voxel by voxel, in axes turned by a rotation (3, 3)."""
        table = VoxelTable("cloud")
        table.add(rotate_points(self.points + self.origin_world, R_map_from_world), self.colors)
        voxels = table.finish()
        return Voxels(voxels.codes, voxels.nodes, voxels.origin, self.warnings + voxels.warnings)
