"""What a reader hands on: a file's points as they stand there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class RawCloud:
    """Points in the file's order and unit, not yet checked."""

    points_world: NDArray[np.float64]  # (N, 3) in the file's unit, maybe NaN or infinite
    colors: NDArray[np.uint8]  # (N, 3) RGB
