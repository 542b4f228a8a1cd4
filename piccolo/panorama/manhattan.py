"""The three directions, at right angles, of most lines in a photo of a building.

A line's gradients are at right angles to it, wherever it is seen: a direction is the one at right angles to
most gradients (Coughlan and Yuille, "Manhattan World", ICCV 1999).
"""

import numpy as np

from ..arrays import Array
from ..geometry.sphere import make_grid
from .edges import find_inner, gradients, row_cosines, tangent_axes
from .model import Panorama, resize

WIDTH = 512  # [px] of the sphere
FLAT_SHARE = 0.85  # of the pixels, with the weakest gradients: no edges
LEAST_EDGE = 1e-4  # of the gradient of the logarithm
LEAST_EDGES = 100  # [px] fewer say nothing
LEAST_COS = 0.35  # of the elevation: nearer to the poles gradients are rough
NUM_RINGS = 60  # of the grid of directions that are tried: 3 degrees apart
ACROSS = 0.035  # cosine of the angle between an axis and a gradient that is at right angles to it, at most
VOTERS = 4  # one of so many edges votes
SHARPENINGS = 4
SQUARE = 0.1  # cosine of the angle between two axes, at most


def find_axes(panorama: Panorama) -> list[Array]:
    """Return unit vectors (3,) along the three directions, in both senses, the nearest to +z first.

    None for a photo without edges.
    """
    normals, weights = edge_normals(panorama)
    if len(normals) < LEAST_EDGES:
        return []
    tried = make_grid(NUM_RINGS).directions.astype(np.float64)
    tried = tried[tried[:, 2] >= 0.0]
    some = normals[::VOTERS]
    votes = np.array([weights[::VOTERS] @ (np.abs(some @ direction) < ACROSS) for direction in tried])
    first = sharpen_axis(normals, weights, tried[np.argmax(votes)])
    votes[np.abs(tried @ first) > SQUARE] = -1.0
    second = sharpen_axis(normals, weights, tried[np.argmax(votes)])
    second -= first * (first @ second)
    second /= np.linalg.norm(second)
    axes = [first, second, np.cross(first, second)]
    return sorted([*axes, *(-axis for axis in axes)], key=lambda axis: -float(axis[2]))


def edge_normals(panorama: Panorama) -> tuple[Array, Array]:
    """Return unit gradients (N, 3), in the camera's axes, at a photo's edges, and their solid angles (N,)."""
    source = resize(panorama, WIDTH)
    across, along = gradients(source)
    right, down = tangent_axes(WIDTH)
    strength = np.hypot(across, along)
    cosines = row_cosines(WIDTH // 2)
    is_inner = find_inner(source) & (cosines > LEAST_COS)[:, None]
    if not is_inner.any():
        return np.empty((0, 3)), np.empty(0)
    least = max(float(np.quantile(strength[is_inner], FLAT_SHARE)), LEAST_EDGE)
    is_edge = is_inner & (strength > least)
    gradient = across[is_edge][:, None] * right[is_edge] + along[is_edge][:, None] * down[is_edge]
    return gradient / strength[is_edge][:, None], cosines[np.nonzero(is_edge)[0]]


def sharpen_axis(normals: Array, weights: Array, axis: Array) -> Array:
    """Return the axis (3,) at right angles to the normals (N, 3) that nearly are, by least squares."""
    for _ in range(SHARPENINGS):
        near = np.abs(normals @ axis) < ACROSS
        moments = (normals[near] * weights[near, None]).T @ normals[near]
        axis = np.linalg.eigh(moments)[1][:, 0]
    return np.asarray(axis)
