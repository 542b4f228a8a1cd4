"""Poses in the datasets' files, checked, and in our axes."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...cloud.validation import MAX_COORDINATE
from ...errors import InputError
from ...geometry.camera_axes import CAMERA_AXES, OPENGL_FROM_CAM
from ...geometry.pose import Array, Pose, orthonormal

AXES = {**CAMERA_AXES, "opengl": OPENGL_FROM_CAM}  # a pose file's camera axes from ours, by name
MAX_LIST_SIZE, MAX_MATRIX_SIZE = 1 << 26, 1 << 16  # [byte] of files
MAX_ENTRY = 2.0  # of what may be a rotation, before it is multiplied
MAX_SKEW = 1e-2  # of what is called a rotation: some files have three decimals
WORLD_FROM_CAM, CAM_FROM_WORLD = DIRECTIONS = ("world_from_cam", "cam_from_world")


def read_text(path: Path, wanted: str, max_size: int = MAX_LIST_SIZE) -> str:
    """A small file's text."""
    try:
        if path.stat().st_size > max_size:
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
    except (ValueError, RecursionError) as error:  # bad JSON, and numbers of thousands of digits
        raise InputError(f"{path}: found damaged JSON ({error}), {wanted}") from error


def read_matrix(path: Path, num_rows: int) -> Array:
    """The matrix (num_rows, 4) that is all of a text file."""
    wanted = f"wanted {num_rows} x 4 numbers"
    words = read_text(path, wanted, MAX_MATRIX_SIZE).split()
    try:
        numbers = np.array([float(word) for word in words[: 4 * num_rows + 1]])
    except ValueError as error:
        raise InputError(f"{path}: found {error}, {wanted}") from error
    if len(numbers) != 4 * num_rows:
        raise InputError(f"{path}: found {len(words)} numbers, {wanted}")
    return numbers.reshape(num_rows, 4)


def checked_pose(where: str, R_other_from_world: Array, center_world: Array, axes: str) -> Pose:
    """The pose of a camera with axes by name; `where` names the file for refusals."""
    check_numbers(where, R_other_from_world, center_world)
    return Pose(AXES[axes].T @ orthonormal(R_other_from_world), center_world)


def check_numbers(where: str, R: Array, t: Array) -> None:
    """Refuse what is no rotation (3, 3) or no position (3,)."""
    is_finite = np.isfinite(R).all() and np.isfinite(t).all()
    if not (is_finite and np.abs(t).max() <= MAX_COORDINATE):
        wanted = "wanted a rotation and a position"
        raise InputError(f"{where}: found numbers that are not finite or too large, {wanted}")
    is_tame = np.abs(R).max() <= MAX_ENTRY
    if not (is_tame and np.abs(R @ R.T - np.eye(3)).max() < MAX_SKEW and np.linalg.det(R) > 0.0):
        raise InputError(f"{where}: found the matrix {R.tolist()}, which is no rotation")


def pose_of_transform(where: str, T: Array, direction: str, axes: str) -> Pose:
    """The pose in a matrix (3 or 4, 4) [R | t] that takes camera coordinates to the world's, or back."""
    R, t = T[:3, :3], T[:3, 3]
    check_numbers(where, R, t)
    if direction == CAM_FROM_WORLD:
        return checked_pose(where, R, -R.T @ t, axes)
    return checked_pose(where, R.T, t, axes)
