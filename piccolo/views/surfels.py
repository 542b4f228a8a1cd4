"""Surfels: discs that close the surface between points, with a radius and a normal from the neighbours.

They are drawn into rows of an equirectangular picture: nearest range first, then weighted colours near it. A
pixel's ray sees a surfel where it meets the disc's plane within the radius; a surfel smaller than a pixel is
seen by the ray nearest to it.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..jobs.threads import Workers
from ..kernels.jit import F0, F1, inline_kernel, kernel
from ..panorama.texels import channel

NUM_NEIGHBORS = 10
CHUNK = 65_536
RADIUS_PER_REACH = 0.8  # surfel radius by the distance of the farthest of these neighbours
# A ray that grazes an edge leaves points in the air behind it. Such a point is farther from its neighbours
# than they are from theirs.
MAX_REACH = 1.6  # by the median of the neighbours' own
MIN_FLATNESS = 0.05  # second to largest eigenvalue; below, neighbours lie in a line and tell no plane
MAX_THICKNESS = 0.12  # smallest eigenvalue by the sum of all; of a ball, such as leaves, it is 1/3
THICK_RADIUS = 0.25  # so much smaller are surfels that are no part of a surface
MIN_RADIUS_PX = np.float32(0.75)  # every surfel reaches the centre of a pixel
# Layers nearer to each other than this are one surface: noise of a scanner.
BAND = np.float32(1.01)
BAND_OFFSET = np.float32(0.02)  # [m]
LEAST_WEIGHT = np.float32(1e-4)  # at the rim: whatever is seen has a colour
MAX_SLOPE = np.float32(1.25)  # of the range within a surfel or a pixel
TWO = np.float32(2.0)


class Surfels(NamedTuple):
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


@inline_kernel
def hit(surfel, dx, dy, dz, px_angle2):
    """Squared distance of the unit ray (dx, dy, dz) from a surfel's centre by its radius, and range [m]."""
    x, y, z, nx, ny, nz, along, per_radius2, distance = surfel
    facing = nx * dx + ny * dy + nz * dz
    t = along / facing
    ex, ey, ez = t * dx - x, t * dy - y, t * dz - z
    q = (ex * ex + ey * ey + ez * ez) * per_radius2
    if not facing * along > F0:  # a plane along the ray divides by zero: NaN is no hit
        q, t = TWO, distance
    # What the ray meets beside the surfel, in the same pixel: the surface goes on, but nobody knows how far.
    t = min(max(t, distance / MAX_SLOPE), distance * MAX_SLOPE)
    ex, ey, ez = dx - x / distance, dy - y / distance, dz - z / distance
    return min(q, (ex * ex + ey * ey + ez * ez) / px_angle2), t


@inline_kernel
def half_width(elevation, of_center, angle):
    """Azimuths [rad] on a row to each side of a centre that are within `angle` of it; -1 if none are."""
    over = math.sin(0.5 * angle) ** 2 - math.sin(0.5 * (elevation - of_center)) ** 2
    if over < 0.0:
        return -1.0
    fraction = over / max(math.cos(elevation) * math.cos(of_center), 1e-12)
    return math.pi if fraction >= 1.0 else 2.0 * math.asin(math.sqrt(fraction))


@kernel
def splat(surfels, rgbx, directions, angles, first_row, depth, sums):
    """Draw surfels into the rows from `first_row` on: into `depth`, or into `sums` if that is not empty.

    surfels (N, 9): centre [m], normal, product of both, 1 / radius^2, range [m], in the camera's frame;
    directions (N, 2): azimuth and elevation, angles (N,): radius as seen [rad].
    The nearest range [m] is written into depth (rows, W), which holds inf before; then sums (rows, W, 5) gets
    R, G, B [8-bit levels], range [m] and 1 of what is near that range, each times a weight, added.
    """
    width = depth.shape[1]
    step = 2.0 * math.pi / width
    px_angle2 = np.float32((MIN_RADIUS_PX * step) ** 2)
    cosines, sines = np.empty(width, np.float32), np.empty(width, np.float32)
    for j in range(width):
        cosines[j], sines[j] = math.cos(math.pi - (j + 0.5) * step), math.sin(math.pi - (j + 0.5) * step)
    for n in range(len(surfels)):
        d, c = surfels[n], rgbx[n]
        surfel = (d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8])
        azimuth, elevation = directions[n, 0], directions[n, 1]
        top = math.ceil((0.5 * math.pi - elevation - angles[n]) / step - 0.5) - first_row
        bottom = math.floor((0.5 * math.pi - elevation + angles[n]) / step - 0.5) - first_row
        for i in range(max(top, 0), min(bottom + 1, len(depth))):
            of_row = 0.5 * math.pi - (first_row + i + 0.5) * step
            half = half_width(of_row, elevation, angles[n])
            left = math.ceil((math.pi - azimuth - half) / step - 0.5)
            right = min(math.floor((math.pi - azimuth + half) / step - 0.5), left + width - 1)
            cosine, sine = np.float32(math.cos(of_row)), np.float32(math.sin(of_row))
            for at in range(left, right + 1):
                j = (at + width) % width
                q, t = hit(surfel, cosine * cosines[j], cosine * sines[j], sine, px_angle2)
                if q >= F1:
                    continue
                if len(sums) == 0:
                    depth[i, j] = min(depth[i, j], t)
                elif t <= depth[i, j] * BAND + BAND_OFFSET:
                    weight = (F1 - q) * (F1 - q) * (F1 - q) + LEAST_WEIGHT
                    s = sums[i, j]
                    s[0] += weight * channel(c, 0)
                    s[1] += weight * channel(c, 8)
                    s[2] += weight * channel(c, 16)
                    s[3] += weight * t
                    s[4] += weight
