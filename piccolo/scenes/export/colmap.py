"""COLMAP's text model: T_cam_from_world, camera axes right, down, forward.

https://colmap.github.io/format.html
The camera model EQUIRECTANGULAR came with COLMAP 4; its parameters are the width and height. Its pixels are
ours: the first pixel's centre is at (0.5, 0.5).
"""

from collections.abc import Sequence
from pathlib import Path

from ...geometry.camera_axes import OPTICAL_FROM_CAM, translation, turned
from ...geometry.pose import quaternion_wxyz
from ...runtime.atomic import replacing_folder
from .model import Format, Options, PosedImage
from .pose_lists import numbers, offset_comment, write_lines


def write(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write cameras.txt, images.txt and a points3D.txt without points into a new folder."""
    camera_ids = {size: i for i, size in enumerate(dict.fromkeys(image.size for image in images), 1)}
    with replacing_folder(out) as folder:
        comments = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *offset_comment(options)]
        cameras = [f"{i} EQUIRECTANGULAR {w} {h} {w} {h}" for (w, h), i in camera_ids.items()]
        write_lines(folder / "cameras.txt", [*comments, *cameras])
        comments = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of points"]
        lines = [_image_line(i, image, camera_ids[image.size]) for i, image in enumerate(images, 1)]
        write_lines(folder / "images.txt", [*comments, *offset_comment(options), *lines])
        write_lines(folder / "points3D.txt", ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"])


def _image_line(image_id: int, image: PosedImage, camera_id: int) -> str:
    """The line of an image, and the empty one of its points."""
    pose = turned(image.pose, OPTICAL_FROM_CAM)
    values = [*quaternion_wxyz(pose.R_cam_from_world), *translation(pose)]
    return f"{image_id} {numbers(values)} {camera_id} {image.name}\n"


# COLMAP reads a name up to the first blank
COLMAP = Format(
    "colmap",
    "text model of COLMAP 4 and pycolmap; --out is a new folder",
    write,
    frozenset({"size", "offset"}),
    is_folder=True,
    forbidden=" ",
)
