"""OpenSfM's reconstruction.json: https://opensfm.org/docs/geometry.html. Camera axes right, down, forward.

rotation is an angle-axis vector and translation t of x_cam = R x_world + t. Its spherical camera takes the
sphere to be W = 2 H exactly.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from ...errors import InputError
from ...geometry.camera_axes import OPTICAL_FROM_CAM, translation, turned
from ...geometry.pose import log_so3
from ...runtime.atomic import write_atomically
from .model import Format, Options, PosedImage
from .pose_lists import write_offset_beside


def write(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write one JSON file: a list of one reconstruction without points."""
    cameras, documents = {}, {}
    for image in images:
        width, height = image.size
        if width != 2 * height:
            raise InputError(f"{image.path}: found {width} x {height}, wanted W = 2 H exactly for OpenSfM")
        camera = f"spherical {width} {height}"
        cameras[camera] = {"projection_type": "spherical", "width": width, "height": height}
        pose = turned(image.pose, OPTICAL_FROM_CAM)
        documents[image.name] = {
            "rotation": log_so3(pose.R_cam_from_world).tolist(),
            "translation": translation(pose).tolist(),
            "camera": camera,
        }
    write_offset_beside(out, options)
    reconstruction = {"cameras": cameras, "shots": documents, "points": {}}
    write_atomically(out, (json.dumps([reconstruction], indent=1, allow_nan=False) + "\n").encode())


OPENSFM = Format("opensfm", "reconstruction.json of OpenSfM", write, frozenset({"size", "offset"}))
