"""Poses and rigid transforms in text files of 4 x 4 numbers."""

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files.json_file import read_text
from ..geometry.pose import Array, Pose, checked_rotation, orthonormal

MAX_FILE_SIZE = 65_536  # [byte] sixteen numbers and some comments
MAX_SKEW = 1e-3  # off a rotation, for matrices written with few digits


def read_pose_matrix(path: Path) -> Pose:
    """The pose in a text file of T_world_from_cam."""
    T_world_from_cam = read_transform(path, "T_world_from_cam")
    return Pose(T_world_from_cam[:3, :3].T, T_world_from_cam[:3, 3])


def read_transform(path: Path, name: str) -> Array:
    """The rigid transform (4, 4) in a text file of as many numbers; lines that begin with # are comments."""
    wanted = f"wanted the 4 x 4 numbers of {name}"
    lines = read_text(path, wanted, MAX_FILE_SIZE).splitlines()
    rows = [line.replace(",", " ").split() for line in lines if line.split("#")[0].strip()]
    try:
        T = np.array(rows, dtype=np.float64)
    except ValueError as error:  # words, lines of several lengths
        raise InputError(f"{path}: found {error}, {wanted}") from error
    if T.shape != (4, 4) or not np.isfinite(T).all():
        shape = " x ".join(map(str, T.shape))
        raise InputError(f"{path}: found {shape} numbers, not all finite or not as many, {wanted}")
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{path}: the last row is not 0 0 0 1, {wanted}")
    T[:3, :3] = orthonormal(checked_rotation(T[:3, :3], MAX_SKEW, f"{path}: the matrix on the left"))
    return T
