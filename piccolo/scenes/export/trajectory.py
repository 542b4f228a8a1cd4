"""Trajectories, world from camera: TUM's "timestamp tx ty tz qx qy qz qw", KITTI's rows of a 3 x 4 matrix."""

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

from ...geometry.camera_axes import CAMERA_AXES, turned
from ...geometry.pose import T_world_from_cam, quaternion_wxyz
from .model import Format, Options, Shot
from .text import numbers, offset_comment, write_lines, write_offset_beside


def write_tum(shots: Sequence[Shot], out: Path, options: Options) -> None:
    """Rows in the order of time, under a comment that names the columns."""
    comments = [f"# timestamp tx ty tz qx qy qz qw, camera axes {options.axes}", *offset_comment(options)]
    rows = [_tum_row(shot, options) for shot in sorted(shots, key=lambda shot: Decimal(shot.time))]
    write_lines(out, [*comments, *rows])


def _tum_row(shot: Shot, options: Options) -> str:
    T = T_world_from_cam(turned(shot.pose, CAMERA_AXES[options.axes]))
    w, x, y, z = quaternion_wxyz(T[:3, :3])
    return f"{shot.time} {numbers([*T[:3, 3], x, y, z, w])}"


def write_kitti(shots: Sequence[Shot], out: Path, options: Options) -> None:
    """Twelve numbers a row, in the order of the results; the format has no comments."""
    matrices = [T_world_from_cam(turned(shot.pose, CAMERA_AXES[options.axes])) for shot in shots]
    write_offset_beside(out, options)
    write_lines(out, [numbers(T[:3].ravel()) for T in matrices])


TUM = Format("tum", "trajectory for evo and others", write_tum, frozenset({"offset", "axes", "timestamps"}))
KITTI = Format("kitti", "trajectory for evo and others", write_kitti, frozenset({"offset", "axes"}))
