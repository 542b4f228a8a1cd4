"""Profiles of a scan across its surfaces: how many voxels lie at each height over a patch of a plane."""

import math
from typing import NamedTuple

import numpy as np

from ..geometry.vectors import Triple, cross, dot
from ..system.arrays import Array, Int32s, Int64s
from ..system.jobs.threads import Workers
from ..system.kernels.jit import Scalar, inline_kernel, kernel
from .octree import DIAGONAL, Octree

BIN = 0.005  # [m] of heights
NUM_PROFILE_BINS = 19  # bins above a patch, and as many below
PROFILE_REACH = (NUM_PROFILE_BINS + 0.5) * BIN  # [m] height of a profile above and below its patch
MOST_AROUND = 8192  # voxels around a place, at most: thirty layers of 2 cm
NORMAL_TOLERANCE = 0.0125  # [m] from a sheet to the voxels by which its normal is found
NUM_FITS = 2  # of sheet and normal in turn
NUM_SQUARED = 6  # times (even) that a matrix is squared: only its greatest eigenvalue is left
MIDDLE_BINS = 8  # [bins] from the voxel at which a patch is placed within which its sheet is searched
TINY_NORM = 1e-150  # smaller norms count as this
FEW_VOXELS = 10  # a sheet with fewer voxels has no normal
PATCHES_AT_ONCE = 250  # patches that one task measures


class Profiles(NamedTuple):
    """N patches of a scan, and the voxels above and below each."""

    places: Array  # (N, 3) [m] their middles
    normals: Array  # (N, 3) unit, of either sign
    counts: Int32s  # (N, 4, 2 NUM_PROFILE_BINS + 1) voxels by quarter of the patch and height


@inline_kernel
def find_around(tree: Octree, place: Array, reach: float, found: Array) -> int:
    """Write the offsets (N, 3) [m] of leaves within reach [m] of a place (3,); return their number."""
    num_levels = len(tree.level_start) - 1
    num_roots = tree.level_start[1]
    stack = np.empty(num_roots + 8 * num_levels, np.int64)
    levels = np.zeros(len(stack), np.int64)
    for node in range(num_roots):
        stack[node] = node
    top = int(num_roots)
    count = 0
    while top > 0:
        top -= 1
        node = stack[top]
        level = levels[top]
        dx = tree.nodes[node, 0] - place[0]
        dy = tree.nodes[node, 1] - place[1]
        dz = tree.nodes[node, 2] - place[2]
        is_leaf = level == num_levels - 1
        margin = 0.0 if is_leaf else DIAGONAL * tree.leaf_size * 2.0 ** (num_levels - 1 - level)
        if dx * dx + dy * dy + dz * dz > (reach + margin) ** 2:
            continue
        if not is_leaf:
            for child in range(tree.first_child[node], tree.first_child[node + 1]):
                stack[top] = child
                levels[top] = level + 1
                top += 1
        elif count < len(found):
            found[count, 0] = dx
            found[count, 1] = dy
            found[count, 2] = dz
            count += 1
    return count


@inline_kernel
def write_adjugate(matrix: Array, adjugate: Array) -> None:
    """Write the adjugate of a symmetric matrix (3, 3)."""
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        for m in range(3):
            n = (m + 1) % 3
            o = (m + 2) % 3
            adjugate[i, m] = matrix[j, n] * matrix[k, o] - matrix[j, o] * matrix[k, n]


@inline_kernel
def write_square(matrix: Array, square: Array) -> None:
    """Write the square of a symmetric matrix (3, 3), divided by its squared trace."""
    scale = 1.0 / max(matrix[0, 0] + matrix[1, 1] + matrix[2, 2], TINY_NORM) ** 2
    for i in range(3):
        for j in range(3):
            square[i, j] = scale * dot(matrix[i], matrix[j])


