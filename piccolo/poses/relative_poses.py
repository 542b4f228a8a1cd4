"""Relative poses of photos, as other tools write them."""

import logging
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..geometry.pose import OPTICAL_FROM_CAM, Pose, check_transform, rotation_from_quaternion_wxyz
from ..photo.camera.foreign import NUM_COLMAP, parse_xml, read_images
from ..system.arguments import PICTURES
from ..system.arrays import Array
from ..system.errors import InputError
from ..system.files.json_file import is_number, naming, read_text
from ..system.files.photo_names import match_names
from .bundle_adjustment import RelativeScale
from .model_poses import SUFFIXES, NamedPose, read_json_poses

WANTED = (
    "wanted COLMAP's images.txt or .bin, hloc's poses, Metashape's cameras.xml, JSON of OpenSfM, OpenMVG or "
    "Meshroom, or in metres a transforms.json of nerfstudio, a TUM trajectory or a table with a header"
)
FOREIGN = {  # the programs whose files are not read, by how these begin
    "Bundler": re.compile("# Bundle file"),
    "RealityCapture": re.compile(r"#\s*name\s*,\s*x\s*,\s*y\s*,\s*alt\b|<[^>]*xmpmeta.*\bxcr:", re.DOTALL),
}
ODOMETRY = "wanted a TUM or KITTI trajectory or a transforms.json (ARKit), in metres"
NUM_KITTI = 12  # columns: T_world_from_cam without its last row
NUM_TUM = 8  # columns: time, tx, ty, tz, qx, qy, qz, qw
COLUMNS = {  # of a header, without what is no letter
    "name": re.compile("label|.*name|image|file.*|photo"),
    "time": re.compile("time.*|t|stamp"),
    **{axis: re.compile(f"(p|t|(pano)?pos.*|tr.*|prsr|){axis}") for axis in "xyz"},
    **{f"q{axis}": re.compile(f"(q|rot|(pano)?ori|quat).*{axis}") for axis in "xyzw"},
}
NAVVIS = "pano_ori_w"  # in the header of pano-poses.csv, whose cameras have x ahead
NOT_IN_NAMES = re.compile(r"[\[(].*|[^a-z]")
LOG = logging.getLogger("piccolo")
LEVEL = math.cos(math.radians(15.0))  # of an axis that stays as it is while the others turn
TURNED = math.cos(math.radians(45.0))
UNIT_LENGTH = 0.01  # by which the length of a quaternion may differ from 1


def read_relative_poses(path: Path, photos: Sequence[Path]) -> list[Pose | None]:
    """Return each photo's pose in the common frame of a file of poses; None of one that it has not.

    All but a TUM trajectory name their photos; there the time is the photo's name without suffix. Raises
    InputError if the file is none that is read, or has two poses of a photo, or fewer than two photos'.
    """
    poses = read_json_poses(path, WANTED)[0] if path.suffix in SUFFIXES else read_lines(path)
    found = match_names(path, poses, photos)
    if sum(pose is not None for pose in found) < min(2, len(photos)):
        missing = next(photo for photo, pose in zip(photos, found, strict=True) if pose is None)
        raise InputError(f"{path}: found 0 poses of {missing}, wanted one of each photo, or of most")
    return found


def find_file_scale(path: Path) -> RelativeScale:
    """Return the unit of a file's positions: structure from motion, as in COLMAP's files, has none."""
    if path.suffix in SUFFIXES:
        return read_json_poses(path, WANTED)[1]
    if path.suffix in (".bin", ".xml"):
        return "unknown"
    rows = _rows(path)
    return "unknown" if _are_colmap(rows) or _are_hloc(rows) else "metres"


