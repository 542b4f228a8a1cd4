"""The direction of the dominant walls."""

import numpy as np

from ..geometry.pose import Array
from .planes import Plane

PEAK_ANGLE = np.radians(8.0)  # of a wall to those averaged with it, modulo a quarter turn; as KIND_ANGLE


def manhattan_yaw(planes: list[Plane], R_level_from_scan: Array) -> float | None:
    """The smallest turn about z [rad], in (-45, 45] deg, that puts the dominant walls along x and y.

    None without walls. Walls a quarter turn apart count as one direction, the larger ones for more.
    """
    walls = [plane for plane in planes if plane.kind == "wall"]
    if not walls:
        return None
    normals = np.array([R_level_from_scan @ wall.normal_world for wall in walls])
    weights = np.array([wall.fraction for wall in walls])
    # four times the azimuth is the same for all four directions of a rectangle
    phases = np.exp(4j * np.arctan2(normals[:, 1], normals[:, 0]))
    is_near = np.abs(np.angle(phases[:, None] / phases)) < 4.0 * PEAK_ANGLE
    peak = int((is_near * weights).sum(axis=1).argmax())
    mean = np.sum(weights[is_near[peak]] * phases[is_near[peak]])
    turn = -0.25 * float(np.angle(mean))
    return turn + 0.5 * np.pi if turn <= -0.25 * np.pi else turn
