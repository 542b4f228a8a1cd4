"""Lists of poses as text: CSV for spreadsheets, trajectories for evo and others, Potree's 360 images.

Numbers are written so that the same float64 is read back. Where a format has no place for the offset, it is
written beside it: <name>.offset.txt.
"""

import csv
import io
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path

from ...errors import InputError
from ...geometry.camera_axes import CAMERA_AXES, heading_pitch_roll_deg, turned
from ...geometry.pose import T_world_from_cam, quaternion_wxyz
from ...runtime.atomic import is_stream, write_atomically
from .posed_images import Format, Options, PosedImage

COLUMNS = (
    *("image", "cloud", "status", "confidence", "score", "x", "y", "z"),
    *("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),  # of R_cam_from_world
    *("heading_deg", "pitch_deg", "roll_deg"),
)


def numbers(values: Iterable[float], separator: str = " ") -> str:
    """The shortest text of each number that reads back as the same float64."""
    return separator.join(repr(float(value)) for value in values)


def offset_comment(options: Options) -> list[str]:
    """A comment line that gives the offset; none without."""
    if options.offset is None:
        return []
    return [f"# world position = position here + {numbers(options.offset)}"]


def write_lines(out: Path, lines: Sequence[str]) -> None:
    """Write a text file, UTF-8."""
    write_atomically(out, "".join(f"{line}\n" for line in lines).encode())


def offset_file(out: Path) -> Path:
    """The file of the offset beside one that has no place for it."""
    return out.with_name(f"{out.name}.offset.txt")


def write_offset_beside(out: Path, options: Options) -> None:
    """Write <name>.offset.txt with the offset's three numbers, if there is an offset."""
    if options.offset is not None:
        if is_stream(out):
            raise InputError(f"--offset: nothing can be written beside {out}, wanted a file as --out")
        write_lines(offset_file(out), [*offset_comment(options), numbers(options.offset)])


def write_csv(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a header and a row a result, in our own axes; what is not known is empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for image in images:
        result, pose = image.result, image.pose
        score = result.evidence.score if result.evidence else None
        words = image.name, result.cloud_name, result.status, result.confidence, score
        wxyz = quaternion_wxyz(pose.R_cam_from_world).tolist()
        table.writerow([*words, *pose.center_world.tolist(), *wxyz, *heading_pitch_roll_deg(pose)])
    write_offset_beside(out, options)
    write_atomically(out, text.getvalue().encode())


def write_tum(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write rows "timestamp tx ty tz qx qy qz qw", world from camera, by time, below a comment."""
    lines = [f"# timestamp tx ty tz qx qy qz qw, camera axes {options.axes}", *offset_comment(options)]
    for image in sorted(images, key=lambda image: Decimal(image.time)):
        T = T_world_from_cam(turned(image.pose, CAMERA_AXES[options.axes]))
        w, x, y, z = quaternion_wxyz(T[:3, :3])
        lines.append(f"{image.time} {numbers([*T[:3, 3], x, y, z, w])}")
    write_lines(out, lines)


def write_kitti(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write the twelve numbers of a 3 x 4 matrix, world from camera, a row; the format has no comments."""
    matrices = [T_world_from_cam(turned(image.pose, CAMERA_AXES[options.axes])) for image in images]
    write_offset_beside(out, options)
    write_lines(out, [numbers(T[:3].ravel()) for T in matrices])


def write_potree(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write coordinates.txt of Potree's 360 images (src/modules/Images360/Images360.js).

    Columns, by tabs: file, time, x, y, z in the cloud's coordinates, course, pitch, roll [deg]. Potree turns
    the sphere by R_z(90 - course) R_y(-pitch) R_x(90 + roll); with the picture as three.js lays it on the
    sphere these are heading, pitch and roll of Photo Sphere XMP. The first line is empty: by its version
    Potree skips the first line or reads it.
    """
    lines = [""]
    for image in images:
        values = [*image.pose.center_world, *heading_pitch_roll_deg(image.pose)]
        lines.append("\t".join([image.name, image.time, numbers(values, "\t")]))
    write_offset_beside(out, options)
    write_lines(out, lines)


CSV = Format("csv", "table with a header", write_csv, frozenset({"offset"}), has_unique_names=False)
TUM = Format("tum", "trajectory for evo and others", write_tum, frozenset({"offset", "axes", "timestamps"}))
KITTI = Format("kitti", "trajectory for evo and others", write_kitti, frozenset({"offset", "axes"}))
TEXT = "coordinates.txt of Potree's 360 images, in the folder that --images names"
POTREE = Format("potree", TEXT, write_potree, frozenset({"offset", "timestamps"}), forbidden='"')
