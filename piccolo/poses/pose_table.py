"""Tables of given poses as programs write them, which can be written again with other poses.

These are Potree's coordinates.txt, tables with omega, phi, kappa (Metashape, Pix4D), Metashape's csv with
yaw, pitch, roll, quaternions by a header, NavVis' pano-poses.csv, trajectories in TUM's form, E57 files with
images. Positions are in the scan's frame.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry.pose import OPENGL_FROM_CAM, OPTICAL_FROM_CAM, Pose, check_pose
from ..system.arrays import Array
from ..system.errors import InputError
from ..system.files.atomic import write_lines
from ..system.files.json_file import is_number, naming, read_text
from .e57_poses import list_posed_images, write_image_poses
from .relative_poses import COLUMNS, find_columns

WANTED = (
    "wanted Potree's coordinates.txt, a TUM trajectory, or a table with a header that names x, y, z and "
    "qx, qy, qz, qw, or omega, phi, kappa, or yaw, pitch, roll"
)
MOST_DEGREES = 0.05  # chosen: between the first and last photo of one scan
FARTHER = 100.0  # chosen: times as far are photos in metres as in degrees
STALE = re.compile("r[123][123]")  # a matrix beside angles


class Form(NamedTuple):
    """Columns that say the R of x_world = R x_camera."""

    names: tuple[str, ...]
    axes: str  # of angles [deg], as scipy names them; "" of a quaternion
    signs: tuple[float, ...]
    first: float  # [deg] from which the first angle counts
    other_from_cam: Array

    def read(self, values: Array) -> Array:
        """Return R_cam_from_world (3, 3) of the columns' values."""
        if not self.axes:
            return np.asarray(self.other_from_cam.T @ Rotation.from_quat(values).as_matrix().T)
        angles = np.array(self.signs) * values + [self.first, 0.0, 0.0]
        return np.asarray(self.other_from_cam.T @ Rotation.from_euler(self.axes, angles, True).as_matrix().T)

    def write(self, R_cam_from_world: Array) -> Array:
        """Return the columns' values of R_cam_from_world (3, 3)."""
        turn = Rotation.from_matrix((self.other_from_cam @ R_cam_from_world).T)
        if not self.axes:
            return np.asarray(turn.as_quat())
        angles = turn.as_euler(self.axes, degrees=True, suppress_warnings=True) - [self.first, 0.0, 0.0]
        angles *= self.signs
        if self.first:  # a heading
            angles[0] %= 360.0
        return np.asarray(angles)


QUATERNION = Form(("qx", "qy", "qz", "qw"), "", (), 0.0, OPTICAL_FROM_CAM)
AHEAD = QUATERNION._replace(other_from_cam=np.eye(3))  # of cameras with x ahead
FORMS = (
    # pano_ori_x ... of NavVis, of which is assumed: ahead, left, up
    AHEAD._replace(names=("panoorix", "panooriy", "panooriz", "panooriw")),
    QUATERNION,
    Form(("omega", "phi", "kappa"), "XYZ", (1.0, 1.0, 1.0), 0.0, OPENGL_FROM_CAM),
    Form(("yaw", "pitch", "roll"), "ZXY", (-1.0, 1.0, 1.0), 0.0, OPENGL_FROM_CAM),
    Form(("course", "pitch", "roll"), "ZYX", (-1.0, -1.0, 1.0), 90.0, np.eye(3)),
    Form(("heading", "pitch", "roll"), "ZYX", (-1.0, -1.0, 1.0), 90.0, np.eye(3)),
)
GEOGRAPHIC = {"x": "x?easting|", "y": "y?northing|", "z": "z?altitude|height|"}
KNOWN = {name: re.compile(name) for form in FORMS for name in form.names} | COLUMNS
KNOWN |= {name: re.compile(words + COLUMNS[name].pattern) for name, words in GEOGRAPHIC.items()}
TUM = ("time", *"xyz", *QUATERNION.names)
OPK = ("name", *"xyz", "omega", "phi", "kappa")
POTREE = ("name", "time", *"xyz", "course", "pitch", "roll")


