"""Poses of photos in JSON: nerfstudio's transforms.json, and models of OpenSfM, OpenMVG and Meshroom."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..geometry.pose import OPENGL_FROM_CAM, OPTICAL_FROM_CAM, Pose, check_transform, exp_so3
from ..photo.camera.foreign import is_reconstruction
from ..system.arrays import Array
from ..system.errors import InputError
from ..system.files.json_file import naming, read_json
from .bundle_adjustment import RelativeScale

SUFFIXES = (".json", ".sfm")
NO_RIG = 0xFFFFFFFF  # Meshroom's number of a view that is of no rig
NamedPose = tuple[str, Pose]
Transform = tuple[str, Array]  # T_cam_from_world, or T_world_from_cam (3 or 4, 4)


class JsonForm(NamedTuple):
    """A format of poses in JSON."""

    is_of: Callable[[Any], bool]
    read: Callable[[Any], Iterator[Transform]]
    other_from_cam: Array
    is_from_world: bool
    scale: RelativeScale


def read_json_poses(path: Path, wanted: str) -> tuple[list[NamedPose], RelativeScale]:
    """Return the poses in a file with the photos' names, and the unit of their positions."""
    document = read_json(path, wanted)
    form = next((form for form in FORMS if form.is_of(document)), FORMS[-1])
    with naming(path, wanted):
        found = [
            (name, check_transform(T, name, form.other_from_cam, is_from_world=form.is_from_world))
            for name, T in form.read(document)
        ]
    return found, form.scale


def _of_transforms(document: Any) -> Iterator[Transform]:
    for frame in document["frames"]:
        T = np.array(frame["transform_matrix"], float)
        if T.shape != (4, 4):
            raise ValueError(f"a transform_matrix of shape {T.shape}")
        yield str(frame["file_path"]), T


def _of_opensfm(document: Any) -> Iterator[Transform]:
    """Yield shots; rotation is an angle-axis vector: https://opensfm.org/docs/geometry.html."""
    if len(document) != 1:
        raise ValueError(f"{len(document)} reconstructions of OpenSfM, which have nothing in common")
    for name, shot in document[0]["shots"].items():
        yield name, transform_of_shot(shot)


def transform_of_shot(shot: Any) -> Array:
    """Return the T_cam_from_world (3, 4) of what has a rotation and a translation in OpenSfM's files."""
    rotation, translation = (np.array(shot[key], float).reshape(3) for key in ("rotation", "translation"))
    return np.column_stack([exp_so3(rotation), translation])


def _of_openmvg(document: Any) -> Iterator[Transform]:
    poses = {entry["key"]: entry["value"] for entry in document["extrinsics"]}
    for entry in document["views"]:
        view = entry["value"]["ptr_wrapper"]["data"]
        if view["id_pose"] in poses:
            pose = poses[view["id_pose"]]
            yield str(view["filename"]), _with_center(np.array(pose["rotation"], float), pose["center"])


def _of_meshroom(document: Any) -> Iterator[Transform]:
    """Yield views; AliceVision writes the nine numbers of a matrix column after column."""
    poses = {entry["poseId"]: entry["pose"]["transform"] for entry in document["poses"]}
    for view in document["views"]:
        if int(view.get("rigId", NO_RIG)) != NO_RIG:
            raise ValueError("a rig of Meshroom, which is not read: export COLMAP's")
        if view["poseId"] in poses:
            pose = poses[view["poseId"]]
            R = np.array(pose["rotation"], float).reshape(3, 3).T
            yield str(view["path"]), _with_center(R, pose["center"])


def _with_center(R_cam_from_world: Array, center: Any) -> Array:
    return np.column_stack([R_cam_from_world, -R_cam_from_world @ np.array(center, float)])


def _has(*fields: str) -> Callable[[Any], bool]:
    return lambda document: isinstance(document, dict) and {*fields} <= {*document}


FORMS = (
    JsonForm(is_reconstruction, _of_opensfm, OPTICAL_FROM_CAM, True, "unknown"),
    JsonForm(_has("sfm_data_version", "extrinsics"), _of_openmvg, OPTICAL_FROM_CAM, True, "unknown"),
    JsonForm(_has("views", "poses"), _of_meshroom, OPTICAL_FROM_CAM, True, "unknown"),
    JsonForm(_has("frames"), _of_transforms, OPENGL_FROM_CAM, False, "metres"),
)


def read_reconstruction(path: Path, wanted: str) -> Any:
    """Return the parts of OpenSfM's reconstruction.json; `wanted` says in an error what it should hold."""
    document = read_json(path, wanted)
    if not is_reconstruction(document):
        raise InputError(f"{path}: found no reconstruction of OpenSfM, {wanted}")
    return document
