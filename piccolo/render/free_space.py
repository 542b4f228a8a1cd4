"""Whether a camera could stand at a position: away from surfaces, and inside the scan."""

import math

import numpy as np

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose
from ..geometry.sphere import solid_angles
from .zbuffer import nearest_depth

MIN_SEEN_FRACTION = 0.4  # of the sphere; less is seen from outside a scan


def is_free_space(points: PackedPoints, center: Array, width: int, min_clearance: float) -> bool:
    """True if no point is within `min_clearance` [m] of `center` (3,), and points are seen all around.

    Both follow from the nearest range in each cell of an equirectangular view `width` cells wide.
    """
    depth = nearest_depth(points, Pose(np.eye(3), center), width).reshape(-1, width)
    seen = np.isfinite(depth).sum(axis=1) @ solid_angles(width) / (4.0 * math.pi)
    return bool(depth.min() > min_clearance and seen > MIN_SEEN_FRACTION)
