"""Edges of a photo, painted as `cloud.surfaces` paints those of a scan without colours; and their main axes.

The gradients along a straight line are at right angles to it, wherever it is seen. So an axis is a direction
at right angles to most gradients (Coughlan and Yuille, "Manhattan World", ICCV 1999).
"""

from dataclasses import replace
from functools import lru_cache
from typing import TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.colors import colors_of_edges
from ...geometry.sphere import make_grid, pixel_rays
from ...system.arrays import Array, Array32, Mask
from .panorama import Panorama, resize

GRADIENT_WIDTH = 1024  # [px] of the sphere on which gradients are taken
DARK = 12.0  # [levels] added to the grey before the logarithm
SMOOTHING = 0.8  # [px] standard deviation of the blur before the gradient
# gradient of the logarithm, per pixel, of an edge of strength 1; of a weaker one the strength is the root
FULL_GRADIENT = 0.25
# cosine of a gradient's angle to the horizontal, for an edge that is not vertical at all, and fully vertical
COS_UPRIGHT_EDGE = (0.9, 0.98)
SPREAD = 1.0  # [px] standard deviation of a blur that makes edges as wide as the painted ones of a scan
LEAST_COS = 0.2  # of the elevation: nearer to the poles a pixel counts as wide as here
SEAM_MARGIN = 32  # [px] that are added on all sides, across the seam

Pixel = TypeVar("Pixel", np.uint8, np.float32)
AXES_WIDTH = 512  # [px] of the sphere on which axes are found
FLAT_SHARE = 0.85  # of the pixels, those with the weakest gradients, are not edges
LEAST_EDGE = 1e-4  # least gradient of the logarithm at an edge
LEAST_EDGES = 100  # [px] with fewer pixels on edges there are no axes
LEAST_VOTING_COS = 0.35  # of the elevation: nearer to the poles gradients are inexact and not used
NUM_RINGS = 60  # of the grid of directions that are tried as axes: 3 degrees apart
COS_ACROSS = 0.035  # largest cosine between an axis and a gradient at right angles to it
VOTERS = 4  # one of so many edge pixels votes
SHARPENINGS = 4  # iterations of least squares
SQUARE = 0.1  # largest cosine between two axes


def draw_edges(panorama: Panorama, R_cam_from_level: Array, has_gray: bool) -> Panorama:
    """Return a panorama with the edges of another in its channels, with or without its grey.

    The rotation (3, 3) from level axes to the camera's tells which edges are vertical.
    """
    source = resize(panorama, GRADIENT_WIDTH)
    across, down = gradients(source)
    strength = np.hypot(across, down)
    level_across, level_down = level_directions(GRADIENT_WIDTH, R_cam_from_level)
    horizontal = np.abs(level_across * across + level_down * down)
    cosine = horizontal / np.maximum(strength, 1e-9)
    strength = np.clip(np.sqrt(strength / FULL_GRADIENT), 0.0, 1.0)
    vertical = strength * np.clip(
        (cosine - COS_UPRIGHT_EDGE[0]) / (COS_UPRIGHT_EDGE[1] - COS_UPRIGHT_EDGE[0]), 0.0, 1.0
    )
    gray = mean_level(source) / np.float32(255.0) if has_gray else 0.5
    inner = find_inner(source).astype(np.float32)
    weight = np.maximum(blur(inner, SPREAD), 1e-6)
    strength = blur(strength * inner, SPREAD) / weight
    vertical = blur(vertical * inner, SPREAD) / weight
    return Panorama(colors_of_edges(strength, vertical, gray), source.is_valid)


def soften(panorama: Panorama, sigma: float) -> Panorama:
    """Return the panorama blurred by a Gaussian of `sigma` [px]."""
    return replace(panorama, rgb=blur(panorama.rgb, sigma))


def gradients(panorama: Panorama) -> tuple[Array32, Array32]:
    """Return the derivatives (H, W) of the grey's logarithm, right and down, per pixel of the equator."""
    gray = np.log(mean_level(panorama) + np.float32(DARK))
    smooth = cv2.GaussianBlur(wrap(gray), (0, 0), SMOOTHING)
    inner = slice(SEAM_MARGIN, -SEAM_MARGIN)
    right = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 1, 0)[inner, inner], np.float32) / np.float32(32.0)
    down = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 0, 1)[inner, inner], np.float32) / np.float32(32.0)
    right /= np.maximum(row_cosines(len(gray)), LEAST_COS)[:, None].astype(np.float32)
    return right, down


def mean_level(panorama: Panorama) -> Array32:
    """Return the mean (H, W) of the three colours [levels]."""
    red, green, blue = np.moveaxis(panorama.rgb.astype(np.float32), -1, 0)
    return np.asarray((red + green + blue) / np.float32(3.0), np.float32)


