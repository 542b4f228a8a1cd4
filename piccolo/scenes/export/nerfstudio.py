"""nerfstudio's transforms.json: T_world_from_cam, camera axes right, up, back.

Rays of EQUIRECTANGULAR in nerfstudio/cameras/cameras.py: theta = -pi (x - cx) / fl_x,
phi = pi (1/2 + (y - cy) / fl_y), direction (-sin theta sin phi, cos phi, -cos theta sin phi): the image
centre looks along -z.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...geometry.camera_axes import OPENGL_FROM_CAM, turned
from ...geometry.pose import T_world_from_cam
from ...runtime.atomic import write_atomically
from .model import Format, Options, PosedImage


def write(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write one JSON file; the offset is its applied_transform."""
    sizes = {image.size for image in images}
    document: dict[str, object] = {"camera_model": "EQUIRECTANGULAR"}
    if len(sizes) == 1:
        document |= _intrinsics(images[0].size)
    if options.offset is not None:
        moved = np.column_stack([np.eye(3), -np.array(options.offset)])
        document["applied_transform"] = moved.tolist()
    document["frames"] = [
        {
            "file_path": image.name,
            **(_intrinsics(image.size) if len(sizes) > 1 else {}),
            "transform_matrix": T_world_from_cam(turned(image.pose, OPENGL_FROM_CAM)).tolist(),
        }
        for image in images
    ]
    write_atomically(out, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def _intrinsics(size: tuple[int, int]) -> dict[str, float]:
    """The sphere as a focal length: x - cx reaches +-fl_x at the seam, y - cy +-fl_y / 2 at the poles."""
    width, height = size
    return {
        "w": width,
        "h": height,
        "fl_x": width / 2,
        "fl_y": float(height),
        "cx": width / 2,
        "cy": height / 2,
    }


NERFSTUDIO = Format(
    "nerfstudio",
    "transforms.json of nerfstudio, in the folder that --images names",
    write,
    frozenset({"size", "offset"}),
)
