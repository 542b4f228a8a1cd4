"""The transform that turns a cloud's z up, what it is based on, and the JSON file that holds it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..cloud import CloudStream
from ..cloud.octree import build_octree
from ..cloud.settings import UpAxis
from ..cloud.voxels import Voxels
from ..errors import InputError
from ..geometry.pose import Array, Pose, checked_rotation, orthonormal, yaw_rotation
from ..runtime.json_file import read_json
from .planes import (
    Plane,
    PointNormals,
    classify_planes,
    estimate_normals,
    manhattan_yaw,
    ransac_planes,
    refine_up,
)
from .up import Z_UP_LOG_ODDS, Hypothesis, Up, find_up, named_axis, rotation_to_z_up

FORMAT = "piccolo-alignment/1"
CONVENTION = "x_aligned = T_aligned_from_scan @ (x_scan, 1) in the unit given; z_aligned is up"
MAX_FILE_SIZE = 1 << 20  # [byte]
UNIT_RANGE = (1e-300, 1e300)  # [m] its inverse is a number too
ROUNDING = 1e-6  # of a rotation's numbers in a file
SPACING = 0.08  # of the points used [m]


class Alignment(NamedTuple):
    """A rigid transform of a scan, and how far it can be relied on."""

    T_aligned_from_scan: Array  # (4, 4) in the unit of the files
    metres_per_unit: float
    confidence: float  # [0, 1] that up is up
    explanation: str  # one line

    def in_unit(self, metres_per_unit: float) -> "Alignment":
        """The same transform for coordinates in another unit."""
        T = self.T_aligned_from_scan.copy()
        T[:3, 3] *= self.metres_per_unit / metres_per_unit
        return self._replace(T_aligned_from_scan=T, metres_per_unit=metres_per_unit)

    def inverse(self) -> "Alignment":
        """The way back, from aligned coordinates to the scan's."""
        T, R = np.eye(4), self.T_aligned_from_scan[:3, :3]
        T[:3, :3] = R.T
        T[:3, 3] = -np.einsum("ji,j->i", R, self.T_aligned_from_scan[:3, 3]) + 0.0
        return self._replace(T_aligned_from_scan=T)

    def transform_pose(self, pose: Pose) -> Pose:
        """A pose of the scan in aligned coordinates, both in the unit of the transform."""
        R, t = self.T_aligned_from_scan[:3, :3], self.T_aligned_from_scan[:3, 3]
        return Pose(orthonormal(pose.R_cam_from_world @ R.T), R @ pose.center_world + t)

    def numbers(self) -> dict[str, object]:
        """The fields by their names, as JSON takes them."""
        return {**self._asdict(), "T_aligned_from_scan": self.T_aligned_from_scan.tolist()}

    def to_json(self) -> str:
        """One JSON object; every number reads back as the same float64."""
        document = {"format": FORMAT, "convention": CONVENTION, **self.numbers()}
        return json.dumps(document, indent=1, allow_nan=False) + "\n"

    def to_text(self) -> str:
        """Four rows of four numbers, as CloudCompare reads and writes a transform."""
        return "".join(" ".join(map(repr, row)) + "\n" for row in self.T_aligned_from_scan.tolist())


def read_alignment(path: Path) -> Alignment:
    """The alignment in a file by Alignment.to_json; InputError if it is not one."""
    document = read_json(path, "use a transform by align_gravity.py", MAX_FILE_SIZE)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(f"{path}: the format is not {FORMAT!r}; use a transform by align_gravity.py")
    T = _rigid(path, document.get("T_aligned_from_scan"))
    metres_per_unit = _number(path, document, "metres_per_unit", UNIT_RANGE)
    confidence = _number(path, document, "confidence", (0.0, 1.0))
    return Alignment(T, metres_per_unit, confidence, str(document.get("explanation", "")))


def _number(path: Path, document: dict[str, object], name: str, limits: tuple[float, float]) -> float:
    """A field within limits."""
    value, (low, high) = document.get(name), limits
    if isinstance(value, int | float) and low <= value <= high:
        return float(value)
    raise InputError(f"{path}: {name} is {value!r:.40}, must be a number from {low:g} to {high:g}")


def _rigid(path: Path, rows: object) -> Array:
    """A transform (4, 4) of nested lists; refused if it is not a rotation and a translation."""
    try:
        T = np.array(rows)
    except ValueError as error:  # rows of several lengths
        raise InputError(f"{path}: T_aligned_from_scan is not four rows of four numbers") from error
    if T.shape != (4, 4) or T.dtype.kind not in "if":
        raise InputError(f"{path}: T_aligned_from_scan is not four rows of four numbers")
    if not np.isfinite(T).all() or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{path}: T_aligned_from_scan is not a rotation and a translation")
    checked_rotation(T[:3, :3], ROUNDING, f"{path}: the matrix in T_aligned_from_scan")
    return T.astype(np.float64)


class AlignmentReport(NamedTuple):
    """An alignment with the evidence for it."""

    alignment: Alignment
    up_scan: Array  # (3,) unit vector that points up, in the scan's frame
    plane_rms_angle: float | None  # of level and upright planes to up [rad]
    yaw: float | None  # turn about z that put the walls along the axes [rad]
    planes: list[Plane]  # in the scan's frame, metres
    hypotheses: tuple[Hypothesis, ...]  # for up, the likeliest first; none if the axis was given


def find_alignment(
    cloud: CloudStream,
    up: UpAxis,
    along_walls: bool,
    z_up_log_odds: float = Z_UP_LOG_ODDS,
    settle: Callable[[Up], Up] | None = None,
) -> tuple[AlignmentReport, tuple[str, ...]]:
    """The turn of a cloud that makes z up, about the middle of its box in whole metres; and warnings.

    An axis given as `up` is taken as it is; `auto` finds it, with the log-odds of the convention that z is
    up (0: the scan may lie anyhow), and `settle` may choose another of its hypotheses. With `along_walls` the
    dominant walls come to stand along x and y by the smallest turn about z.
    """
    voxels = cloud.voxels(np.eye(3))
    sample = normals_of(voxels)
    planes = ransac_planes(sample)
    if up == "auto":
        found = find_up(sample, z_up_log_odds, cloud.station_axes)
        found = settle(found) if settle else found
        direction, rms_angle = refine_up(found.direction_world, planes)
    else:
        found, rms_angle = Up(named_axis(up), 1.0, f"up is the axis {up}, as given"), None
        direction = found.direction_world
    planes = classify_planes(planes, sample, direction)
    R = rotation_to_z_up(direction)
    yaw = manhattan_yaw(planes, R) if along_walls else None
    if yaw is not None:
        R = np.einsum("ij,jk->ik", yaw_rotation(-yaw), R)
    R = orthonormal(R)
    T = np.eye(4)  # turns about the middle
    T[:3, :3], T[:3, 3] = R + 0.0, voxels.origin - np.einsum("ij,j->i", R, voxels.origin) + 0.0
    alignment = Alignment(T, 1.0, found.confidence, found.reason).in_unit(cloud.scale)
    in_scan = [
        plane._replace(offset=plane.offset + float(np.einsum("i,i->", plane.normal_world, voxels.origin)))
        for plane in planes
    ]
    report = AlignmentReport(alignment, direction, rms_angle, yaw, in_scan, found.hypotheses)
    return report, voxels.warnings


def normals_of(voxels: Voxels) -> PointNormals:
    """Normals of a cloud thinned to SPACING."""
    return estimate_normals(build_octree(voxels).level(SPACING)[:, :3])
