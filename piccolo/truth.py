"""True poses, and how far a pose is from them."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .pose import Pose, angle_between

MAX_DISTANCE, MAX_ANGLE = 0.1, math.radians(5.0)  # the paper's line between correct and wrong [m], [rad]


@dataclass(frozen=True)
class Query:
    """A panorama with its true pose."""

    variant: str
    pose: Pose


def read_truth(path: Path) -> dict[str, Query]:
    """The queries of a queries.json by file name."""
    try:
        entries = json.loads(path.read_text())["queries"]
        return {Path(entry["image"]).name: Query(entry["variant"], _pose(entry)) for entry in entries}
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: found {error!r}, wanted a queries.json with true poses") from error


def _pose(entry: dict[str, Any]) -> Pose:
    """The pose of a query; ValueError unless it is as many finite numbers as a pose has."""
    R, center = np.array(entry["R_cam_from_world"], float), np.array(entry["center_world"], float)
    if R.shape != (3, 3) or center.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(center).all()):
        raise ValueError("a pose that is not 3 x 3 and 3 finite numbers")
    return Pose(R, center)


def pose_errors(pose: Pose, true_pose: Pose) -> tuple[float, float]:
    """Position error [m] and rotation error [rad]."""
    distance = float(np.linalg.norm(pose.center_world - true_pose.center_world))
    return distance, angle_between(pose.R_cam_from_world, true_pose.R_cam_from_world)


def is_correct(pose: Pose | None, true_pose: Pose) -> bool:
    """True for a pose that counts as correct in the paper."""
    if pose is None:
        return False
    distance, angle = pose_errors(pose, true_pose)
    return distance < MAX_DISTANCE and angle < MAX_ANGLE
