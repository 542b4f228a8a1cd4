"""Phone photos cut out of panoramas, by other sensors than the panorama's."""

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from piccolo.camera.model import camera_of_fov
from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.geometry.sphere import compute_pixels

PHOTO_SIZE = (1024, 768)  # [px]
PHOTO_FOV_DEG = 70.0
DIAGONAL_35MM = 43.27  # [mm] of the film that EXIF compares with
EXIF_IFD = 0x8769
EXIF_FOCAL_35MM = 0xA405
EXIF_FOCAL = 0x920A
Image = NDArray[np.uint8]


class Photo(NamedTuple):
    """A phone photo cut out of a panorama."""

    rgb: Image  # (H, W, 3)
    pose: Pose
    focal_px: float


def cut_photo(rgb: Image, pose: Pose, fov_deg: float, rng: np.random.Generator) -> Photo:
    """Cut a pinhole photo out of a panorama (H, W, 3) taken at `pose`, in any direction but steep ones."""
    camera = camera_of_fov("pinhole", fov_deg, *PHOTO_SIZE)
    pitch, roll = np.radians(rng.uniform([-15.0, -5.0], [15.0, 5.0]))
    R_photo_from_pano = exp_so3(np.array([roll, pitch, 0.0])) @ yaw_rotation(rng.uniform(0.0, 2.0 * np.pi))
    columns, rows = (np.arange(size) + 0.5 for size in PHOTO_SIZE)
    rays, _ = camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1))
    u, v = compute_pixels(rays @ R_photo_from_pano, rgb.shape[1])
    map_u = (u - 0.5).astype(np.float32)  # OpenCV has pixel centres at whole numbers
    map_v = (v - 0.5).astype(np.float32)
    picture = cv2.remap(rgb, map_u, map_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    pose = Pose(R_photo_from_pano @ pose.R_cam_from_world, pose.center_world)
    return Photo(np.asarray(picture, np.uint8), pose, camera.focal[0])


def write_photo(photo: Photo, path: Path) -> None:
    """Write a JPEG with its focal length in EXIF in whole millimetres, as phones write it."""
    image = PillowImage.fromarray(photo.rgb)
    exif = image.getexif()
    focal_35mm = round(photo.focal_px / math.hypot(*PHOTO_SIZE) * DIAGONAL_35MM)
    exif.get_ifd(EXIF_IFD).update({EXIF_FOCAL_35MM: focal_35mm, EXIF_FOCAL: 4.25})
    image.save(path, quality=93, exif=exif)


def change_sensor(rgb: Image, rng: np.random.Generator) -> Image:
    """Process a photo (H, W, 3) as another phone would.

    Exposure, white balance, tone curve, sharpening, noise and JPEG compression are drawn at random.
    """
    linear = (rgb / 255.0) ** 2.2 * 2.0 ** rng.uniform(-0.7, 0.7) * rng.uniform(0.8, 1.25, 3)
    toned = linear.clip(0.0, 1.0) ** (1.0 / rng.uniform(1.7, 2.8))
    smooth = cv2.GaussianBlur(toned, (0, 0), rng.uniform(1.0, 3.0))
    sharpened = toned + rng.uniform(0.0, 1.0) * (toned - smooth)
    noisy = 255.0 * sharpened + rng.normal(0.0, rng.uniform(0.0, 6.0), rgb.shape)
    quality = int(rng.integers(50, 95))
    levels = noisy.clip(0.0, 255.0).astype(np.uint8)
    _, content = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.uint8)
