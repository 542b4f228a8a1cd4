"""Models of COLMAP, as text and binary files: cameras, images, and points of the scan with their tracks.

https://colmap.github.io/format.html: T_cam_from_world, camera axes right, down, forward; pixels are ours.
Panoramas have the camera model EQUIRECTANGULAR, which came with COLMAP 4: its parameters are the width and
height. Photos have their own models, which are COLMAP's; of a rig each picture is an image.
"""

import errno
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ...geometry.pose import OPTICAL_FROM_CAM, translation, turn_axes
from ...photo.camera.model import CUT_SPHERE
from ...system.errors import InputError, import_optional
from ...system.files.atomic import library_writing, replacing_folder
from .posed_images import Options, PosedImage, write_offset_beside
from .scan_points import find_points

ERRORS = ValueError, RuntimeError, IndexError  # of pycolmap


def write_colmap(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a model into a new folder: a copy of that in `options.into`, or an empty one, and the images."""
    pycolmap = import_optional("COLMAP", "pycolmap", "colmap")
    model = pycolmap.Reconstruction() if options.into is None else read_model(options.into)
    if twice := {image.name for image in model.images.values()} & {image.name for image in images}:
        raise InputError(f"{options.into}: found the image {min(twice)} in the model, wanted new ones only")
    scan_points = find_points(images, options)
    first_camera = max([*model.cameras, *model.rigs, 0]) + 1
    first_image = max([*model.images, *model.frames, 0]) + 1
    cameras = list(dict.fromkeys(image.lens for image in images))
    for number, lens in enumerate(cameras, first_camera):
        camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params)
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
    tracks: list[list[Any]] = [[] for _ in scan_points.xyz]
    for number, (image, seen) in enumerate(zip(images, scan_points.seen, strict=True), first_image):
        camera_id = first_camera + cameras.index(image.lens)
        made = pycolmap.Image(image.name, seen.pixels, camera_id, number)
        pose = turn_axes(image.pose, OPTICAL_FROM_CAM)
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.R_cam_from_world), translation(pose))
        model.add_image_with_trivial_frame(made, rigid)
        for index, point in enumerate(seen.points.tolist()):
            tracks[point].append(pycolmap.TrackElement(number, index))
    for xyz, rgb, track in zip(scan_points.xyz, scan_points.rgb, tracks, strict=True):
        point = model.add_point3D(xyz, pycolmap.Track(track), rgb)
        model.point3D(point).error = 0.0
    write_model(model, out, partial(write_offset_beside, out, options))


def check_model(image: PosedImage) -> None:
    """Refuse a part of a panorama, whose camera model COLMAP does not have."""
    if image.lens.model == CUT_SPHERE:
        raise InputError(f"{image.path}: found the model {CUT_SPHERE}, wanted one that COLMAP has")


def read_model(folder: Path) -> Any:
    """Return the model in a folder, text or binary, as a pycolmap.Reconstruction; InputError for none."""
    pycolmap = import_optional("COLMAP", "pycolmap", "colmap")
    try:
        return pycolmap.Reconstruction(folder)
    except ERRORS as error:
        wanted = "wanted the folder of a model of COLMAP (cameras, images, points3D as .bin or .txt)"
        raise InputError(f"{folder}: found {' '.join(str(error).split())[-200:]}, {wanted}") from error


def write_model(model: Any, out: Path, finish: Callable[[], None] = lambda: None) -> None:
    """Write a model as text and binary files into a new folder: some readers know only one of them.

    `finish` runs when all is written and found whole, just before `out` appears.
    """
    with replacing_folder(out) as folder:
        with library_writing(folder, ERRORS):
            model.write_text(folder)
            model.write(folder)
        if _counts(read_model(folder)) != _counts(model):
            raise OSError(errno.EIO, "less was written than the model holds", str(folder))
        finish()


def _counts(model: Any) -> tuple[int, ...]:
    """Return how much a model holds."""
    parts = model.cameras, model.rigs, model.frames, model.images, model.points3D
    return (*map(len, parts), model.compute_num_observations())
