"""Axes that many flat points of a cloud face, and those perpendicular to two of these."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.pose import Array
from .normals import PointNormals, dot

# Chosen by hand: the sphere in cells finer than the spread of a noisy plane's normals (3 to 8 deg)
MIN_POINTS = 300  # of a cloud
NUM_CELLS = 4000  # of the sphere of directions, about 3 deg wide
CELLS_PER_MODE = 12  # neighbouring cells whose votes are one direction's, 6 deg around it
MAX_MODES = 6  # twice the three directions of a box
MIN_MODE = 0.02  # fraction of the flat points
DISTINCT_ANGLE = np.radians(15.0)  # between two candidates: twice the angle of the first refinement
INLIER_ANGLES = np.radians([8.0, 4.0, 2.0, 2.0])  # of a normal to the axis or across it, step by step


def _sphere_cells() -> Array:
    """Directions (NUM_CELLS, 3) evenly over the sphere, a Fibonacci spiral."""
    k = np.arange(NUM_CELLS) + 0.5
    z = 1.0 - 2.0 * k / NUM_CELLS
    azimuth = k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def candidate_axes(cloud: PointNormals) -> list[Array]:
    """Unit vectors (3,) that many flat points face, and those perpendicular to two such axes; either sign."""
    normals = cloud.normals[cloud.is_flat]
    cells = _sphere_cells()
    tree = cKDTree(cells)
    nearest = tree.query(np.concatenate([normals, -normals]))[1]
    counts = np.bincount(nearest, minlength=NUM_CELLS)
    votes = counts[tree.query(cells, CELLS_PER_MODE)[1]].sum(axis=1)
    modes: list[Array] = []
    while len(modes) < MAX_MODES and votes.max() > max(MIN_MODE * len(normals), MIN_POINTS // 10):
        axis = cells[votes.argmax()]
        votes[np.abs(dot(cells, axis)) > np.cos(DISTINCT_ANGLE)] = 0
        modes.append(axis)
    axes: list[Array] = []
    for axis in [*modes, *_perpendicular(modes)]:
        refined = _refine(normals, axis)
        if all(abs(refined @ other) < np.cos(DISTINCT_ANGLE) for other in axes):
            axes.append(refined)
    return axes


def _perpendicular(axes: list[Array]) -> Iterator[Array]:
    """Unit vectors perpendicular to any two of `axes` that are not near parallel."""
    for i, a in enumerate(axes):
        for b in axes[:i]:
            normal = np.cross(a, b)
            length = np.linalg.norm(normal)
            if length > 0.5:
                yield normal / length


def _refine(normals: Array, axis: Array) -> Array:
    """`axis` by least squares: parallel to normals that face it, perpendicular to those of walls."""
    for angle in INLIER_ANGLES:
        cosines = np.abs(dot(normals, axis))
        facing, along = normals[cosines > np.cos(angle)], normals[cosines < np.sin(angle)]
        spread = np.einsum("ni,nj->ij", along, along) - np.einsum("ni,nj->ij", facing, facing)
        axis = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(axis)
