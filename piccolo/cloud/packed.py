"""The points as kernels read them: structure of arrays, colours packed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PackedPoints:
    """Coloured points, one contiguous array a coordinate, in the order in which they are to be summed."""

    x: NDArray[np.float32]  # (N,) [m]
    y: NDArray[np.float32]  # (N,) [m]
    z: NDArray[np.float32]  # (N,) [m]
    rgbx: NDArray[np.int32]  # (N,) as piccolo.sampling.pack_rgbx

    def __len__(self) -> int:
        """How many points there are."""
        return len(self.x)

    def take(self, indices: NDArray[np.integer] | slice) -> "PackedPoints":
        """The points at `indices`, in that order."""
        return PackedPoints(self.x[indices], self.y[indices], self.z[indices], self.rgbx[indices])


def pack_points(points: NDArray[np.float32], colors: NDArray[np.uint8]) -> PackedPoints:
    """Points (N, 3) [m] with colours (N, 3) as PackedPoints."""
    x, y, z = np.ascontiguousarray(points.T, dtype=np.float32)
    rgbx = np.ones((len(points), 4), dtype=np.uint8)
    rgbx[:, :3] = colors
    return PackedPoints(x, y, z, rgbx.view("<i4")[:, 0].astype(np.int32, copy=False))
