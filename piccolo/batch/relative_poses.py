"""Relative poses of photos, as other tools write them."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..files.json_file import DAMAGE, describe, read_json, read_text
from ..geometry.pose import (
    OPENGL_FROM_CAM,
    OPTICAL_FROM_CAM,
    Pose,
    check_transform,
    rotation_from_quaternion_wxyz,
)
from ..localization.bundle_adjustment import RelativeScale

WANTED = "wanted COLMAP's images.txt, a transforms.json of nerfstudio [m], or a TUM trajectory [m]"
ODOMETRY = "wanted a TUM or KITTI trajectory or a transforms.json (ARKit), in metres"
NUM_KITTI = 12  # columns: T_world_from_cam without its last row
NUM_COLMAP = 10  # columns: id, qw, qx, qy, qz, tx, ty, tz, camera, name
NUM_TUM = 8  # columns: time, tx, ty, tz, qx, qy, qz, qw
NamedPose = tuple[str, Pose]


def read_relative_poses(path: Path, photos: Sequence[Path]) -> list[Pose]:
    """Return each photo's pose in the common frame of a file of poses.

    COLMAP's images.txt and transforms.json name their photos; in a TUM trajectory the time is the photo's
    name without suffix. Raises InputError if the file is none of these, or has no pose of a photo, or two.
    """
    poses = read_transforms(path) if path.suffix == ".json" else read_lines(path)
    found = match_names(path, poses, photos)
    for photo, pose in zip(photos, found, strict=True):
        if pose is None:
            raise InputError(f"{path}: found 0 poses of {photo}, wanted one of each photo")
    return [pose for pose in found if pose is not None]


def find_scale(path: Path) -> RelativeScale:
    """Return the unit of a file's positions: structure from motion, as in COLMAP's files, has none."""
    if path.suffix == ".json":
        return "metres"
    lines = read_text(path, WANTED).splitlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return "unknown" if len(first.split(None, NUM_COLMAP - 1)) == NUM_COLMAP else "metres"


def match_names(path: Path, poses: Sequence[NamedPose], photos: Sequence[Path]) -> list[Pose | None]:
    """Return the pose of each photo by its path, its name or its stem; InputError if there are two."""
    by_path = defaultdict[str, list[Pose]](list)
    by_name = defaultdict[str, list[Pose]](list)
    for name, pose in poses:
        by_path[name].append(pose)
        by_name[Path(name).name].append(pose)
    chosen: list[Pose | None] = []
    for photo in photos:
        found = by_path.get(str(photo)) or by_name.get(photo.name) or by_name.get(photo.stem) or []
        if len(found) > 1:
            raise InputError(f"{path}: found {len(found)} poses of {photo}, wanted one of each photo")
        chosen.append(found[0] if found else None)
    return chosen


def read_odometry(
    path: Path, frames: Sequence[Path], times: Sequence[float], has_clock: bool = True
) -> list[Pose | None]:
    """Return each frame's pose in the frame of an odometry; None of a frame without one.

    A transforms.json names its frames. A trajectory has a pose of each frame in order, or, of TUM, poses by
    time [s]: each frame takes the nearest, within half of the time to the next frame. If `times` are by a
    clock, it is tried as the trajectory's first. Else both begin at 0.
    Raises InputError if the file is no odometry, or of other frames.
    """
    if path.suffix == ".json":
        found = match_names(path, read_transforms(path), frames)
    else:
        rows = [line.split() for line in read_text(path, ODOMETRY).splitlines() if line.strip()]
        rows = [row for row in rows if not row[0].startswith("#")]
        is_kitti = all(len(row) == NUM_KITTI for row in rows)
        with naming(path, ODOMETRY):
            poses = [read_kitti_row(row) if is_kitti else read_tum_row(row) for row in rows]
            clock = np.array([] if is_kitti else [row[0] for row in rows], float)
        numbers = match_times(clock, np.array(times, float), has_clock, len(poses) == len(frames))
        found = [None if k is None else poses[k][1] for k in numbers]
    if not any(found):
        raise InputError(f"{path}: found {len(frames)} frames and no pose of them, {ODOMETRY}")
    return found


def match_times(clock: Array, times: Array, has_clock: bool, is_in_order: bool) -> list[int | None]:
    """Return the number of each frame's row: by a clock, or else in order or since the first."""
    numbers = find_nearest(clock if has_clock else clock[:0], times)
    if any(k is not None for k in numbers):
        return numbers
    return [*range(len(times))] if is_in_order else find_nearest(clock, times - times[0])


