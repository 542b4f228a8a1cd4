"""The shape of a scan as its colours: creases and borders of its surfaces, which photos show as edges.

A crease is where neighbouring normals differ, by the second eigenvalue of their mean outer product. A border
is where a surface ends: the points around lie to one side. Both are painted as two of the three opponent
channels of a colour: how strong the edge is, and how much stronger vertical ones are than the others.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.colors import colors_of_edges
from ..geometry.pose import Array
from ..jobs.threads import Workers
from .octree import Octree, recolor

SIZE = 0.04  # [m] voxels whose surfaces are found
NORMAL_RADIUS = 0.12  # [m] around a voxel, in which its normal is found
NUM_NORMAL = 24  # voxels in it, at most
EDGE_RADIUS = 0.15  # [m] in which normals are compared
NUM_EDGE = 48
AT_ONCE = 20_000  # voxels of a task
FULL_CREASE = 0.6  # root of the second eigenvalue; 0.7 for two planes at a right angle
BORDER = 0.08, 0.28  # distance of the surroundings' middle, divided by the radius: nothing, and a full border
VERTICAL = 0.8, 0.95  # cosine of an edge's angle to the vertical: not vertical at all, and fully
VERTICAL_BORDER = 0.9, 0.98


def paint_shape(octree: Octree, workers: Workers) -> Octree:
    """Return the octree, in the map's frame, with edges of the surfaces in place of colours."""
    start = octree.level_start
    begin, end = int(start[-3]), int(start[-2])
    colors = find_edges(octree.nodes[begin:end, :3].astype(np.float64), workers) / np.float32(255.0)
    counts = np.diff(octree.first_child[begin : end + 1])
    return recolor(octree, np.repeat(colors, counts, axis=0), np.ones(len(octree.nodes) - end, np.float32))


def find_edges(points: Array, workers: Workers) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of the edges of surfaces at points (N, 3) [m], about SIZE apart, z up."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

    tree = cKDTree(points)
    parts = [slice(lo, lo + AT_ONCE) for lo in range(0, len(points), AT_ONCE)]
    normals = np.concatenate(
        workers.map(lambda part: find_normals(points, tree, part), parts, "find surfaces") or [points]
    )
    found = workers.map(lambda part: edges_of(points, tree, normals, part), parts, "find edges")
    return np.concatenate(found or [np.empty((0, 3), np.uint8)])


def neighbors(tree: Any, points: Array, count: int, radius: float) -> tuple[NDArray[np.intp], Array]:
    """Return the indices (N, count) of the nearest points within a radius, and 1 for each that is there."""
    distances, indices = tree.query(points, count, distance_upper_bound=radius)
    is_there = np.isfinite(distances)
    return np.where(is_there, indices, 0), is_there.astype(np.float64)


def find_normals(points: Array, tree: Any, part: slice) -> Array:
    """Return the unit normals (N, 3), of either sign, at a part of the points."""
    indices, weights = neighbors(tree, points[part], NUM_NORMAL, NORMAL_RADIUS)
    around = points[indices] - points[part][:, None]
    total = weights.sum(axis=1)
    middle = np.einsum("nk,nki->ni", weights, around) / total[:, None]
    second = np.einsum("nk,nki,nkj->nij", weights, around, around) / total[:, None, None]
    return np.linalg.eigh(second - middle[:, :, None] * middle[:, None])[1][:, :, 0]


def edges_of(points: Array, tree: Any, normals: Array, part: slice) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of the edges at a part of the points with normals (N, 3)."""
    indices, weights = neighbors(tree, points[part], NUM_EDGE, EDGE_RADIUS)
    total = weights.sum(axis=1)
    around = normals[indices]
    values, axes = np.linalg.eigh(
        np.einsum("nk,nki,nkj->nij", weights, around, around) / total[:, None, None]
    )
    crease = np.clip(np.sqrt(np.maximum(values[:, 1], 0.0)) / FULL_CREASE, 0.0, 1.0)
    along = np.abs(axes[:, 2, 0])  # the normals of a crease lie across it
    normal = normals[part]
    middle = np.einsum("nk,nki->ni", weights, points[indices] - points[part][:, None]) / total[:, None]
    middle -= normal * np.einsum("ni,ni->n", middle, normal)[:, None]
    distance = np.linalg.norm(middle, axis=1)
    border = rise(distance / EDGE_RADIUS, BORDER)
    along_border = np.abs(np.cross(middle, normal)[:, 2]) / np.maximum(distance, 1e-9)
    vertical = np.maximum(crease * rise(along, VERTICAL), border * rise(along_border, VERTICAL_BORDER))
    return colors_of_edges(np.maximum(crease, border), vertical)


def rise(values: Array, limits: tuple[float, float]) -> Array:
    """Return values that rise from 0 at the first limit to 1 at the second."""
    return np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
