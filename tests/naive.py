"""A NumPy twin of every kernel, float64, by another formula where there is one."""

import math

import numpy as np


def project(points, R_cam_from_world, center_world, width):
    """Pixels (N, 2) of world points (N, 3); elevation by the arcsine of the unit direction."""
    x, y, z = R_cam_from_world @ (np.asarray(points, dtype=np.float64) - center_world).T
    elevation = np.arcsin(z / np.linalg.norm([x, y, z], axis=0))
    return width * np.stack([0.5 - np.arctan2(y, x) / math.tau, 0.25 - elevation / math.tau], axis=1)


def sample(image, pixels):
    """Bilinear values (N, C) of an image (H, W, C) at continuous pixels (N, 2): columns wrap, rows clamp."""
    height, width = image.shape[:2]
    u, v = pixels[:, 0] - 0.5, pixels[:, 1] - 0.5
    j, i = np.floor(u).astype(int), np.floor(v).astype(int)
    fu, fv = (u - j)[:, None], (v - i)[:, None]

    def at(row, column):
        return image[np.clip(row, 0, height - 1), column % width].astype(np.float64)

    top = (1 - fu) * at(i, j) + fu * at(i, j + 1)
    bottom = (1 - fu) * at(i + 1, j) + fu * at(i + 1, j + 1)
    return (1 - fv) * top + fv * bottom


def sampling_loss(points, colors, image, is_valid, R_cam_from_world, center_world):
    """Eq. 2 of the paper; `image` (H, W, 3) and `colors` (N, 3) are 8-bit, the loss is in units of 1."""
    pixels = project(points, R_cam_from_world, center_world, image.shape[1])
    norms = np.linalg.norm(sample(image, pixels) - colors, axis=1) / 255.0
    counts = sample(is_valid[..., None].astype(np.float64), pixels)[:, 0] > 1.0 - 1e-9
    return norms[counts].mean()


def nearest_depth(points, R_cam_from_world, center_world, width):
    """Range of the nearest point in each cell (H, W), inf where there is none."""
    pixels = project(points, R_cam_from_world, center_world, width)
    depth = np.full((width // 2, width), np.inf)
    column = np.minimum(pixels[:, 0].astype(int), width - 1)
    row = np.minimum(pixels[:, 1].astype(int), width // 2 - 1)
    np.minimum.at(depth, (row, column), np.linalg.norm(points - center_world, axis=1))
    return depth
