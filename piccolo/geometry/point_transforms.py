"""Points turned and moved, term by term: BLAS sums in an order that depends on how many points there are."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotate_points(points: Array, R_target_from_source: Array) -> Array:
    """Points (N, 3) under a rotation (3, 3); the same array under the identity."""
    if np.array_equal(R_target_from_source, np.eye(3)):
        return points
    x, y, z = points.T
    return np.stack([a * x + b * y + c * z for a, b, c in R_target_from_source], axis=1)


def transform_points(points: Array, T_target_from_source: Array) -> Array:
    """Points (N, 3) under an affine transform (4, 4) for column vectors."""
    x, y, z = points.T
    return np.stack([a * x + b * y + c * z + d for a, b, c, d in T_target_from_source[:3]], axis=1)
