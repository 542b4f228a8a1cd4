"""The surfaces of a scan: their edges, which photos show too, painted as colours; and the noise across them.

A crease is where neighbouring normals differ, measured by the second eigenvalue of their mean outer product.
A border is where a surface ends: the points around lie to one side. Both are painted as two of the three
opponent channels of a colour: how strong the edge is, and how much stronger vertical edges are than others.
The third channel is the intensity of the points, if they have one.

Noise averages out over the points that a photo shows, but for a part of it. Where scans are shifted against
each other, each surface is there twice, and a pose may follow one or the other.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..geometry.colors import colors_of_edges
from ..geometry.robust import weigh_absolute
from ..system.arrays import Array, Array32, Int64s, Integers
from ..system.jobs.threads import Workers
from .octree import Octree, recolor

CELLS_AT_ONCE = 20_000  # voxels that one task takes
FULL_CREASE = 0.6  # root of the second eigenvalue at an edge of strength 1; 0.7 for a right angle
BORDER = 0.08, 0.28  # distance of the neighbours' mean, divided by the radius, for strength 0 and strength 1
COS_UPRIGHT = 0.8, 0.95  # cosine of a crease's angle to the vertical: not vertical at all, and fully
VERTICAL_BORDER = 0.9, 0.98  # the same of a border
CELLS = (3, 4)  # levels above the leaves: cells of 16 and 32 cm, by which wavy surfaces are found
# levels above the leaves, and least leaves of a cell, by which noise is measured: cells of 16 cm, or of 32 or
# 64 cm in thin scans. Those of 64 cm come last, as in furnished rooms most have several surfaces
NOISE_CELLS = ((3, 20), (4, 20), (4, 10), (5, 20))
FULL_SHARE = 0.4  # of all leaves, at least, lie in full cells: in thinner scans those have two surfaces
MOST_ACROSS = 0.05  # [m] deviation from a cell's plane: cells with more have several surfaces
MIN_LEAVES = 20  # of a full cell
MIN_CELLS = 200  # with fewer nothing is measured
MAX_CELLS = 20_000  # that are used, evenly chosen
SOME_CELLS = 1000  # that are processed at a time
NOISE_SHARE = 0.3  # of the noise's deviation that stays in a position, by trials with noise of 1 to 5 cm
ONE_SHEET = 2.5  # kurtosis of noise within a cell, about; that of two thin sheets is 1
ROUGHNESS = 0.005  # [m] deviation of clean surfaces with the things on them
LEAST_UNEVEN = 0.03  # ratio of the two smaller variances of a cell: flat cells have less
SURFACE = 1.28  # [m] chosen: size of surfaces, which are displaced against each other
UNKNOWN_DISPLACEMENT = 0.01  # [m] chosen
NUM_ITERATIONS = 60  # of reweighted least squares
# [m^2] cells with smaller residuals weigh alike. It must be below the noise of good scans, or cells with
# things in them raise the variance
LEAST_RESIDUAL_SQUARED = 1e-7
NORM_RIDGE = 0.06  # weight of the tensor's norm: two walls at a right angle leave a part of it undetermined


class Surroundings(NamedTuple):
    """The neighbourhoods of a voxel in which its normal and its edges are found."""

    normal_radius: float  # [m] in which its normal is found
    num_normal: int  # voxels within that radius, at most
    edge_radius: float  # [m] in which normals are compared
    num_edge: int  # voxels within that radius, at most


WIDE_SURROUNDINGS = Surroundings(0.12, 24, 0.15, 48)  # for voxels of 4 cm
NARROW = Surroundings(0.06, 12, 0.06, 16)  # for the leaves, voxels of 2 cm


def paint_shape(octree: Octree, workers: Workers) -> Octree:
    """Return the octree, in the map's frame, with edges of the surfaces in place of colours.

    The edges of the leaves are narrow, for the last descent; those of all other levels are wide.
    """
    start = octree.level_start
    begin, end = int(start[-3]), int(start[-2])
    colors = color_edges(octree.nodes[begin:end], WIDE_SURROUNDINGS, workers)
    counts = np.diff(octree.first_child[begin : end + 1])
    painted = recolor(octree, np.repeat(colors, counts, axis=0), np.ones(len(octree.nodes) - end, np.float32))
    painted.nodes[end:, 3:] = color_edges(octree.nodes[end:], NARROW, workers)
    return painted


def color_edges(nodes: Array32, around: Surroundings, workers: Workers) -> Array32:
    """Return the colours (N, 3), in [0, 1], of the edges at grey nodes (N, 6) of an octree whose z is up."""
    strength, vertical = find_edges(nodes[:, :3].astype(np.float64), around, workers).T
    return np.asarray(colors_of_edges(strength, vertical, nodes[:, 3]) / np.float32(255.0), np.float32)


def find_edges(points: Array, around: Surroundings, workers: Workers) -> Array:
    """Return the strength (N, 2), in [0, 1], of edges and of vertical edges at points (N, 3) [m], z up."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when a scan is prepared

    tree = cKDTree(points)
    parts = [slice(lo, lo + CELLS_AT_ONCE) for lo in range(0, len(points), CELLS_AT_ONCE)]
    normals = np.concatenate(
        workers.map(lambda part: find_normals(points, tree, around, part), parts, "find surfaces") or [points]
    )
    edges = workers.map(lambda part: edges_of(points, tree, normals, around, part), parts, "find edges")
    return np.concatenate(edges or [np.empty((0, 2))])


