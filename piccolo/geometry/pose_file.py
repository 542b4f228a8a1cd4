"""Poses as a 4 x 4 matrix in a text file."""

from pathlib import Path

import numpy as np

from ..errors import InputError
from .pose import Pose, orthonormal

MAX_SIZE = 65_536  # bytes: sixteen numbers and some comments
MAX_SKEW = 1e-3  # off a rotation, for matrices written with few digits
WANTED = "wanted the 4 x 4 numbers of T_world_from_cam"


def read_pose_matrix(path: Path) -> Pose:
    """The pose in a text file of T_world_from_cam, 4 x 4 numbers; lines that begin with # are comments."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file but a folder or a device, {WANTED}")
    if path.stat().st_size > MAX_SIZE:
        raise InputError(f"{path}: found {path.stat().st_size} bytes, {WANTED}")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = [line.replace(",", " ").split() for line in lines if line.split("#")[0].strip()]
        T_world_from_cam = np.array(rows, dtype=np.float64)
    except ValueError as error:  # text that is not UTF-8, words, lines of several lengths
        raise InputError(f"{path}: found {error}, {WANTED}") from error
    if T_world_from_cam.shape != (4, 4) or not np.isfinite(T_world_from_cam).all():
        shape = " x ".join(map(str, T_world_from_cam.shape))
        raise InputError(f"{path}: found {shape} numbers, not all finite or not as many, {WANTED}")
    R = T_world_from_cam[:3, :3]
    # the first test keeps the product of the second finite
    is_orthogonal = np.abs(R).max() < 2.0 and np.abs(R @ R.T - np.eye(3)).max() < MAX_SKEW
    if (
        not is_orthogonal
        or np.linalg.det(R) < 0.0
        or not np.allclose(T_world_from_cam[3], [0.0, 0.0, 0.0, 1.0])
    ):
        raise InputError(f"{path}: found no rotation on the left or no 0 0 0 1 below, {WANTED}")
    return Pose(orthonormal(R).T, T_world_from_cam[:3, 3])
