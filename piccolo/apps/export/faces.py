"""Panoramas as pinhole pictures, with masks, for programs that know no spheres."""

import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...api.values import read_as_localized
from ...geometry.pose import R_cam_from_angles
from ...geometry.sphere import compute_pixels
from ...photo.camera import Camera, Mount
from ...photo.camera.calibration import rows
from ...photo.panorama import Panorama
from ...photo.panorama.picture import WANTED, encode_image
from ...system.arrays import Bytes
from ...system.errors import InputError
from ...system.files.atomic import write_atomically
from ...system.files.json_file import read_bytes
from ...views.pictures import sample_sphere
from .posed_images import PosedImage, names_within

CORNER_DEG = math.degrees(math.atan(math.sqrt(0.5)))  # elevation of a cube's corner
CUBE = (0.0, 0.0), (90.0, 0.0), (180.0, 0.0), (270.0, 0.0), (0.0, 90.0), (0.0, -90.0)
CORNERS = tuple((yaw, up * CORNER_DEG) for up in (1, -1) for yaw in (45.0, 135.0, 225.0, 315.0))
# directions by their number: azimuth from the panorama's centre to the left, and elevation [deg]
FACES = {6: CUBE, 8: tuple((45.0 * k, 0.0) for k in range(8)), 14: CUBE + CORNERS}
IMAGES = "images"  # folders of a data set
MASKS = "masks"


def write_faces(
    images: Sequence[PosedImage], num_faces: int, has_names: bool, folder: Path
) -> list[PosedImage]:
    """Write the pictures of a data set into folders of `folder`, and return them with their poses.

    A panorama becomes `num_faces` pictures as fine as it is at its horizon; photos are copied. If any
    panorama has masked pixels, there are masks as COLMAP names them, in which black is ignored.
    """
    written: list[PosedImage] = []
    any_masked = False

    def take(image: PosedImage, name: str, content: bytes, mask: Bytes) -> None:
        path = folder / IMAGES / name
        if path.exists():
            raise InputError(f"{name}: two pictures would have this name, wanted photos of distinct names")
        for file, part in ((path, content), (folder / MASKS / f"{name}.png", encode_image(mask, ".png"))):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(file, part)
        written.append(image._replace(name=name, path=path, mask=f"{MASKS}/{name}.png"))

    for image, name in zip(images, names_within(images, has_names), strict=True):
        if image.camera is not None:
            mask = np.full((image.camera.height, image.camera.width), 255, np.uint8)
            take(image, name, read_bytes(image.path, WANTED), mask)
            continue
        panorama = read_as_localized(image.result)
        any_masked |= not panorama.is_valid.all()
        for k, mount in enumerate(list_faces(panorama.rgb.shape[1], num_faces)):
            face = image._replace(pose=mount.pose(image.pose), camera=mount.camera)
            rgb, mask = _cut_face(panorama, mount)
            take(face, f"{Path(name).with_suffix('')}_{k}.jpg", encode_image(rgb, ".jpg"), mask)
    if any_masked:
        return written
    shutil.rmtree(folder / MASKS)
    return [image._replace(mask=None) for image in written]


def list_faces(width: int, num_faces: int) -> list[Mount]:
    """Return the pinhole cameras, of 90 x 90 degrees, in a panorama of this width [px]."""
    size = 2 * round(width / (2.0 * math.pi))
    camera = Camera("PINHOLE", size, size, (size / 2.0,) * 4)
    turns = [R_cam_from_angles(90.0 - yaw, elevation, 0.0) for yaw, elevation in FACES[num_faces]]
    return [Mount(camera, rows(R)) for R in turns]


def _cut_face(panorama: Panorama, mount: Mount) -> tuple[Bytes, Bytes]:
    """Return the picture (size, size, 3) of a face, and its mask (size, size), 0 where nothing counts.

    Its rays are linear in the pixels: Camera.rays, which inverts any distortion, takes ten times longer.
    """
    size = mount.camera.width
    across = (np.arange(size) + 0.5) / (0.5 * size) - 1.0
    forward, left, up = mount.rotation
    rays = (forward - across[:, None] * left) - across[:, None, None] * up
    u, v = (places.astype(np.float32) for places in compute_pixels(rays, panorama.rgb.shape[1]))
    rgb = sample_sphere(panorama.rgb, u, v)
    counts = sample_sphere(panorama.is_valid.astype(np.uint8) * np.uint8(255), u, v)
    return rgb, np.where(counts == 255, 255, 0).astype(np.uint8)