def find_nearest(clock: Array, times: Array) -> list[int | None]:
    """Return the number of the time (N,) nearest to each of others (M,), within half of their steps."""
    if len(clock) == 0:
        return [None] * len(times)
    slack = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    nearest = [int(np.abs(clock - time).argmin()) for time in times]
    return [k if abs(clock[k] - time) <= slack else None for k, time in zip(nearest, times, strict=True)]


@contextmanager
def naming(path: Path, wanted: str) -> Iterator[None]:
    """Within this, the error of a damaged row is an InputError that names the file."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}, {error}; {wanted}") from error
    except DAMAGE as error:
        raise InputError(f"{path}: found {describe(error)}, {wanted}") from error


def read_kitti_row(row: Sequence[str]) -> NamedPose:
    """Return the pose of a row, without a name: T_world_from_cam, camera axes right, down, forward."""
    return "", check_transform(np.array(row, float).reshape(3, 4), "a row", OPTICAL_FROM_CAM)


def read_transforms(path: Path) -> list[NamedPose]:
    """Return the poses in a transforms.json with the photos' paths: T_world_from_cam, right, up, back."""
    poses = []
    document = read_json(path, WANTED)
    with naming(path, WANTED):
        for frame in document["frames"]:
            T = np.array(frame["transform_matrix"], float)
            if T.shape != (4, 4):
                raise ValueError(f"a transform_matrix of shape {T.shape}")
            name = str(frame["file_path"])
            poses.append((name, check_transform(T, name, OPENGL_FROM_CAM)))
    return poses


def read_lines(path: Path) -> list[NamedPose]:
    """Return the poses in a text file of COLMAP, by the photos' names, or of TUM, by times."""
    lines = [line for line in read_text(path, WANTED).splitlines() if not line.startswith("#")]
    rows = [line.split(None, NUM_COLMAP - 1) for line in lines]
    with naming(path, WANTED):
        if rows and len(rows[0]) == NUM_COLMAP:
            return [read_colmap_row(row) for row in rows[::2] if row]  # points follow each photo
        return [read_tum_row(row) for row in rows if row]


def read_colmap_row(row: Sequence[str]) -> NamedPose:
    """Return the name and the pose of a row: T_cam_from_world, camera axes right, down, forward."""
    if len(row) != NUM_COLMAP:
        raise ValueError(f"{len(row)} columns of a photo")
    values = np.array(row[1:8], float)
    T = np.column_stack([read_quaternion(values[:4]), values[4:]])
    return row[9], check_transform(T, row[9], OPTICAL_FROM_CAM, is_from_world=True)


def read_tum_row(row: Sequence[str]) -> NamedPose:
    """Return the time and the pose of a row: T_world_from_cam, camera axes right, down, forward."""
    if len(row) != NUM_TUM:
        raise ValueError(f"{len(row)} columns")
    values = np.array(row[1:], float)
    T = np.column_stack([read_quaternion(np.roll(values[3:], 1)), values[:3]])
    return row[0], check_transform(T, row[0], OPTICAL_FROM_CAM)


def read_quaternion(wxyz: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion (4,); ValueError if it has no length that can be squared."""
    if not 1e-100 < np.abs(wxyz).max() < 1e100:
        raise ValueError("a quaternion without a length")
    return rotation_from_quaternion_wxyz(wxyz)