@dataclass(frozen=True)
class PoseTable:
    """The lines of a file of poses, and which of their words are what."""

    path: Path
    head: tuple[str, ...]  # lines before the first pose
    rows: tuple[tuple[str, ...], ...]  # words of a line
    separator: str
    columns: dict[str, int]
    form: Form

    def column(self, name: str) -> list[str] | None:
        """Return the words of a column such as `name` or `time`; None if there is none."""
        at = self.columns.get(name)
        return None if at is None else [row[at] for row in self.rows]

    @property
    def times(self) -> Array | None:
        """Times (N,) [s]; None of named poses if there are none, or they number the rows, or do not rise.

        InputError for what is no number, and for a trajectory, whose times are its names, that does not rise.
        """
        with naming(self.path, WANTED):
            times = np.array(self.column("time") or [], float)
        if self.column("name") is None and len(times):
            if not np.all(np.diff(times) > 0.0):
                row = int(np.argmin(np.diff(times) > 0.0)) + 1
                found = f"found the time {times[row]:.6f} after {times[row - 1]:.6f}"
                raise InputError(f"{self.path}: {found}, wanted a trajectory in the order of time")
            return times
        is_clock = len(times) > 1 and np.all(np.diff(times) > 0.0) and np.any(np.diff(times) != 1.0)
        return times if is_clock else None

    @property
    def poses(self) -> list[Pose]:
        """The given poses; InputError for what is none."""
        poses = []
        with naming(self.path, WANTED):
            for number, row in enumerate(self.rows, 1):
                center, values = (
                    np.array([row[self.columns[name]] for name in names], float)
                    for names in ("xyz", self.form.names)
                )
                poses.append(check_pose(Pose(self.form.read(values), center), f"row {number}"))
        return poses

    def check_metres(self, found: Sequence[Pose] = ()) -> None:
        """Refuse longitudes and latitudes [deg]: all within a few kilometres, as the photos were `found`."""
        lon_lat = np.array([pose.center_world[:2] for pose in self.poses]).reshape(-1, 2)
        extent = float(np.ptp(lon_lat, axis=0).max(initial=0.0)) if len(lon_lat) else 0.0
        if not 0.0 < extent < MOST_DEGREES or np.any(np.abs(lon_lat) > (180.0, 90.0)):
            return
        others = np.array([pose.center_world[:2] for pose in found]).reshape(-1, 2)
        if len(others) and np.ptp(others, axis=0).max() < FARTHER * extent:
            return
        x, y = lon_lat[0]
        wanted = "wanted the scan's coordinates [m]"
        raise InputError(f"{self.path}: found longitude and latitude such as {x:.6f} {y:.6f}, {wanted}")

    def write(self, out: Path, poses: Sequence[Pose]) -> None:
        """Write the file with other poses in their order; columns r11 .. r33 are left out."""
        if self.path.suffix.lower() == ".e57":
            write_image_poses(self.path, out, poses)
            return
        heads = [_split(line.lstrip("#"), self.separator) for line in self.head]
        stale = {at for words in heads for at, word in enumerate(words) if STALE.fullmatch(word)}

        def join(words: Sequence[str]) -> str:
            return self.separator.join(word for at, word in enumerate(words) if at not in stale)

        lines = [join(_split(line, self.separator)) if stale else line for line in self.head]
        for row, pose in zip(self.rows, poses, strict=True):
            words = [*row]
            values = [*pose.center_world, *self.form.write(pose.R_cam_from_world)]
            for name, value in zip((*"xyz", *self.form.names), values, strict=True):
                words[self.columns[name]] = repr(float(value))
            lines.append(join(words))
        write_lines(out, lines)


def read_pose_table(path: Path) -> PoseTable:
    """Return the table of poses in a file, its columns by a header, else by their number; or an E57's."""
    if path.suffix.lower() == ".e57":
        rows = tuple(_row_of(image.file_name, pose) for image, pose in list_posed_images(path))
        return PoseTable(path, (), rows, " ", {n: at for at, n in enumerate(("name", *TUM[1:]))}, QUATERNION)
    lines = read_text(path, WANTED).splitlines()
    text = next((line for line in reversed(lines) if line.strip()), "")
    separator = next((mark for mark in ("\t", ",", ";") if text.count(mark) >= len(OPK) - 1), " ")
    words = [_split(line, separator) for line in lines]
    num_columns = len(_split(text, separator))
    is_row = [len(row) == num_columns and sum(map(is_number, row)) >= len(OPK) - 1 for row in words]
    first = is_row.index(True) if any(is_row) else len(lines)
    rows = tuple(tuple(row) for row, is_one in zip(words, is_row, strict=True) if is_one)
    heads = [find_columns(_split(line.lstrip("# "), separator), KNOWN) for line in lines[:first]]
    if rows:
        usual = {8: TUM if all(map(is_number, rows[0])) else POTREE, 7: OPK}.get(num_columns, ())
        heads.append({name: at for at, name in enumerate(usual)})
    for columns in heads:
        form = next((form for form in FORMS if {*"xyz", *form.names} <= {*columns}), None)
        if form is not None:
            return PoseTable(path, tuple(lines[:first]), rows, separator, columns, form)
    raise InputError(f"{path}: found {len(rows)} rows of poses and no known columns, {WANTED}")


def _row_of(name: str, pose: Pose) -> tuple[str, ...]:
    values = [*pose.center_world, *QUATERNION.write(pose.R_cam_from_world)]
    return name, *(repr(float(value)) for value in values)


def _split(line: str, separator: str) -> list[str]:
    return [word.strip() for word in (line.split() if separator == " " else line.split(separator))]
