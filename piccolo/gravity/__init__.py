"""Which way is up in a cloud, which planes it has, and along which directions its walls stand."""

from .manhattan import wall_yaw, yaw_turn
from .normals import Surfaces, surfaces_of
from .planes import Plane, find_planes, name_planes, refine_up
from .up import MIN_CONFIDENCE, R_z_from_axis, Up, find_up, named_axis, rotation_to_z_up, up_of

__all__ = [
    "MIN_CONFIDENCE",
    "Plane",
    "R_z_from_axis",
    "Surfaces",
    "Up",
    "find_planes",
    "find_up",
    "name_planes",
    "named_axis",
    "refine_up",
    "rotation_to_z_up",
    "surfaces_of",
    "up_of",
    "wall_yaw",
    "yaw_turn",
]