def row_cosines(height: int) -> Array:
    """Return the cosine (H,) of the elevation of each row of an equirectangular image."""
    return np.asarray(np.cos((0.5 - (np.arange(height) + 0.5) / height) * np.pi))


def find_inner(panorama: Panorama) -> Mask:
    """Return the mask (H, W) of the pixels whose gradients depend on no masked pixel."""
    return np.asarray(cv2.erode(panorama.is_valid.view(np.uint8), np.ones((5, 5), np.uint8)) > 0)


@lru_cache(maxsize=2)
def tangent_axes(width: int) -> tuple[Array, Array]:
    """Return the unit directions (H, W, 3) to the right, and down, along the image at each pixel."""
    x, y, z = np.moveaxis(pixel_rays(width), -1, 0)
    rho = np.maximum(np.hypot(x, y), 1e-9)
    right = np.stack([y / rho, -x / rho, np.zeros_like(x)], axis=-1)
    return right, np.stack([x * z / rho, y * z / rho, -rho], axis=-1)


def level_directions(width: int, R_cam_from_level: Array) -> tuple[Array, Array]:
    """Return the components (H, W), right and down the image, of the level direction at each pixel."""
    right, below = tangent_axes(width)
    up_cam = R_cam_from_level[:, 2]
    across = np.einsum("hwi,i->hw", below, up_cam)  # the level direction is up x ray, and ray x right = below
    down = -np.einsum("hwi,i->hw", right, up_cam)
    length = np.maximum(np.hypot(across, down), 1e-9)
    return across / length, down / length


def blur(image: NDArray[Pixel], sigma: float) -> NDArray[Pixel]:
    """Blur an equirectangular image (H, W, ...) by a Gaussian of `sigma` [px]."""
    return cast(
        NDArray[Pixel],
        cv2.GaussianBlur(wrap(image), (0, 0), sigma)[SEAM_MARGIN:-SEAM_MARGIN, SEAM_MARGIN:-SEAM_MARGIN],
    )


def wrap(image: NDArray[Pixel]) -> NDArray[Pixel]:
    """Return an equirectangular image (H, W, ...) with a margin on all sides, continued across the seam."""
    wide = np.concatenate([image[:, -SEAM_MARGIN:], image, image[:, :SEAM_MARGIN]], axis=1)
    return cast(
        NDArray[Pixel], cv2.copyMakeBorder(wide, SEAM_MARGIN, SEAM_MARGIN, 0, 0, cv2.BORDER_REPLICATE)
    )


def find_axes(panorama: Panorama) -> list[Array]:
    """Return unit vectors (3,) along three main axes, both ways, nearest to +z first; none without edges."""
    normals, weights = edge_normals(panorama)
    if len(normals) < LEAST_EDGES:
        return []
    tried = make_grid(NUM_RINGS).directions.astype(np.float64)
    tried = tried[tried[:, 2] >= 0.0]
    some = normals[::VOTERS]
    votes = np.array([weights[::VOTERS] @ (np.abs(some @ direction) < COS_ACROSS) for direction in tried])
    first = sharpen_axis(normals, weights, tried[np.argmax(votes)])
    votes[np.abs(tried @ first) > SQUARE] = -1.0
    second = sharpen_axis(normals, weights, tried[np.argmax(votes)])
    second -= first * (first @ second)
    second /= np.linalg.norm(second)
    axes = [first, second, np.cross(first, second)]
    return sorted([*axes, *(-axis for axis in axes)], key=lambda axis: -float(axis[2]))


def edge_normals(panorama: Panorama) -> tuple[Array, Array]:
    """Return unit gradients (N, 3) at a photo's edges, in camera axes, and relative solid angles (N,)."""
    source = resize(panorama, AXES_WIDTH)
    across, along = gradients(source)
    right, down = tangent_axes(AXES_WIDTH)
    strength = np.hypot(across, along)
    cosines = row_cosines(AXES_WIDTH // 2)
    is_inner = find_inner(source) & (cosines > LEAST_VOTING_COS)[:, None]
    if not is_inner.any():
        return np.empty((0, 3)), np.empty(0)
    least = max(float(np.quantile(strength[is_inner], FLAT_SHARE)), LEAST_EDGE)
    is_edge = is_inner & (strength > least)
    gradient = across[is_edge][:, None] * right[is_edge] + along[is_edge][:, None] * down[is_edge]
    return gradient / strength[is_edge][:, None], cosines[np.nonzero(is_edge)[0]]


def sharpen_axis(normals: Array, weights: Array, axis: Array) -> Array:
    """Refine an axis (3,) by least squares on those normals (N, 3) that are nearly at right angles to it."""
    for _ in range(SHARPENINGS):
        near = np.abs(normals @ axis) < COS_ACROSS
        moments = (normals[near] * weights[near, None]).T @ normals[near]
        axis = np.linalg.eigh(moments)[1][:, 0]
    return np.asarray(axis)
