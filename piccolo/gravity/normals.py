"""Normals of a cloud's points by PCA of their nearest neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import InputError
from ..geometry.pose import Array

# Chosen by hand; the noise of scanners (2 to 5 mm) is far below the spacing of the points (8 cm)
MAX_POINTS = 40_000  # that get a normal: a plane of 1 % of the cloud still has 400
NUM_NEIGHBORS = 24  # with the point itself: at 8 cm a disc of radius 0.22 m
MAX_THICKNESS = 0.05  # of a flat neighbourhood: variance across it to the lesser variance along it
MIN_WIDTH = 0.1  # of a flat neighbourhood: lesser to larger variance along it; below, it is a line


@dataclass(frozen=True)
class PointNormals:
    """A sample of a cloud with the normals there."""

    points: Array  # (M, 3) [m]
    normals: Array  # (M, 3) unit, of either sign
    is_flat: NDArray[np.bool_]  # (M,) the neighbourhood is a plane
    neighborhood_radius: float  # median distance of the farthest neighbour [m]


def estimate_normals(points: NDArray[np.float32]) -> PointNormals:
    """Normals of an evenly strided sample of a cloud (N, 3) [m], by PCA of the nearest of all its points.

    Raises
    ------
    InputError
        The shape is not (N, 3), or a coordinate is not finite.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: the shape is {points.shape}, must be (N, 3)")
    if not np.isfinite(points).all():
        raise InputError("points: a coordinate is not finite")
    if len(points) < NUM_NEIGHBORS:
        blank = np.zeros((len(points), 3))
        return PointNormals(points.astype(np.float64), blank, np.zeros(len(points), np.bool_), np.inf)
    stride = -(-len(points) // MAX_POINTS)
    all_points = points.astype(np.float64)
    sample = all_points[::stride]
    distances, indices = cKDTree(all_points).query(sample, NUM_NEIGHBORS)
    neighbors = all_points[indices]
    neighbors -= neighbors.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbors, neighbors))
    across, narrow, wide = variances.T
    is_flat = (across < MAX_THICKNESS * narrow) & (narrow > MIN_WIDTH * wide)
    return PointNormals(sample, axes[:, :, 0], is_flat, float(np.median(distances[:, -1])))


def dot(vectors: Array, axis: Array) -> Array:
    """Dot products (M,) of vectors (M, 3) and one axis (3,), the same for any number of threads.

    By einsum, since a BLAS may sum in an order that depends on its threads.
    """
    return np.asarray(np.einsum("ni,i->n", vectors, axis))