def neighbors(tree: Any, points: Array, count: int, radius: float) -> tuple[Integers, Array]:
    """Return the indices (N, count) of the nearest points within a radius [m], and weights (N, count).

    The weight is 1; where there are fewer points, index and weight are 0.
    """
    distances, indices = tree.query(points, count, distance_upper_bound=radius)
    is_there = np.isfinite(distances)
    return np.where(is_there, indices, 0), is_there.astype(np.float64)


def find_normals(points: Array, tree: Any, around: Surroundings, part: slice) -> Array:
    """Return the unit normals (N, 3), of either sign, at a part of the points."""
    indices, weights = neighbors(tree, points[part], around.num_normal, around.normal_radius)
    offsets = points[indices] - points[part][:, None]
    total = weights.sum(axis=1)
    middle = np.einsum("nk,nki->ni", weights, offsets) / total[:, None]
    second = np.einsum("nk,nki,nkj->nij", weights, offsets, offsets) / total[:, None, None]
    return np.linalg.eigh(second - middle[:, :, None] * middle[:, None])[1][:, :, 0]


def edges_of(points: Array, tree: Any, normals: Array, around: Surroundings, part: slice) -> Array:
    """Return the strength of edges, as of `find_edges`, at a part of the points with normals (N, 3)."""
    indices, weights = neighbors(tree, points[part], around.num_edge, around.edge_radius)
    total = weights.sum(axis=1)
    near = normals[indices]
    second = np.einsum("nk,nki,nkj->nij", weights, near, near) / total[:, None, None]
    values, axes = np.linalg.eigh(second)
    crease = np.clip(np.sqrt(np.maximum(values[:, 1], 0.0)) / FULL_CREASE, 0.0, 1.0)
    along = np.abs(axes[:, 2, 0])  # the crease's direction is at right angles to its normals
    normal = normals[part]
    middle = np.einsum("nk,nki->ni", weights, points[indices] - points[part][:, None]) / total[:, None]
    middle -= normal * np.einsum("ni,ni->n", middle, normal)[:, None]
    distance = np.linalg.norm(middle, axis=1)
    border = rise(distance / around.edge_radius, BORDER)
    along_border = np.abs(np.cross(middle, normal)[:, 2]) / np.maximum(distance, 1e-9)
    vertical = np.maximum(crease * rise(along, COS_UPRIGHT), border * rise(along_border, VERTICAL_BORDER))
    return np.stack([np.maximum(crease, border), vertical], axis=1)