def read_odometry(
    path: Path, frames: Sequence[Path], times: Sequence[float], has_clock: bool = True
) -> list[Pose | None]:
    """Return each frame's pose in the frame of an odometry; None of a frame without one.

    A transforms.json names its frames. A trajectory has a pose of each frame in order, or, of TUM, poses by
    time [s]: each frame takes the nearest, within half of the frames' median step. Times by a clock are
    tried first; if none fits, rows are taken in order, if as many as frames, else by time since the first.
    Raises InputError if the file is no odometry, or of other frames.
    """
    if path.suffix == ".json":
        named, scale = read_json_poses(path, WANTED)
        if scale == "unknown":
            raise InputError(f"{path}: found a model without a scale, {ODOMETRY}")
        found = match_names(path, named, frames)
    else:
        rows = _rows(path)
        is_kitti = all(len(row) == NUM_KITTI for row in rows)
        with naming(path, ODOMETRY):
            if is_kitti:  # T_world_from_cam, camera axes right, down, forward
                matrices = np.array(rows, float).reshape(-1, 3, 4)
                poses = [("", check_transform(T, "a row", OPTICAL_FROM_CAM)) for T in matrices]
            else:
                poses = _read_tum(path, rows)
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


def warn_of_axes(path: Path, poses: Sequence[Pose]) -> None:
    """Log a warning if poses turn about what was read as their view: of a base it is the vertical."""
    axes = np.array([pose.R_cam_from_world for pose in poses]).reshape(-1, 3, 3)  # forward, left, up
    middle = axes[:, 0].sum(axis=0)
    is_level = axes[:, 0] @ middle > LEVEL * np.linalg.norm(middle)
    if is_level.all() and (axes[:, 1] @ axes[:1, 1].T < TURNED).any():
        found = "found poses that turn about their z, as those of a base with z up (ROS)"
        wanted = "wanted a camera's: x right, y down, z ahead; tools/calibrate_mount.py has `axes` piccolo"
        LOG.warning("%s: %s, %s", path, found, wanted)


def _read_tum(path: Path, rows: Sequence[Sequence[str]]) -> list[NamedPose]:
    if NAVVIS in read_text(path, WANTED).partition("\n")[0]:
        return [read_tum_row(row, np.eye(3)) for row in rows]
    poses = [read_tum_row(row) for row in rows]
    warn_of_axes(path, [pose for _, pose in poses])
    return poses


def read_lines(path: Path) -> list[NamedPose]:
    """Return the poses in a file of COLMAP or hloc, by the photos' names, or of a tracker, by times."""
    with naming(path, WANTED):
        if path.suffix == ".xml":
            cameras = read_xml(path).iter("camera")
            return [read_metashape(camera) for camera in cameras if camera.find("transform") is not None]
        rows = [] if path.suffix == ".bin" else _rows(path)
        if path.suffix == ".bin" or _are_colmap(rows):
            return [read_colmap_row(row) for row in read_images(path, WANTED)]
        if _are_hloc(rows):
            return [read_colmap_row(["", *row[1:], "", row[0]]) for row in rows]
        return _read_tum(path, rows)


