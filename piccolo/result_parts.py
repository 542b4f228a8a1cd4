"""The parts of a result as JSON, and back."""

from dataclasses import asdict, fields
from typing import Any

import numpy as np

from .confidence.covariance import PoseCovariance
from .confidence.localization import Alternative
from .geometry.pose import Pose, T_world_from_cam, quaternion_wxyz
from .scan_map.prior import GpsPrior
from .walk.localize import Alone, Gap, WalkFrame

POSE_FIELDS = ("R_cam_from_world", "center_world", "quaternion_wxyz", "T_world_from_cam")


def _rotation_and_center(pose: Pose) -> dict[str, object]:
    return {"R_cam_from_world": pose.R_cam_from_world.tolist(), "center_world": pose.center_world.tolist()}


def pose_json(pose: Pose | None) -> dict[str, object] | None:
    """A pose in all its forms, POSE_FIELDS."""
    if pose is None:
        return None
    quaternion, T = quaternion_wxyz(pose.R_cam_from_world), T_world_from_cam(pose)
    other = {"quaternion_wxyz": quaternion.tolist(), "T_world_from_cam": T.tolist()}
    return {**_rotation_and_center(pose), **other}


def gps_prior_from_json(value: dict[str, Any] | None) -> GpsPrior | None:
    """Read back `gps_prior`."""
    return (
        None if value is None else GpsPrior(tuple(value["center_world"]), value["radius"], value["is_used"])
    )


def covariance_from_json(document: dict[str, Any]) -> PoseCovariance | None:
    """The covariance in the fields of a result."""
    matrix = document["covariance"]
    return (
        None if matrix is None else PoseCovariance(np.array(matrix), document["least_constrained_direction"])
    )


def alternative_json(alternative: Alternative) -> dict[str, object]:
    """An alternative: its pose as rotation and centre, and what speaks for it."""
    numbers = {f.name: getattr(alternative, f.name) for f in fields(alternative) if f.name != "pose"}
    return _rotation_and_center(alternative.pose) | numbers


def alternative_from_json(document: dict[str, Any]) -> Alternative:
    """Read back an alternative."""
    pose = Pose(np.array(document["R_cam_from_world"]), np.array(document["center_world"]))
    return Alternative(pose, **{f.name: document[f.name] for f in fields(Alternative) if f.name != "pose"})


def walk_json(walk: WalkFrame) -> dict[str, object]:
    """What a walk says of a frame."""
    alone: dict[str, object] | None = None
    if walk.alone is not None:
        about = {"status": walk.alone.status, "confidence": walk.alone.confidence}
        alone = {**about, **(pose_json(walk.alone.pose) or dict.fromkeys(POSE_FIELDS))}
    return {
        "frame": walk.frame,
        "time": walk.time,
        "how": walk.how,
        "alone": alone,
        "gap": walk.gap and asdict(walk.gap),
    }


def walk_from_json(value: dict[str, Any]) -> WalkFrame:
    """Read back `walk`."""
    gap, alone = value["gap"], value["alone"]
    if alone is not None:
        R, center = alone["R_cam_from_world"], alone["center_world"]
        pose = None if R is None else Pose(np.array(R), np.array(center))
        alone = Alone(alone["status"], alone["confidence"], pose)
    return WalkFrame(value["time"], value["frame"], value["how"], alone, gap and Gap(**gap))
