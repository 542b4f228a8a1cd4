"""Pictures changed as light, other cameras, files and things in front change them; photos of panoramas."""

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from piccolo.arrays import Array, Bytes, Mask
from piccolo.camera.model import camera_of_fov
from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.geometry.sphere import compute_pixels, pixel_rays, solid_angles

PHOTO_SIZE = (1024, 768)  # [px]
PHOTO_FOV_DEG = 70.0
DIAGONAL_35MM = 43.27  # [mm] of the film that EXIF compares with
EXIF_IFD = 0x8769
EXIF_FOCAL_35MM = 0xA405
EXIF_FOCAL = 0x920A
LEAST_RADIUS = math.radians(8.0)  # of an occluder
MOST_RADIUS = math.radians(28.0)
ASPECT = 0.75  # height by width of a narrow photo
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])  # half a turn about the view axis


class Photo(NamedTuple):
    """A phone photo cut out of a panorama."""

    rgb: Bytes  # (H, W, 3)
    pose: Pose
    focal_px: float


def cut_photo(rgb: Bytes, pose: Pose, fov_deg: float, rng: np.random.Generator) -> Photo:
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
    image = PIL.Image.fromarray(photo.rgb)
    exif = image.getexif()
    focal_35mm = round(photo.focal_px / math.hypot(*PHOTO_SIZE) * DIAGONAL_35MM)
    exif.get_ifd(EXIF_IFD).update({EXIF_FOCAL_35MM: focal_35mm, EXIF_FOCAL: 4.25})
    image.save(path, quality=93, exif=exif)


def change_sensor(rgb: Bytes, rng: np.random.Generator) -> Bytes:
    """Process a photo (H, W, 3) as another phone would: light, colours, sharpness, noise and file."""
    linear = (rgb / 255.0) ** 2.2 * 2.0 ** rng.uniform(-0.7, 0.7) * rng.uniform(0.8, 1.25, 3)
    toned = linear.clip(0.0, 1.0) ** (1.0 / rng.uniform(1.7, 2.8))
    smooth = cv2.GaussianBlur(toned, (0, 0), rng.uniform(1.0, 3.0))
    sharpened = toned + rng.uniform(0.0, 1.0) * (toned - smooth)
    noisy = 255.0 * sharpened + rng.normal(0.0, rng.uniform(0.0, 6.0), rgb.shape)
    quality = int(rng.integers(50, 95))
    return compress(noisy, quality)


def compress(rgb: Array, quality: int) -> Bytes:
    """Store a photo (H, W, 3) of levels up to 255 as a JPEG, and read it again."""
    levels = rgb.clip(0.0, 255.0).astype(np.uint8)
    _, content = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.uint8)


def blur(image: NDArray[np.generic], sigma: float) -> Array:
    """Blur an equirectangular image (H, W, 3) by a Gaussian [px]."""
    mode = ("nearest", "wrap", "nearest")
    return np.asarray(gaussian_filter(image.astype(float), (sigma, sigma, 0.0), mode=mode))


def change_light(rgb: Bytes, rng: np.random.Generator, noise: np.random.Generator) -> Bytes:
    """Return the image (H, W, 3) with another exposure, white balance and gamma, blurred and noisy.

    `noise` may be `rng`; photos of one light have the same `rng` each, and other noise.
    """
    gain = rng.uniform(0.7, 1.3) * rng.uniform(0.85, 1.15, 3)
    linear = (rgb / 255.0) ** rng.uniform(0.8, 1.25)
    noisy = blur(linear * gain, 0.8) + noise.normal(0.0, 0.02, rgb.shape)
    return np.asarray(np.round(noisy.clip(0.0, 1.0) * 255.0).astype(np.uint8))


def occlude(rgb: Bytes, other: Bytes, fraction: float, rng: np.random.Generator) -> Bytes:
    """Hide a fraction of the sphere of a photo (H, W, 3) behind round pieces of another."""
    height, width = rgb.shape[:2]
    rays = pixel_rays(width)
    areas = solid_angles(width)[:, None] / (4.0 * math.pi)
    is_hidden = np.zeros((height, width), np.bool_)
    shown = rgb.copy()
    while float((is_hidden * areas).sum()) < fraction:
        direction = rng.normal(size=3) * [1.0, 1.0, 0.4]  # people and things stand around the camera
        radius = rng.uniform(LEAST_RADIUS, MOST_RADIUS)
        is_new = (rays @ (direction / np.linalg.norm(direction)) > math.cos(radius)) & ~is_hidden
        moved = np.roll(other, rng.integers(width), axis=1)[:: int(rng.choice([-1, 1]))]
        shown[is_new] = moved[is_new]
        is_hidden |= is_new
    return shown


def light_unevenly(rgb: Bytes, stops: float, rng: np.random.Generator) -> Bytes:
    """Put a photo (H, W, 3) under patches of light that differ by some stops."""
    noise = blur(rng.normal(size=rgb.shape[:2])[..., None], 0.08 * rgb.shape[1])
    gain = 2.0 ** (0.5 * stops * noise / noise.std())
    linear = (rgb / 255.0) ** 2.2 * gain
    return np.asarray(255.0 * linear.clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def take_at_night(rgb: Bytes, rng: np.random.Generator) -> Bytes:
    """Dim and tint the light by four stops, and add the noise of a sensor that makes up for most of it."""
    linear = (rgb / 255.0) ** 2.2 * 2.0**-4 * np.array([1.3, 0.8, 0.6])
    noisy = rng.poisson(900.0 * linear) / 900.0 + rng.normal(0.0, 0.004, rgb.shape)
    return np.asarray(255.0 * (5.0 * noisy).clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def mask_outside_field(width: int, fov_deg: float, yaw: float) -> Mask:
    """Return the mask (H, W) of a sphere outside a level pinhole photo that looks along azimuth `yaw`."""
    x, y, z = np.moveaxis(pixel_rays(width), -1, 0)
    forward = math.cos(yaw) * x + math.sin(yaw) * y
    left = math.cos(yaw) * y - math.sin(yaw) * x
    reach = math.tan(math.radians(fov_deg / 2.0)) * forward
    return np.asarray((forward <= 0.0) | (np.abs(left) > reach) | (np.abs(z) > ASPECT * reach))


def draw_fractal_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Bytes:
    """Draw smooth noise of several scales (H, W, 3), with the contrast of a photo."""
    total = np.zeros(shape)
    for scale in (0.004, 0.015, 0.06):
        noise = blur(rng.normal(size=shape), scale * shape[1])
        total += noise / noise.std()
    return np.asarray((127.0 + 40.0 * total).clip(0, 255), np.uint8)
