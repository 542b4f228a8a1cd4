"""A coloured point cloud in memory."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Cloud:
    """Coloured points near a local origin, in an order that does not depend on the file's."""

    points: NDArray[np.float32]  # (N, 3) world minus origin_world [m], all finite, Morton order
    colors: NDArray[np.uint8]  # (N, 3) RGB
    origin_world: NDArray[np.float64]  # (3,) what was subtracted from the file's coordinates [m]
    num_dropped: int = 0  # points with NaN or infinite coordinates, left out
    warnings: tuple[str, ...] = ()  # one line each, for the user
