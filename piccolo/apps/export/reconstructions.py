"""Files of nerfstudio and OpenSfM: cameras with their poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...cloud.writers import vertex_rows, writing_ply
from ...geometry.pose import OPENGL_FROM_CAM, OPTICAL_FROM_CAM, log_so3, translation, turn_axes
from ...photo.camera import Camera
from ...photo.camera.model import EQUIDISTANT, PERSPECTIVE, SPHERE
from ...system.errors import InputError
from ...system.files.atomic import json_text, write_json
from .posed_images import Lenses, Options, PosedImage, write_with_offset
from .scan_points import find_points

FISHEYE = "k1", "k2", "k3", "k4"
NERFSTUDIO_LENSES: Lenses = {
    SPHERE: ("EQUIRECTANGULAR", ()),
    PERSPECTIVE: ("OPENCV", (*FISHEYE, "p1", "p2")),
    EQUIDISTANT: ("OPENCV_FISHEYE", FISHEYE),
}
OPENSFM_LENSES: Lenses = {
    SPHERE: ("spherical", ()),
    PERSPECTIVE: ("brown", ("k1", "k2", "k3", "p1", "p2")),
    EQUIDISTANT: ("fisheye_opencv", FISHEYE),
}


def write_nerfstudio(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write transforms.json: T_world_from_cam, camera axes right, up, back; the offset is applied_transform.

    Rays of EQUIRECTANGULAR in nerfstudio/cameras/cameras.py: theta = -pi (x - cx) / fl_x,
    phi = pi (1/2 + (y - cy) / fl_y), direction (-sin theta sin phi, cos phi, -cos theta sin phi): the image
    centre looks along -z. Points go to a PLY file beside, as ply_file_path.
    """
    models = {NERFSTUDIO_LENSES[image.lens.lens][0] for image in images}
    if len(models) > 1:
        found = f"found the camera models {', '.join(sorted(models))}"
        raise InputError(f"{images[0].path}: {found}, wanted one for nerfstudio; `faces` makes pinholes")
    document: dict[str, object] = {"camera_model": next(iter(models))}
    is_one_lens = len({image.lens for image in images}) == 1
    if is_one_lens:
        document |= _intrinsics(images[0].lens)
    if options.offset is not None:
        moved = np.column_stack([np.eye(3), -np.array(options.offset)])
        document["applied_transform"] = moved.tolist()
    if options.points is not None:
        found_points = find_points(images, options)
        document["ply_file_path"] = points_file(out).name
        with writing_ply(points_file(out)) as ply:
            ply.add(vertex_rows(found_points.xyz.astype(np.float32), found_points.rgb))
    frames = []
    for image in images:
        own: dict[str, object] = {} if is_one_lens else {**_intrinsics(image.lens)}
        own |= {"mask_path": image.mask} if image.mask else {}
        matrix = turn_axes(image.pose, OPENGL_FROM_CAM).T_world_from_cam.tolist()
        frames.append({"file_path": image.name, **own, "transform_matrix": matrix})
    write_json(out, document | {"frames": frames})


def points_file(out: Path) -> Path:
    """Return the file of the scan's points beside a transforms.json."""
    return out.with_suffix(".ply")


def _intrinsics(lens: Camera) -> dict[str, float]:
    """Return size and lengths [px]; of a sphere x - cx is +-fl_x at the seam, y - cy +-fl_y / 2 at a pole."""
    w = lens.width
    h = lens.height
    size = {"w": w, "h": h}
    if lens.lens == SPHERE:
        return {**size, "fl_x": w / 2, "fl_y": float(h), "cx": w / 2, "cy": h / 2}
    named = dict(zip(("fl_x", "fl_y", "cx", "cy"), (*lens.focal, *lens.center), strict=True))
    _, names = NERFSTUDIO_LENSES[lens.lens]
    return size | named | {name: getattr(lens.distortion, name) for name in names}


def write_opensfm(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a list of one reconstruction without points. Camera axes right, down, forward.

    https://opensfm.org/docs/geometry.html: rotation is an angle-axis vector and translation t of
    x_cam = R x_world + t. Its spherical camera takes the sphere to be W = 2 H exactly. Other
    lengths are parts of the larger side, from the picture's middle.
    """
    cameras: dict[str, dict[str, object]] = {}
    shots = {}
    for image in images:
        camera = _opensfm_camera(image.lens)
        number = next((name for name, other in cameras.items() if other == camera), f"camera {len(cameras)}")
        cameras[number] = camera
        pose = turn_axes(image.pose, OPTICAL_FROM_CAM)
        rotation = log_so3(pose.R_cam_from_world).tolist()
        shot = {"rotation": rotation, "translation": translation(pose).tolist(), "camera": number}
        shots[image.name] = shot
    write_with_offset(out, json_text([{"cameras": cameras, "shots": shots, "points": {}}]), options)


def _opensfm_camera(lens: Camera) -> dict[str, object]:
    """Return a camera as `calibration.OPENSFM` reads it."""
    projection, names = OPENSFM_LENSES[lens.lens]
    camera: dict[str, object] = {"projection_type": projection, "width": lens.width, "height": lens.height}
    if lens.lens == SPHERE:
        return camera
    larger = max(lens.width, lens.height)
    c_x, c_y = lens.center
    lengths = (*lens.focal, c_x - lens.width / 2, c_y - lens.height / 2)
    keys = "focal_x", "focal_y", "c_x", "c_y"
    camera |= {key: length / larger for key, length in zip(keys, lengths, strict=True)}
    return camera | {name: getattr(lens.distortion, name) for name in names}


def check_shape(image: PosedImage) -> None:
    """Refuse a sphere that OpenSfM can't take."""
    width, height = image.size
    if image.camera is None and width != 2 * height:
        raise InputError(f"{image.path}: found {width} x {height}, wanted W = 2 H exactly for OpenSfM")
