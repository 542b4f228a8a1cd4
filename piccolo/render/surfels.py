"""Surfels: discs that close the surface between points, with a radius and a normal from the neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..runtime.threads import Workers

NUM_NEIGHBORS = 10
CHUNK = 65_536
RADIUS_PER_REACH = 0.8  # surfel radius by the distance of the farthest of these neighbours
# A ray that grazes an edge leaves points in the air behind it. Such a point is farther from its neighbours
# than they are from theirs.
MAX_REACH = 1.6  # by the median of the neighbours' own
MIN_FLATNESS = 0.05  # second to largest eigenvalue; below, neighbours lie in a line and tell no plane
MAX_THICKNESS = 0.12  # smallest eigenvalue by the sum of all; of a ball, such as leaves, it is 1/3
THICK_RADIUS = 0.25  # so much smaller are surfels that are no part of a surface


@dataclass(frozen=True)
class Surfels:
    """Coloured discs around points."""

    points: PackedPoints
    normals: NDArray[np.float32]  # (N, 3) unit, of either sign; 0 without a plane: faces the camera
    radii: NDArray[np.float32]  # (N,) [m], 0 for a surfel no larger than a pixel

    def take(self, indices: NDArray[np.integer]) -> "Surfels":
        """The surfels at `indices`, in that order."""
        return Surfels(self.points.take(indices), self.normals[indices], self.radii[indices])


def surfels_of(points: PackedPoints, workers: Workers) -> Surfels:
    """Each point as a surfel over its nearest neighbours; points in the air are left out."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # who draws no picture need not wait for it

    positions = np.stack([points.x, points.y, points.z], axis=1)
    normals, radii = np.zeros_like(positions), np.zeros(len(positions), np.float32)
    if len(positions) <= NUM_NEIGHBORS:
        return Surfels(points, normals, radii)
    tree = cKDTree(positions, balanced_tree=False, compact_nodes=False)
    neighbors = np.empty((len(positions), NUM_NEIGHBORS + 1), np.int32)

    def run(lo: int) -> None:
        part = slice(lo, lo + CHUNK)
        distances, neighbors[part] = tree.query(positions[part], NUM_NEIGHBORS + 1)
        normals[part], is_thick = planes(positions[neighbors[part]])
        radii[part] = RADIUS_PER_REACH * distances[:, -1] * np.where(is_thick, THICK_RADIUS, 1.0)

    list(workers.map(run, range(0, len(positions), CHUNK), "surface"))
    is_surface = np.empty(len(positions), np.bool_)
    for lo in range(0, len(positions), CHUNK):
        part = slice(lo, lo + CHUNK)
        is_surface[part] = radii[part] <= MAX_REACH * np.median(radii[neighbors[part]], axis=1)
    return Surfels(points, normals, radii).take(np.flatnonzero(is_surface))


def planes(neighborhoods: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Unit normals (N, 3) of neighbourhoods (N, K, 3), 0 without a plane; and which fill a volume (N,)."""
    offsets = neighborhoods - neighborhoods.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    is_thick = values[:, 0] > MAX_THICKNESS * values.sum(axis=1)
    has_plane = (values[:, 1] > MIN_FLATNESS * values[:, 2]) & ~is_thick
    return np.asarray(vectors[:, :, 0] * has_plane[:, None], np.float32), is_thick
