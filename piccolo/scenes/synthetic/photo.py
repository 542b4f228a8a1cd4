"""Panoramas of a room at known poses, and what light, lens and file do to them."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ...geometry.pose import Array, Pose
from ...geometry.sphere import pixel_rays
from ...runtime.threads import Workers
from .raycast import cast_rays
from .room import Room

SUPERSAMPLING = 2  # rays a pixel, each way
BAND = 8  # rows cast at once: all rays of a large image would take a gigabyte


def photograph(room: Room, pose: Pose, width: int, workers: Workers) -> NDArray[np.uint8]:
    """Equirectangular image (width / 2, width, 3) of a room at `pose`."""
    rays_cam = pixel_rays(SUPERSAMPLING * width)

    def run(top: int) -> NDArray[np.uint8]:
        rows = rays_cam[SUPERSAMPLING * top : SUPERSAMPLING * (top + BAND)].reshape(-1, 3)
        rgb = cast_rays(room, pose.center_world, rows @ pose.R_cam_from_world, Workers(), "band")[1]
        blocks = rgb.reshape(-1, SUPERSAMPLING, width, SUPERSAMPLING, 3)
        return np.asarray(np.round(blocks.mean(axis=(1, 3)) * 255.0), dtype=np.uint8)

    return np.concatenate(list(workers.each(run, range(0, width // 2, BAND), "panorama")))


def label_image(room: Room, pose: Pose, width: int, workers: Workers) -> NDArray[np.uint16]:
    """Equirectangular image (width / 2, width) of a room's labels at `pose`, of pixels' centres."""

    def run(top: int) -> NDArray[np.uint16]:
        rays = pixel_rays(width, slice(top, top + BAND)).reshape(-1, 3) @ pose.R_cam_from_world
        labels = cast_rays(room, pose.center_world, rays, Workers(), "band")[2]
        return labels.reshape(-1, width).astype(np.uint16)

    return np.concatenate(list(workers.each(run, range(0, width // 2, BAND), "labels")))


def blur(image: Array, sigma: float) -> Array:
    """An equirectangular image (H, W, 3) under a Gaussian [px]."""
    return np.asarray(gaussian_filter(image, (sigma, sigma, 0.0), mode=("nearest", "wrap", "nearest")))


def other_light(rgb: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image (H, W, 3) with another exposure, white balance and gamma, blurred and noisy."""
    gain = rng.uniform(0.7, 1.3) * rng.uniform(0.85, 1.15, 3)
    linear = (rgb / 255.0) ** rng.uniform(0.8, 1.25)
    noisy = blur(linear * gain, 0.8) + rng.normal(0.0, 0.02, rgb.shape)
    return np.asarray(np.round(noisy.clip(0.0, 1.0) * 255.0).astype(np.uint8))