def rise(values: Array, limits: tuple[float, float]) -> Array:
    """Map values linearly: the first limit to 0, the second to 1, clipped to [0, 1]."""
    return np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)


def surface_variance(octree: Octree) -> Array:
    """Return the covariance (3, 3) [m^2] of a position aligned with a scan, by the scan's own errors.

    It is zero for a scan with too few points. Each cell measures the variance along its normal; the tensor is
    the one that fits the cells with least absolute deviations. The cells have the smallest size at which most
    surfaces fill them. At a smaller size only cells with several surfaces are full; at a larger size most
    cells have several surfaces, which would be taken for noise.
    """
    for levels_up, least_leaves in NOISE_CELLS:
        if share_in_full(octree, levels_up, least_leaves) < FULL_SHARE:
            continue
        cells = residual_moments(octree, levels_up, least_leaves)
        if len(cells[1]) >= MIN_CELLS:
            tensor = fit_tensor(*cells)
            return tensor.astype(np.float32).astype(np.float64)  # its last digits depend on the BLAS library
    return np.zeros((3, 3))


def residual_moments(octree: Octree, levels_up: int, least_leaves: int) -> tuple[Array, Array]:
    """Return normals (C, 3) and variances (C,) [m^2] of the cells of a level, as of `moments_of_cells`.

    Only cells with `least_leaves` leaves or more that have one plane are returned.
    """
    parts = [(np.empty((0, 3)), np.empty(0))]
    parts += map(moments_of_cells, fit_planes(octree, levels_up, least_leaves))
    normals, variances = map(np.concatenate, zip(*parts, strict=True))
    return normals, variances


class Planes(NamedTuple):
    """Planes fitted to the leaves of C cells, N leaves in all."""

    offsets: Array  # (N, 3) [m] of the leaves from the mean of their cell, cell by cell
    counts: Int64s  # (C,) number of leaves in each cell
    variances: Array  # (C, 3) [m^2] along the axes, ascending: the first is across the plane
    axes: Array  # (C, 3, 3) the principal axes, in columns


def find_edges_of_cells(octree: Octree, levels_up: int) -> Integers:
    """Return the node (C + 1,) at which the leaves of each of a level's C cells begin, and their end."""
    level = len(octree.level_start) - 2 - levels_up
    edges: Integers = np.arange(octree.level_start[level], octree.level_start[level + 1] + 1)
    for _ in range(levels_up):
        edges = octree.first_child[edges]
    return edges


def share_in_full(octree: Octree, levels_up: int, least_leaves: int) -> float:
    """Return the fraction of all leaves that lie in a level's cells with `least_leaves` or more."""
    counts = np.diff(find_edges_of_cells(octree, levels_up))
    return float(counts[counts >= least_leaves].sum() / max(counts.sum(), 1))


def fit_planes(octree: Octree, levels_up: int, least_leaves: int = MIN_LEAVES) -> Iterator[Planes]:
    """Yield planes fitted to the leaves of a level's cells with `least_leaves` or more, some cells at a time.

    If there are more than MAX_CELLS such cells, only so many are used, evenly chosen.
    """
    edges = find_edges_of_cells(octree, levels_up)
    full = np.flatnonzero(np.diff(edges) >= least_leaves)
    full = full[np.linspace(0, len(full) - 1, min(len(full), MAX_CELLS)).astype(np.int64)]
    for begin in range(0, len(full), SOME_CELLS):
        some = full[begin : begin + SOME_CELLS]
        counts = (edges[some + 1] - edges[some]).astype(np.int64)
        first = np.cumsum(counts) - counts
        which = np.arange(counts.sum()) + np.repeat(edges[some] - first, counts)
        leaves: Array = octree.nodes[which, :3].astype(np.float64)
        offsets = leaves - np.repeat(np.add.reduceat(leaves, first) / counts[:, None], counts, axis=0)
        products = (offsets[:, :, None] * offsets[:, None, :]).reshape(-1, 9)
        moments = (np.add.reduceat(products, first) / counts[:, None]).reshape(-1, 3, 3)
        yield Planes(offsets, counts, *np.linalg.eigh(moments))


