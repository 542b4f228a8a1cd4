"""Poses as a 4 x 4 matrix in a text file."""

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..runtime.json_file import read_text
from .pose import Pose, checked_rotation, orthonormal

MAX_SIZE = 65_536  # bytes: sixteen numbers and some comments
MAX_SKEW = 1e-3  # off a rotation, for matrices written with few digits
WANTED = "wanted the 4 x 4 numbers of T_world_from_cam"


def read_pose_matrix(path: Path) -> Pose:
    """The pose in a text file of T_world_from_cam, 4 x 4 numbers; lines that begin with # are comments."""
    lines = read_text(path, WANTED, MAX_SIZE).splitlines()
    rows = [line.replace(",", " ").split() for line in lines if line.split("#")[0].strip()]
    try:
        T_world_from_cam = np.array(rows, dtype=np.float64)
    except ValueError as error:  # words, lines of several lengths
        raise InputError(f"{path}: found {error}, {WANTED}") from error
    if T_world_from_cam.shape != (4, 4) or not np.isfinite(T_world_from_cam).all():
        shape = " x ".join(map(str, T_world_from_cam.shape))
        raise InputError(f"{path}: found {shape} numbers, not all finite or not as many, {WANTED}")
    if not np.allclose(T_world_from_cam[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{path}: the last row is not 0 0 0 1, {WANTED}")
    R = checked_rotation(T_world_from_cam[:3, :3], MAX_SKEW, f"{path}: the matrix on the left")
    return Pose(orthonormal(R).T, T_world_from_cam[:3, 3])