@inline_kernel
def find_normal(moments: Array) -> Triple:
    """Return the unit eigenvector of the least eigenvalue of a symmetric matrix (3, 3).

    It is a column of a high power of the matrix' adjugate.
    """
    A = np.empty((3, 3))
    B = np.empty((3, 3))
    write_adjugate(moments, A)
    for _ in range(NUM_SQUARED // 2):
        write_square(A, B)
        write_square(B, A)
    best = 0
    for k in range(1, 3):
        if A[k, k] > A[best, best]:
            best = k
    length = max(math.sqrt(dot(A[best], A[best])), TINY_NORM)
    return A[best, 0] / length, A[best, 1] / length, A[best, 2] / length


@inline_kernel
def find_sheet(offsets: Array, count: int, normal: Triple, radius: float) -> float:
    """Return the height [m] near 0, along a normal, at which a disc has most of the offsets (N, 3) [m].

    Only the first `count` offsets are used; `radius` [m] is the disc's.
    """
    heights = np.zeros(2 * MIDDLE_BINS + 1)
    for i in range(count):
        height = dot(offsets[i], normal)
        across = dot(offsets[i], offsets[i]) - height * height
        if across < radius * radius and math.fabs(height) < MIDDLE_BINS * BIN:
            heights[math.floor(height / BIN + 0.5) + MIDDLE_BINS] += 1.0
    best = MIDDLE_BINS
    most = -1.0
    for k in range(MIDDLE_BINS // 2, 3 * MIDDLE_BINS // 2 + 1):
        total = heights[k - 1] + heights[k] + heights[k + 1]
        if total > most:
            best = k
            most = total
    return (best - MIDDLE_BINS) * BIN


@inline_kernel
def find_moments(
    offsets: Array, count: int, normal: Triple, radius: float, sheet: float, within: float, moments: Array
) -> int:
    """Write the second moments of the offsets in a sheet, and their mean as row 3; return their number.

    The offsets in the sheet are those of the first `count` (N, 3) [m] that are in the disc of `radius` [m]
    and whose heights along the normal differ from `sheet` [m] by less than `within` [m].
    """
    moments[:] = 0.0
    num = 0
    for i in range(count):
        height = dot(offsets[i], normal)
        across = dot(offsets[i], offsets[i]) - height * height
        if math.fabs(height - sheet) < within and across < radius * radius:
            num += 1
            for j in range(3):
                moments[3, j] += offsets[i, j]
                for k in range(3):
                    moments[j, k] += offsets[i, j] * offsets[i, k]
    for j in range(3):
        moments[3, j] /= max(num, 1)
    for j in range(3):
        for k in range(3):
            moments[j, k] = moments[j, k] / max(num, 1) - moments[3, j] * moments[3, k]
    return num


@inline_kernel
def count_heights(
    offsets: Array, count: int, normal: Triple, sheet: Scalar, radius: float, counts: Int32s
) -> None:
    """Count the first `count` offsets (N, 3) [m] by quarter of a disc and by height above a sheet.

    `counts` (4, 2 NUM_PROFILE_BINS + 1) is added to.
    """
    is_upright = math.fabs(normal[2]) < 0.7
    u = (normal[1], -normal[0], 0.0) if is_upright else (0.0, normal[2], -normal[1])
    v = cross(normal, u)
    for i in range(count):
        height = dot(offsets[i], normal)
        across = dot(offsets[i], offsets[i]) - height * height
        if math.fabs(height - sheet) < PROFILE_REACH and across < radius * radius:
            quarter = int(dot(offsets[i], u) > 0.0) + 2 * int(dot(offsets[i], v) > 0.0)
            counts[quarter, math.floor((height - sheet) / BIN + 0.5) + NUM_PROFILE_BINS] += 1


@kernel
def write_profiles(tree: Octree, radius: float, places: Array, normals: Array, counts: Int32s) -> None:
    """Write the normal and the profile of the patch at each place (N, 3) [m].

    The place is moved onto the patch's main sheet. `normals` (N, 3) and `counts` (N, 4, B) hold zeros before,
    and keep them where there are too few voxels.
    """
    offsets = np.empty((MOST_AROUND, 3))
    moments = np.empty((4, 3))
    reach = math.sqrt(radius * radius + (PROFILE_REACH + MIDDLE_BINS * BIN) ** 2)
    for p in range(len(places)):
        count = find_around(tree, places[p], reach, offsets)
        if find_moments(offsets, count, (0.0, 0.0, 0.0), radius, 0.0, reach, moments) < FEW_VOXELS:
            continue
        normal = find_normal(moments)
        height: Scalar = 0.0
        num = 0
        for _ in range(NUM_FITS):
            sheet = find_sheet(offsets, count, normal, radius)
            num = find_moments(offsets, count, normal, radius, sheet, NORMAL_TOLERANCE, moments)
            if num < FEW_VOXELS:
                break
            normal = find_normal(moments)
            height = dot(moments[3], normal)
        if num < FEW_VOXELS:
            continue
        count_heights(offsets, count, normal, height, radius, counts[p])
        for k in range(3):
            normals[p, k] = normal[k]
            places[p, k] += height * normal[k]


def measure_profiles(tree: Octree, leaves: Int64s, radius: float, workers: Workers) -> Profiles:
    """Return the profiles of patches with a radius [m] around leaves (N,), without those on no plane."""
    places = tree.nodes[leaves, :3].astype(np.float64)
    normals = np.zeros((len(leaves), 3))
    counts = np.zeros((len(leaves), 4, 2 * NUM_PROFILE_BINS + 1), np.int32)

    def write(begin: int) -> None:
        some = slice(begin, begin + PATCHES_AT_ONCE)
        write_profiles(tree, radius, places[some], normals[some], counts[some])

    silent = Workers(workers.num_threads)  # without progress: the work is too short to show it
    silent.map(write, range(0, len(leaves), PATCHES_AT_ONCE), "")
    is_plane = normals.any(axis=1)
    return Profiles(places[is_plane], normals[is_plane], counts[is_plane])