def moments_of_cells(planes: Planes) -> tuple[Array, Array]:
    """Return the normals (C, 3) of cells with one plane, and the variances (C,) [m^2] along them.

    A variance is that which a pose gets from the cell: b^2 of two sheets at +-b, plus NOISE_SHARE^2 of the
    noise's variance s^2. The two follow from the kurtosis of the residuals r. For one noisy sheet it is 3,
    less what the cell cuts off; for two sheets E r^4 = 3 (b^2 + s^2)^2 - 2 b^4.
    """
    offsets, counts, variances, axes = planes
    cell = np.repeat(np.arange(len(counts)), counts)
    is_surface = (variances[:, 0] < MOST_ACROSS**2) & (variances[:, 1] > 0.5 * variances[:, 2])
    normals = axes[:, :, 0]
    across = np.maximum(variances[:, 0], ROUGHNESS**2)
    residuals = np.einsum("ij,ij->i", offsets, normals[cell])
    kurtosis = np.bincount(cell, residuals**4) / counts / across**2
    across -= ROUGHNESS**2
    of_sheets = np.sqrt(np.clip((ONE_SHEET - kurtosis) / (ONE_SHEET - 1.0), 0.0, 1.0)) * across
    of_pose = of_sheets + NOISE_SHARE**2 * (across - of_sheets)
    return normals[is_surface], of_pose[is_surface]


def displacement(octree: Octree) -> float:
    """Return the standard deviation [m] by which a scan's surfaces are displaced against each other.

    Scans that drift are wavy: cells of twice the size are less flat, while noise stays the same. The variance
    that is added from one cell size to the next gives a deviation, which is extrapolated in proportion to the
    size of a surface. Return UNKNOWN_DISPLACEMENT for a scan with too few flat cells.
    """
    variances = []
    for levels_up in CELLS:
        of_cells = [planes.variances for planes in fit_planes(octree, levels_up)]
        across = [v[v[:, 0] < LEAST_UNEVEN * v[:, 1], 0] for v in of_cells]
        if sum(map(len, across)) < MIN_CELLS:
            return UNKNOWN_DISPLACEMENT
        variances.append(float(np.median(np.concatenate(across))))
    size = octree.leaf_size * 2 ** CELLS[-1]
    return float(SURFACE / size * math.sqrt(max(variances[1] - variances[0], 0.0)))


def fit_tensor(normals: Array, variances: Array) -> Array:
    """Fit a positive tensor T (3, 3) so that n^T T n is near the variance (C,) along each normal n (C, 3)."""
    rows, columns = np.triu_indices(3)
    twice = np.where(rows == columns, 1.0, 2.0)
    design = normals[:, rows] * normals[:, columns] * twice
    weights = np.ones(len(variances))
    ridge = 1.0  # weighted like a residual, so that it stays small for few cells too
    tensor = np.zeros((3, 3))
    for _ in range(NUM_ITERATIONS):  # reweighted least squares
        weighted = design * weights[:, None]
        normal_matrix = design.T @ weighted + NORM_RIDGE * len(variances) * ridge * np.diag(twice)
        upper = np.linalg.solve(normal_matrix, weighted.T @ variances)
        weights = weigh_absolute(design @ upper - variances, LEAST_RESIDUAL_SQUARED)
        ridge = 1.0 / max(math.sqrt(twice @ upper**2), LEAST_RESIDUAL_SQUARED)
    tensor[rows, columns] = upper
    tensor[columns, rows] = upper
    values, axes = np.linalg.eigh(tensor)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