def read_xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML file; InputError if it is damaged."""
    with naming(path, WANTED):
        return parse_xml(read_text(path, WANTED))


def read_metashape(camera: ElementTree.Element) -> NamedPose:
    """Return the label and the pose of a camera: T_chunk_from_cam, camera axes right, down, forward."""
    label = camera.get("label", "")
    T = np.array((camera.findtext("transform") or "").split(), float).reshape(4, 4)
    return label, check_transform(T, label, OPTICAL_FROM_CAM)


def _rows(path: Path) -> list[list[str]]:
    """Return the rows of a file of poses, those of a tracker's table as TUM has them.

    A header of such a table names its columns; without one a ninth column is a node's number.
    """
    text = read_text(path, WANTED)
    if program := next((name for name, begin in FOREIGN.items() if begin.match(text.lstrip())), None):
        raise InputError(f"{path}: is {program}'s file, which is not read: export COLMAP's; {WANTED}")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    rows = [_split(line) for line in lines if not line.startswith("#")]
    if _are_colmap(rows):
        return rows
    found = find_columns(_split(lines[0].lstrip("# ")), COLUMNS) if lines else {}
    if {*COLUMNS} - {*found} <= {"time"} or {*COLUMNS} - {*found} == {"name"}:
        first, *others = (at for name, at in found.items() if name in ("name", "time"))
        columns = [min([first, *others]), *(found[name] for name in list(COLUMNS)[2:])]
        rows = rows[not lines[0].startswith("#") :]
        return [[row[k] for k in columns if k < len(row)] for row in rows]
    if rows and all(len(row) == NUM_TUM + 1 and all(map(is_number, row[1:])) for row in rows):
        return [row[:NUM_TUM] for row in rows]
    return rows


def find_columns(words: Sequence[str], names: Mapping[str, re.Pattern[str]]) -> dict[str, int]:
    """Return the first column of a header's words that each of the names fits."""
    letters = [NOT_IN_NAMES.sub("", word.lower()) for word in words]
    fits = {
        name: [at for at, word in enumerate(letters) if form.fullmatch(word)] for name, form in names.items()
    }
    return {name: columns[0] for name, columns in fits.items() if columns}


def _split(line: str) -> list[str]:
    """Split a row at blanks, commas or semicolons; a name at the end of COLMAP's may have blanks."""
    mark = next((mark for mark in ",;" if line.count(mark) >= NUM_TUM - 1), None)
    words = line.split(mark)
    is_named = len(words) > NUM_COLMAP and not all(map(is_number, words))
    return line.split(None, NUM_COLMAP - 1) if is_named else [word.strip() for word in words]


def _are_colmap(rows: Sequence[Sequence[str]]) -> bool:
    return any(len(row) == NUM_COLMAP and not is_number(row[-1]) for row in rows[:2])


def _are_hloc(rows: Sequence[Sequence[str]]) -> bool:
    """Return True for rows of a name, a quaternion w x y z, a position; TUM has the position first."""
    if not rows or not all(len(row) == NUM_TUM and all(map(is_number, row[1:])) for row in rows):
        return False
    values = np.array([row[1:] for row in rows], float)
    with np.errstate(over="ignore"):
        lengths = [np.linalg.norm(values[:, begin : begin + 4], axis=1) for begin in (0, 3)]
    is_first, is_last = (bool(np.all(np.abs(length - 1.0) < UNIT_LENGTH)) for length in lengths)
    return is_first and (not is_last or Path(rows[0][0]).suffix.lower() in PICTURES)


def read_colmap_row(row: Sequence[str]) -> NamedPose:
    """Return the name and the pose of a row: T_cam_from_world, camera axes right, down, forward."""
    if len(row) != NUM_COLMAP:
        raise ValueError(f"{len(row)} columns of a photo")
    values = np.array(row[1:8], float)
    T = np.column_stack([read_quaternion(values[:4]), values[4:]])
    return row[9], check_transform(T, row[9], OPTICAL_FROM_CAM, is_from_world=True)


def read_tum_row(row: Sequence[str], other_from_cam: Array = OPTICAL_FROM_CAM) -> NamedPose:
    """Return the time and the pose of a row: T_world_from_cam, camera axes right, down, forward, or other."""
    if len(row) != NUM_TUM:
        raise ValueError(f"{len(row)} columns")
    if wrong := [word for word in row[1:] if not is_number(word)]:
        raise ValueError(f"{wrong[0][:40]!r}, which is no number")
    values = np.array(row[1:], float)
    T = np.column_stack([read_quaternion(np.roll(values[3:], 1)), values[:3]])
    return row[0], check_transform(T, row[0], other_from_cam)


def read_quaternion(wxyz: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion (4,); ValueError if its length is not 1."""
    if not abs(math.hypot(*wxyz) - 1.0) <= UNIT_LENGTH:
        raise ValueError("a quaternion whose length is not 1")
    return rotation_from_quaternion_wxyz(wxyz)
