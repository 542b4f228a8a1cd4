"""Poses in the datasets' files, checked, and in our axes."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..export.axes import CAMERA_AXES, OPENGL_FROM_CAM
from ..pose import Array, Pose, orthonormal

AXES = {**CAMERA_AXES, "opengl": OPENGL_FROM_CAM}  # a pose file's camera axes from ours, by name
MAX_FILE_SIZE = 1 << 26  # [byte] of a file of poses
MAX_SKEW = 1e-2  # of what is called a rotation: some files have three decimals
WORLD_FROM_CAM, CAM_FROM_WORLD = DIRECTIONS = ("world_from_cam", "cam_from_world")


def read_text(path: Path, wanted: str) -> str:
    """A small file's text."""
    try:
        if path.stat().st_size > MAX_FILE_SIZE:
            raise InputError(f"{path}: found {path.stat().st_size} bytes, {wanted}")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}), {wanted}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: found bytes that are no text, {wanted}") from error


def read_json(path: Path, wanted: str) -> Any:
    """A small JSON file."""
    try:
        return json.loads(read_text(path, wanted))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: found damaged JSON ({error}), {wanted}") from error


def read_matrix(path: Path, num_rows: int) -> Array:
    """The matrix (num_rows, 4) that is all of a text file."""
    wanted = f"wanted {num_rows} x 4 numbers"
    words = read_text(path, wanted).split()
    try:
        numbers = np.array([float(word) for word in words[: 4 * num_rows + 1]])
    except ValueError as error:
        raise InputError(f"{path}: found {error}, {wanted}") from error
    if len(numbers) != 4 * num_rows:
        raise InputError(f"{path}: found {len(words)} numbers, {wanted}")
    return numbers.reshape(num_rows, 4)


def checked_pose(where: str, R_other_from_world: Array, center_world: Array, axes: str) -> Pose:
    """The pose of a camera with axes by name; `where` names the file for refusals."""
    R = np.asarray(R_other_from_world, dtype=np.float64)
    if not (np.isfinite(R).all() and np.isfinite(center_world).all()):
        raise InputError(f"{where}: found numbers that are not finite, wanted a rotation and a position")
    skew = float(np.abs(R @ R.T - np.eye(3)).max())
    if not skew < MAX_SKEW or np.linalg.det(R) < 0.0:
        raise InputError(
            f"{where}: found a matrix that is no rotation (R R^T is off by {skew:.2g}, determinant "
            f"{np.linalg.det(R):.3g}), wanted one"
        )
    R_cam_from_world = AXES[axes].T @ orthonormal(R)
    return Pose(R_cam_from_world, np.asarray(center_world, dtype=np.float64))


def pose_of_transform(where: str, T: Array, direction: str, axes: str) -> Pose:
    """The pose in a matrix (3 or 4, 4) [R | t] that takes camera coordinates to the world's, or back."""
    R, t = T[:3, :3], T[:3, 3]
    if direction == CAM_FROM_WORLD:
        return checked_pose(where, R, -R.T @ t, axes)
    return checked_pose(where, R.T, t, axes)
