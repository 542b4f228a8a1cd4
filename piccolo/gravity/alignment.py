"""A scan's z turned up: the transform, what it is based on, and the file that holds it."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..cloud import CloudStream
from ..cloud.octree import build_octree
from ..cloud.settings import UpAxis
from ..errors import InputError
from ..geometry.pose import Array, Pose, checked_rotation, orthonormal
from ..runtime.json_file import read_json
from . import (
    Plane,
    Up,
    find_planes,
    name_planes,
    named_axis,
    refine_up,
    rotation_to_z_up,
    surfaces_of,
    up_of,
    wall_yaw,
    yaw_turn,
)

FORMAT = "piccolo-alignment/1"
CONVENTION = "x_aligned = T_aligned_from_scan @ (x_scan, 1) in the unit given; z_aligned is up"
SPACING = 0.08  # of the points that are looked at [m]
NO_CONVENTION = 0.0  # log-odds of z up: a scan that is to be aligned may lie anyhow
MAX_FILE_SIZE = 1 << 20  # [byte]
MAX_NUMBER = 1e300  # that is read as one
ROUNDING = 1e-6  # of a rotation's numbers in a file


@dataclass(frozen=True)
class Alignment:
    """A rigid transform of a scan, and how far it can be relied on."""

    T_aligned_from_scan: Array  # (4, 4) in the unit of the files
    metres_per_unit: float
    confidence: float  # [0, 1] that up is up
    explanation: str  # one line

    def in_unit(self, metres_per_unit: float) -> "Alignment":
        """The same transform for coordinates in another unit."""
        T = self.T_aligned_from_scan.copy()
        T[:3, 3] *= self.metres_per_unit / metres_per_unit
        return replace(self, T_aligned_from_scan=T, metres_per_unit=metres_per_unit)

    def inverse(self) -> "Alignment":
        """The way back, from aligned coordinates to the scan's."""
        T, R = np.eye(4), self.T_aligned_from_scan[:3, :3]
        T[:3, :3] = R.T
        T[:3, 3] = -np.einsum("ji,j->i", R, self.T_aligned_from_scan[:3, 3]) + 0.0
        return replace(self, T_aligned_from_scan=T)

    def moved(self, pose: Pose) -> Pose:
        """A pose of the scan in aligned coordinates, both in the unit of the transform."""
        R, t = self.T_aligned_from_scan[:3, :3], self.T_aligned_from_scan[:3, 3]
        return Pose(orthonormal(pose.R_cam_from_world @ R.T), R @ pose.center_world + t)

    def to_json(self) -> str:
        """One JSON object; every number reads back as the same float64."""
        document = {
            "format": FORMAT,
            "convention": CONVENTION,
            "T_aligned_from_scan": self.T_aligned_from_scan.tolist(),
            "metres_per_unit": self.metres_per_unit,
            "confidence": self.confidence,
            "explanation": self.explanation,
        }
        return json.dumps(document, indent=1, allow_nan=False) + "\n"

    def to_text(self) -> str:
        """Four rows of four numbers, as CloudCompare reads and writes a transform."""
        return "".join(" ".join(map(repr, row)) + "\n" for row in self.T_aligned_from_scan.tolist())


@dataclass(frozen=True)
class Finding:
    """An alignment with the evidence for it."""

    alignment: Alignment
    up_scan: Array  # (3,) unit vector that points up, in the scan's frame
    spread: float | None  # rms angle between up and the planes that have a say [rad]
    yaw: float | None  # turn about z that put the walls along the axes [rad]
    planes: list[Plane]  # in the scan's frame, metres


def find_alignment(cloud: CloudStream, up: UpAxis, along_walls: bool) -> tuple[Finding, tuple[str, ...]]:
    """The turn of a cloud that makes z up, about the middle of its box in whole metres; and warnings.

    An axis given as `up` is taken as it is; `auto` finds it. With `along_walls` the dominant walls come to
    stand along x and y by the smallest turn about z.
    """
    voxels = cloud.voxels(np.eye(3))
    surfaces = surfaces_of(build_octree(voxels).level(SPACING)[:, :3])
    planes = find_planes(surfaces)
    found, spread = _up_by(up), None
    if found is None:
        found = up_of(surfaces, NO_CONVENTION)
        direction, spread = refine_up(found.direction_world, planes)
        found = replace(found, direction_world=direction)
    planes = name_planes(planes, surfaces, found.direction_world)
    R = rotation_to_z_up(found.direction_world)
    yaw = wall_yaw(planes, R) if along_walls else None
    if yaw is not None:
        R = np.einsum("ij,jk->ik", yaw_turn(yaw), R)
    T = _about(voxels.origin, orthonormal(R))
    alignment = Alignment(T, 1.0, found.confidence, found.reason).in_unit(cloud.scale)
    shifted = [
        replace(plane, offset=plane.offset + float(np.einsum("i,i->", plane.normal_world, voxels.origin)))
        for plane in planes
    ]
    return Finding(alignment, found.direction_world, spread, yaw, shifted), voxels.warnings


def _up_by(up: UpAxis) -> Up | None:
    """The axis that the user gave, for certain."""
    if up == "auto":
        return None
    return Up(named_axis(up) + 0.0, 1.0, f"up is the axis {up}, as given")


def _about(origin: Array, R: Array) -> Array:
    """The transform (4, 4) that turns by R (3, 3) about a point (3,)."""
    T = np.eye(4)
    T[:3, :3] = R + 0.0
    T[:3, 3] = origin - np.einsum("ij,j->i", R, origin) + 0.0
    return T


def read_alignment(path: Path) -> Alignment:
    """The alignment in a file by Alignment.to_json; InputError if it is not one."""
    document = read_json(path, "wanted a transform by align_gravity.py", MAX_FILE_SIZE)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(f"{path}: found no format {FORMAT!r}, wanted a transform by align_gravity.py")
    T = _rigid(path, document.get("T_aligned_from_scan"))
    metres_per_unit = _number(path, document, "metres_per_unit", math.inf)
    confidence = _number(path, document, "confidence", 1.0)
    if metres_per_unit == 0.0:
        raise InputError(f"{path}: found metres_per_unit 0, wanted a number above 0")
    return Alignment(T, metres_per_unit, confidence, str(document.get("explanation", "")))


def _number(path: Path, document: dict[str, object], name: str, most: float) -> float:
    """A finite field between 0 and `most`."""
    value = document.get(name)
    if _is_number(value) and isinstance(value, int | float) and 0.0 <= value <= min(most, MAX_NUMBER):
        return float(value)
    raise InputError(f"{path}: found {name} {value!r:.40}, wanted a number from 0 to {most:g}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _rigid(path: Path, rows: object) -> Array:
    """A transform (4, 4) of nested lists; refused if it is not a turn and a shift."""
    is_square = (
        isinstance(rows, list)
        and len(rows) == 4
        and all(isinstance(row, list) and len(row) == 4 and all(map(_is_number, row)) for row in rows)
    )
    if not is_square:
        raise InputError(f"{path}: T_aligned_from_scan is no four rows of four numbers, wanted a transform")
    try:
        T = np.array(rows, dtype=np.float64)
    except OverflowError as error:
        raise InputError(f"{path}: T_aligned_from_scan has a number beyond float64") from error
    if not (np.isfinite(T).all() and np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0])):
        raise InputError(f"{path}: T_aligned_from_scan is not finite, or its last row is not 0 0 0 1")
    checked_rotation(T[:3, :3], ROUNDING, f"{path}: the matrix in T_aligned_from_scan")
    return T
