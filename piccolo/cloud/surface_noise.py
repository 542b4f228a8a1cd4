"""Distances of a scan's points from its surfaces: range noise, and surfaces scanned twice.

Noise is similar at all points and averages out over those that a photo shows, but for a part of it; where
scans are shifted against each other, each surface is there twice, and a pose may follow one or the other.
"""

import numpy as np

from ..arrays import Array, Int64s
from .octree import Octree

CELLS = (3, 4)  # levels above the leaves: cells of 16 cm, or 32 cm where the scan is thin
MIN_LEAVES = 20
MIN_CELLS = 200
MAX_CELLS = 20_000
NOISE_SHARE = 0.3  # of the noise's deviation that is left in a pose, from trials with noise of 1 to 5 cm
ONE_SHEET = 2.5  # kurtosis of noise within a cell, about; of two thin sheets it is 1
ROUGHNESS = 0.005  # [m] of clean surfaces and the things on them
NUM_ITERATIONS = 20
LEAST_RESIDUAL = 1e-5  # [m^2] of cells that fit, all alike
RIDGE = 3e-3  # on the squared norm of the tensor: two walls at a right angle leave a part undetermined


def surface_variance(octree: Octree) -> Array:
    """Return the covariance (3, 3) [m^2] of a position aligned with a scan, from the scan's own errors.

    It is zero for a scan with too few points. Each cell measures one direction, its normal: the tensor
    is the one that fits most cells (least absolute deviations).
    """
    for levels_up in CELLS:
        cells = residual_moments(octree, levels_up)
        if len(cells[1]) >= MIN_CELLS:
            return fit_tensor(*cells)
    return np.zeros((3, 3))


def residual_moments(octree: Octree, levels_up: int) -> tuple[Array, Array]:
    """Return normals (C, 3) of the planes through the leaves of cells, and variances (C,) across them [m^2].

    The residuals of one noisy sheet have a kurtosis of 3, less what the cell cuts off; those of two sheets at
    +-b with noise of variance s^2 have E r^4 = 3 (b^2 + s^2)^2 - 2 b^4. The result is b^2 and a part of s^2.
    """
    leaves, first, counts = leaves_by_cell(octree, levels_up)
    cell = np.repeat(np.arange(len(counts)), counts)
    offsets = leaves - (np.add.reduceat(leaves, first) / counts[:, None])[cell]
    products = (offsets[:, :, None] * offsets[:, None, :]).reshape(-1, 9)
    moments = (np.add.reduceat(products, first) / counts[:, None]).reshape(-1, 3, 3)
    variances, axes = np.linalg.eigh(moments)
    normals = axes[:, :, 0]
    across = np.maximum(variances[:, 0], ROUGHNESS**2)
    residuals = np.einsum("ij,ij->i", offsets, normals[cell])
    kurtosis = np.add.reduceat(residuals**4, first) / counts / across**2
    across -= ROUGHNESS**2
    of_sheets = np.sqrt(np.clip((ONE_SHEET - kurtosis) / (ONE_SHEET - 1.0), 0.0, 1.0)) * across
    return normals, of_sheets + NOISE_SHARE**2 * (across - of_sheets)


def leaves_by_cell(octree: Octree, levels_up: int) -> tuple[Array, Int64s, Int64s]:
    """Return the leaves (N, 3) [m] of a level's fuller cells, and each cell's first one and their number."""
    level = len(octree.level_start) - 2 - levels_up
    edges = np.arange(octree.level_start[level], octree.level_start[level + 1] + 1)
    for _ in range(levels_up):
        edges = octree.first_child[edges]
    full = np.flatnonzero(np.diff(edges) >= MIN_LEAVES)
    full = full[np.linspace(0, len(full) - 1, min(len(full), MAX_CELLS)).astype(np.int64)]
    if len(full) == 0:
        return np.empty((0, 3)), full, full
    counts = (edges[full + 1] - edges[full]).astype(np.int64)
    first = np.cumsum(counts) - counts
    index = np.arange(counts.sum()) + np.repeat(edges[full] - first, counts)
    return octree.nodes[index, :3].astype(np.float64), first, counts


def fit_tensor(normals: Array, variances: Array) -> Array:
    """Fit a positive tensor T (3, 3), so that n T n is near the variance (C,) along each normal n (C, 3)."""
    rows, columns = np.triu_indices(3)
    twice = np.where(rows == columns, 1.0, 2.0)
    design = normals[:, rows] * normals[:, columns] * twice
    weights = np.ones(len(variances))
    tensor = np.zeros((3, 3))
    for _ in range(NUM_ITERATIONS):  # reweighted least squares
        weighted = design * weights[:, None]
        normal_matrix = design.T @ weighted + RIDGE * weights.sum() * np.diag(twice)
        found = np.linalg.solve(normal_matrix, weighted.T @ variances)
        weights = 1.0 / np.maximum(np.abs(design @ found - variances), LEAST_RESIDUAL)
    tensor[rows, columns] = tensor[columns, rows] = found
    values, axes = np.linalg.eigh(tensor)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
