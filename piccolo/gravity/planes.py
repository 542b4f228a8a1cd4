"""Normals of a cloud by PCA, and its dominant planes by RANSAC."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array

# Chosen by hand; the noise of scanners (2 to 5 mm) is far below the spacing of the points
SPACING = 0.08  # of the points that are used [m]
MAX_POINTS = 40_000  # that get a normal: a plane of 1 % of the cloud still has 400
NUM_NEIGHBORS = 24  # with the point itself: at 8 cm a disc of radius 0.22 m
MAX_THICKNESS = 0.05  # of a flat neighbourhood: variance across it to the lesser variance along it
MIN_WIDTH = 0.1  # of a flat neighbourhood: lesser to larger variance along it; below, it is a line
SEED = 20  # of the draws
MAX_PLANES = 24
MIN_FRACTION = 0.01  # of all points, of a dominant plane
NUM_HYPOTHESES = 200  # for each plane: one lies on a plane of 2 % of the points in 98 % of draws
NUM_SCORING_POINTS = 2000  # drawn, on which a hypothesis is scored: a plane of 1 % has 20 of them
TOLERANCE = 0.03  # of an inlier, from the plane: six times a scanner's noise of 5 mm [m]
INLIER_ANGLE = np.radians(15.0)  # of its normal, loose since normals near edges lean
NUM_REFITS = 4  # by least squares, until the inliers stay the same


class PointNormals(NamedTuple):
    """A sample of a cloud with the normals there."""

    points: Array  # (M, 3) [m]
    normals: Array  # (M, 3) unit, of either sign
    is_flat: NDArray[np.bool_]  # (M,) the neighbourhood is a plane


class Planes(NamedTuple):
    """Dominant planes, the largest first."""

    normals: Array  # (P, 3) unit, of either sign
    centers: Array  # (P, 3) mean of the inliers [m]
    areas: Array  # (P,) fraction of all points of the sample, which are spread evenly in space


def dot(vectors: Array, axis: Array) -> Array:
    """Return dot products (M,) of vectors (M, 3) and an axis (3,); by BLAS they would depend on threads."""
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


def estimate_normals(points: NDArray[np.float32]) -> PointNormals:
    """Return normals of an evenly strided sample of a cloud (N, 3) [m], by PCA of the nearest points."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who asks for up waits for it

    sample = points[:: -(-len(points) // MAX_POINTS)].astype(np.float64)
    nearest = list(range(1, min(NUM_NEIGHBORS, len(points)) + 1))
    neighbors = points[cKDTree(points).query(sample, nearest)[1]].astype(np.float64)
    neighbors -= neighbors.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbors, neighbors))
    across, narrow, wide = variances.T
    is_flat = (across < MAX_THICKNESS * narrow) & (narrow > MIN_WIDTH * wide)
    return PointNormals(sample, axes[:, :, 0], is_flat)


def ransac_planes(cloud: PointNormals) -> Planes:
    """Return the dominant planes: RANSAC on flat points, least squares on all inliers."""
    rng = np.random.default_rng(SEED)
    left = np.flatnonzero(cloud.is_flat)
    found: list[tuple[Array, Array, float]] = []
    least = max(MIN_FRACTION * len(cloud.points), 3)
    while len(found) < MAX_PLANES and len(left) > least:
        drawn = rng.choice(left, NUM_HYPOTHESES)
        scoring = rng.choice(left, NUM_SCORING_POINTS)
        votes = _are_inliers(cloud, scoring, cloud.normals[drawn], cloud.points[drawn]).sum(axis=1)
        normal, center = cloud.normals[drawn[votes.argmax()]], cloud.points[drawn[votes.argmax()]]
        for _ in range(NUM_REFITS):
            is_inlier = _are_inliers(cloud, left, normal[None], center[None])[0]
            inliers = cloud.points[left[is_inlier]]
            if len(inliers) < least:
                break
            center = inliers.mean(axis=0)
            normal = np.linalg.eigh(np.einsum("ni,nj->ij", inliers - center, inliers - center))[1][:, 0]
        if len(inliers) < least:
            break
        found.append((normal, center, len(inliers) / len(cloud.points)))
        left = left[~is_inlier]
    found.sort(key=lambda plane: -plane[2])
    normals, centers, areas = zip(*found, strict=True) if found else ((), (), ())
    return Planes(np.reshape(normals, (-1, 3)), np.reshape(centers, (-1, 3)), np.array(areas))


def _are_inliers(
    cloud: PointNormals, some: NDArray[np.int64], normals: Array, points: Array
) -> NDArray[np.bool_]:
    """Return which of some points (S,) lie on planes (H, S) by normals and points (H, 3)."""
    offsets = np.einsum("hi,hi->h", normals, points)[:, None]
    distances = np.einsum("hi,ji->hj", normals, cloud.points[some]) - offsets
    cosines = np.einsum("hi,ji->hj", normals, cloud.normals[some])
    return np.asarray((np.abs(distances) < TOLERANCE) & (np.abs(cosines) > np.cos(INLIER_ANGLE)))
