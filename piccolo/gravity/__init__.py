"""Which way is up in a cloud, which planes it has, and along which directions its walls stand."""

from .planes import estimate_normals
from .up import MIN_CONFIDENCE, R_z_from_axis, find_up, rotation_to_z_up

__all__ = ["MIN_CONFIDENCE", "R_z_from_axis", "estimate_normals", "find_up", "rotation_to_z_up"]
