"""Edges of a photo, as `cloud.shape` paints those of a scan without colours."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.colors import colors_of_edges
from ..geometry.pose import Array
from ..geometry.sphere import make_grid, pixel_rays
from .model import Panorama, resize

WIDTH = 1024  # [px] of the sphere on which gradients are taken
DARK = 12.0  # [levels] added before the logarithm
SMOOTHING = 0.8  # [px] before the gradient is taken
FULL_GRADIENT = 0.25  # of the logarithm, a pixel; the strength is the root of the fraction
VERTICAL = 0.9, 0.98  # cosine of a gradient's angle to the horizontal: no vertical edge at all, and fully
SPREAD = 2.0  # [px] the painted edges of a scan are wide
MARGIN = 32  # [px] beyond the seam
AXES_WIDTH = 512  # [px] of the sphere on which the directions of lines are found
FLAT_SHARE = 0.85  # of the pixels, with the weakest gradients: no edges
LEAST_EDGE = 1e-4  # of the gradient of the logarithm
LEAST_EDGES = 100  # [px] fewer say nothing
AXES_RINGS = 60  # of the grid of directions that are tried: 3 degrees apart
ACROSS = 0.035  # sine of the angle to the right angle, at most
SHARPENINGS = 4
LEAST_COS = 0.35  # of the elevation: nearer to the poles gradients are rough
SQUARE = 0.1  # cosine of two of the axes, at most


def draw_edges(panorama: Panorama, R_cam_from_level: Array) -> Panorama:
    """Return a panorama of the edges of another, of WIDTH, taken with a camera of a known tilt (3, 3)."""
    source = resize(panorama, WIDTH)
    gray = np.log(source.rgb.astype(np.float32).mean(axis=2) + np.float32(DARK))
    across, down = gradients(gray)
    strength = np.hypot(across, down)
    horizontal = np.abs(np.sum(tangents(WIDTH, R_cam_from_level) * np.stack([across, down], -1), axis=-1))
    cosine = horizontal / np.maximum(strength, 1e-9)
    strength = np.clip(np.sqrt(strength / FULL_GRADIENT), 0.0, 1.0)
    vertical = strength * np.clip((cosine - VERTICAL[0]) / (VERTICAL[1] - VERTICAL[0]), 0.0, 1.0)
    is_inner = cv2.erode(source.is_valid.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    shown = is_inner.astype(np.float32)
    weight = np.maximum(spread(shown), 1e-6)
    drawn = colors_of_edges(spread(strength * shown) / weight, spread(vertical * shown) / weight)
    return Panorama(drawn, source.is_valid)


def gradients(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the derivatives (H, W) of an equirectangular image, across and down, a pixel of its middle."""
    smooth = cv2.GaussianBlur(wrap(image), (0, 0), SMOOTHING)
    inner = slice(MARGIN, -MARGIN)
    across = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 1, 0)[inner, inner], np.float32) / np.float32(32.0)
    down = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 0, 1)[inner, inner], np.float32) / np.float32(32.0)
    elevation = (0.5 - (np.arange(len(image)) + 0.5) / len(image)) * np.pi
    across /= np.maximum(np.cos(elevation), 0.2)[:, None].astype(np.float32)
    return across, down


def find_axes(panorama: Panorama) -> list[Array]:
    """Return unit vectors (3,) along three directions of the lines in a photo, in both senses.

    The directions are at right angles to each other. A line's gradients are at right angles to it, wherever
    it is seen: the direction is the one at right angles to most gradients (Coughlan and Yuille, "Manhattan
    World", ICCV 1999). The nearest to +z is the first.
    """
    source = resize(panorama, AXES_WIDTH)
    gray = np.log(source.rgb.astype(np.float32).mean(axis=2) + np.float32(DARK))
    across, down = gradients(gray)
    right, below = tangent_axes(AXES_WIDTH)
    strength = np.hypot(across, down)
    is_inner = cv2.erode(source.is_valid.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    elevation = (0.5 - (np.arange(AXES_WIDTH // 2) + 0.5) / (AXES_WIDTH // 2)) * np.pi
    is_inner &= np.cos(elevation)[:, None] > LEAST_COS
    if not is_inner.any():
        return []
    is_edge = is_inner & (strength > max(float(np.quantile(strength[is_inner], FLAT_SHARE)), LEAST_EDGE))
    if is_edge.sum() < LEAST_EDGES:
        return []
    normals = (across[..., None] * right + down[..., None] * below)[is_edge] / strength[is_edge][:, None]
    weights = np.cos(elevation)[np.nonzero(is_edge)[0]]
    tried = make_grid(AXES_RINGS).directions.astype(np.float64)
    votes = np.array([weights @ (np.abs(normals @ direction) < ACROSS) for direction in tried])
    first = sharpen_axis(normals, weights, tried[np.argmax(votes)])
    votes[np.abs(tried @ first) > SQUARE] = -1.0
    second = sharpen_axis(normals, weights, tried[np.argmax(votes)])
    second -= first * (first @ second)
    second /= np.linalg.norm(second)
    axes = [first, second, np.cross(first, second)]
    return sorted([*axes, *(-axis for axis in axes)], key=lambda axis: -float(axis[2]))


def sharpen_axis(normals: Array, weights: Array, axis: Array) -> Array:
    """Return the axis (3,) at right angles to the normals (N, 3) that nearly are, by least squares."""
    for _ in range(SHARPENINGS):
        near = np.abs(normals @ axis) < ACROSS
        moments = (normals[near] * weights[near, None]).T @ normals[near]
        axis = np.linalg.eigh(moments)[1][:, 0]
    return np.asarray(axis)


def tangent_axes(width: int) -> tuple[Array, Array]:
    """Return the unit directions (H, W, 3), across to the right and down, at each pixel."""
    x, y, z = np.moveaxis(pixel_rays(width), -1, 0)
    rho = np.maximum(np.hypot(x, y), 1e-9)
    right = np.stack([y / rho, -x / rho, np.zeros_like(x)], axis=-1)
    return right, np.stack([x * z / rho, y * z / rho, -rho], axis=-1)


def tangents(width: int, R_cam_from_level: Array) -> NDArray[np.float64]:
    """Return the horizontal direction (H, W, 2) at each pixel, as its parts across and down the image."""
    rays = pixel_rays(width)
    right, below = tangent_axes(width)
    horizontal = np.cross(R_cam_from_level[:, 2], rays)
    horizontal /= np.maximum(np.linalg.norm(horizontal, axis=-1, keepdims=True), 1e-9)
    return np.stack([(horizontal * right).sum(axis=-1), (horizontal * below).sum(axis=-1)], axis=-1)


def spread(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """Blur an equirectangular image (H, W) by SPREAD."""
    blurred = cv2.GaussianBlur(wrap(image.astype(np.float32)), (0, 0), SPREAD)
    return np.asarray(blurred[MARGIN:-MARGIN, MARGIN:-MARGIN], np.float32)


def wrap(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an equirectangular image (H, W) with a margin on all sides, across the seam."""
    wide = np.pad(image, ((0, 0), (MARGIN, MARGIN)), mode="wrap")
    return np.pad(wide, ((MARGIN, MARGIN), (0, 0)), mode="edge")
