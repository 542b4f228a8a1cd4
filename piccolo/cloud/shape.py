"""The shape of a scan as its colours: creases and borders of its surfaces, which photos show as edges.

A crease is where neighbouring normals differ, by the second eigenvalue of their mean outer product. A border
is where a surface ends: the points around lie to one side. Both are painted as two of the three opponent
channels of a colour: how strong the edge is, and how much stronger vertical ones are than the others. The
third is the intensity of the points, if they have one.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Array32
from ..geometry.colors import colors_of_edges
from ..jobs.threads import Workers
from .octree import Octree, recolor

AT_ONCE = 20_000  # voxels of a task
FULL_CREASE = 0.6  # root of the second eigenvalue; 0.7 for two planes at a right angle
BORDER = 0.08, 0.28  # distance of the surroundings' middle, divided by the radius: nothing, and a full border
VERTICAL = 0.8, 0.95  # cosine of an edge's angle to the vertical: not vertical at all, and fully
VERTICAL_BORDER = 0.9, 0.98


class Surroundings(NamedTuple):
    """The neighbours of a voxel by which its edges are found."""

    normal_radius: float  # [m] in which its normal is found
    num_normal: int  # voxels in it, at most
    edge_radius: float  # [m] in which normals are compared
    num_edge: int


WIDE = Surroundings(0.12, 24, 0.15, 48)  # of voxels of 4 cm
NARROW = Surroundings(0.06, 12, 0.06, 16)  # of the leaves, of 2 cm


def paint_shape(octree: Octree, workers: Workers) -> Octree:
    """Return the octree, in the map's frame, with edges of the surfaces in place of colours.

    Those of the leaves are narrow, for the last descent; those of all other levels wide.
    """
    start = octree.level_start
    begin, end = int(start[-3]), int(start[-2])
    colors = color_edges(octree.nodes[begin:end], WIDE, workers)
    counts = np.diff(octree.first_child[begin : end + 1])
    painted = recolor(octree, np.repeat(colors, counts, axis=0), np.ones(len(octree.nodes) - end, np.float32))
    painted.nodes[end:, 3:] = color_edges(octree.nodes[end:], NARROW, workers)
    return painted


def color_edges(nodes: Array32, around: Surroundings, workers: Workers) -> Array32:
    """Return the colours (N, 3), in [0, 1], of the edges at nodes (N, 6) in grey, z up."""
    strength, vertical = find_edges(nodes[:, :3].astype(np.float64), around, workers).T
    return np.asarray(colors_of_edges(strength, vertical, nodes[:, 3]) / np.float32(255.0), np.float32)


def find_edges(points: Array, around: Surroundings, workers: Workers) -> Array:
    """Return the edges (N, 2) of surfaces at points (N, 3) [m], z up, each in [0, 1].

    They are how strong an edge is, and how strong a vertical one.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who prepares a scan waits for it

    tree = cKDTree(points)
    parts = [slice(lo, lo + AT_ONCE) for lo in range(0, len(points), AT_ONCE)]
    normals = np.concatenate(
        workers.map(lambda part: find_normals(points, tree, around, part), parts, "find surfaces") or [points]
    )
    found = workers.map(lambda part: edges_of(points, tree, normals, around, part), parts, "find edges")
    return np.concatenate(found or [np.empty((0, 2))])


def neighbors(tree: Any, points: Array, count: int, radius: float) -> tuple[NDArray[np.intp], Array]:
    """Return the indices (N, count) of the nearest points within a radius, and 1 for each that is there."""
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
    """Return the edges (N, 2) at a part of the points with normals (N, 3)."""
    indices, weights = neighbors(tree, points[part], around.num_edge, around.edge_radius)
    total = weights.sum(axis=1)
    near = normals[indices]
    second = np.einsum("nk,nki,nkj->nij", weights, near, near) / total[:, None, None]
    values, axes = np.linalg.eigh(second)
    crease = np.clip(np.sqrt(np.maximum(values[:, 1], 0.0)) / FULL_CREASE, 0.0, 1.0)
    along = np.abs(axes[:, 2, 0])  # the normals of a crease lie across it
    normal = normals[part]
    middle = np.einsum("nk,nki->ni", weights, points[indices] - points[part][:, None]) / total[:, None]
    middle -= normal * np.einsum("ni,ni->n", middle, normal)[:, None]
    distance = np.linalg.norm(middle, axis=1)
    border = rise(distance / around.edge_radius, BORDER)
    along_border = np.abs(np.cross(middle, normal)[:, 2]) / np.maximum(distance, 1e-9)
    vertical = np.maximum(crease * rise(along, VERTICAL), border * rise(along_border, VERTICAL_BORDER))
    return np.stack([np.maximum(crease, border), vertical], axis=1)


def rise(values: Array, limits: tuple[float, float]) -> Array:
    """Return values that rise from 0 at the first limit to 1 at the second."""
    return np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
