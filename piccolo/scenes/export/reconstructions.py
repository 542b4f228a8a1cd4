"""Poses as models of COLMAP, nerfstudio and OpenSfM."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.camera_axes import OPENGL_FROM_CAM, OPTICAL_FROM_CAM, translation, turned
from ...geometry.pose import T_world_from_cam, log_so3, quaternion_wxyz
from ...runtime.atomic import replacing_folder, write_atomically
from .pose_lists import numbers, offset_comment, write_lines, write_offset_beside
from .posed_images import Format, Options, PosedImage


def write_colmap(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write cameras.txt, images.txt and a points3D.txt without points into a new folder.

    https://colmap.github.io/format.html: T_cam_from_world, camera axes right, down, forward. The camera model
    EQUIRECTANGULAR came with COLMAP 4; its parameters are the width and height. Its pixels are ours.
    """
    camera_ids = {size: i for i, size in enumerate(dict.fromkeys(image.size for image in images), 1)}
    cameras = [f"{i} EQUIRECTANGULAR {w} {h} {w} {h}" for (w, h), i in camera_ids.items()]
    lines = []
    for i, image in enumerate(images, 1):
        pose = turned(image.pose, OPTICAL_FROM_CAM)
        values = numbers([*quaternion_wxyz(pose.R_cam_from_world), *translation(pose)])
        lines += [f"{i} {values} {camera_ids[image.size]} {image.name}", ""]  # a line of points follows
    offset = offset_comment(options)
    with replacing_folder(out) as folder:
        comment = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
        write_lines(folder / "cameras.txt", [comment, *offset, *cameras])
        comment = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of points"
        write_lines(folder / "images.txt", [comment, *offset, *lines])
        write_lines(folder / "points3D.txt", ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"])


def write_nerfstudio(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write transforms.json: T_world_from_cam, camera axes right, up, back; the offset is applied_transform.

    Rays of EQUIRECTANGULAR in nerfstudio/cameras/cameras.py: theta = -pi (x - cx) / fl_x,
    phi = pi (1/2 + (y - cy) / fl_y), direction (-sin theta sin phi, cos phi, -cos theta sin phi): the image
    centre looks along -z.
    """
    is_one_size = len({image.size for image in images}) == 1
    document: dict[str, object] = {"camera_model": "EQUIRECTANGULAR"}
    if is_one_size:
        document |= _intrinsics(images[0].size)
    if options.offset is not None:
        moved = np.column_stack([np.eye(3), -np.array(options.offset)])
        document["applied_transform"] = moved.tolist()
    frames = []
    for image in images:
        own = {} if is_one_size else _intrinsics(image.size)
        matrix = T_world_from_cam(turned(image.pose, OPENGL_FROM_CAM)).tolist()
        frames.append({"file_path": image.name, **own, "transform_matrix": matrix})
    write_json(out, document | {"frames": frames})


def _intrinsics(size: tuple[int, int]) -> dict[str, float]:
    """The sphere as a focal length: x - cx reaches +-fl_x at the seam, y - cy +-fl_y / 2 at the poles."""
    w, h = size
    return {"w": w, "h": h, "fl_x": w / 2, "fl_y": float(h), "cx": w / 2, "cy": h / 2}


def write_opensfm(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a list of one reconstruction without points. Camera axes right, down, forward.

    https://opensfm.org/docs/geometry.html: rotation is an angle-axis vector and translation t of
    x_cam = R x_world + t. Its spherical camera takes the sphere to be W = 2 H exactly.
    """
    cameras, shots = {}, {}
    for image in images:
        width, height = image.size
        if width != 2 * height:
            raise InputError(f"{image.path}: found {width} x {height}, wanted W = 2 H exactly for OpenSfM")
        camera = f"spherical {width} {height}"
        cameras[camera] = {"projection_type": "spherical", "width": width, "height": height}
        pose = turned(image.pose, OPTICAL_FROM_CAM)
        rotation, t = log_so3(pose.R_cam_from_world).tolist(), translation(pose).tolist()
        shots[image.name] = {"rotation": rotation, "translation": t, "camera": camera}
    write_offset_beside(out, options)
    write_json(out, [{"cameras": cameras, "shots": shots, "points": {}}])


def write_json(out: Path, document: object) -> None:
    """Write a JSON file."""
    write_atomically(out, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


TAKEN = frozenset({"size", "offset"})
TEXT = "text model of COLMAP 4 and pycolmap; --out is a new folder"
COLMAP = Format("colmap", TEXT, write_colmap, TAKEN, is_folder=True, forbidden=" ")  # a name ends at a blank
TEXT = "transforms.json of nerfstudio, in the folder that --images names"
NERFSTUDIO = Format("nerfstudio", TEXT, write_nerfstudio, TAKEN)
OPENSFM = Format("opensfm", "reconstruction.json of OpenSfM", write_opensfm, TAKEN)
