"""What surrounds each point of a cloud: normals by PCA of the nearest neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import InputError
from ..geometry.pose import Array

MAX_POINTS = 40_000  # that are looked at
NUM_NEIGHBORS = 24  # of a normal
MAX_FLATNESS = 0.05  # variance across a flat neighbourhood to the lesser variance along it


@dataclass(frozen=True)
class Surfaces:
    """A sample of the cloud with what surrounds each point."""

    points: Array  # (M, 3) [m]
    normals: Array  # (M, 3) unit, of either sign
    is_flat: NDArray[np.bool_]  # (M,) the neighbourhood is a plane
    reach: float  # median radius of the neighbourhoods [m]


def surfaces_of(points: NDArray[np.float32]) -> Surfaces:
    """Normals of an evenly strided sample of a cloud (N, 3) [m], by PCA of the nearest of all its points.

    Raises
    ------
    InputError
        The shape is not (N, 3), or a coordinate is not finite.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: found shape {points.shape}, wanted (N, 3)")
    if not np.isfinite(points).all():
        raise InputError("points: found a coordinate that is not finite, wanted metres")
    if len(points) < NUM_NEIGHBORS:
        blank = np.zeros((len(points), 3))
        return Surfaces(points.astype(np.float64), blank, np.zeros(len(points), np.bool_), np.inf)
    stride = -(-len(points) // MAX_POINTS)
    all_points = points.astype(np.float64)
    sample = all_points[::stride]
    distances, indices = cKDTree(all_points).query(sample, NUM_NEIGHBORS)
    neighbors = all_points[indices]
    neighbors -= neighbors.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbors, neighbors))
    is_flat = (variances[:, 0] < MAX_FLATNESS * variances[:, 1]) & (variances[:, 1] > 0.1 * variances[:, 2])
    return Surfaces(sample, axes[:, :, 0], is_flat, float(np.median(distances[:, -1])))


def cosines_to(vectors: Array, axis: Array) -> Array:
    """Dot products (M,), by einsum: a BLAS may sum in an order that depends on its threads."""
    return np.asarray(np.einsum("ni,i->n", vectors, axis))
