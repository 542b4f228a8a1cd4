"""The cloud rendered at a pose as surfels: discs around points, large enough to close the surface.

A disc is fitted to a point and its nearest neighbours. Discs are drawn into an equirectangular picture twice:
first to find the nearest range of each pixel, then to add up weighted colours near that range. A pixel's ray
sees a surfel if it meets the disc's plane within the radius; a surfel smaller than a pixel is seen by the ray
nearest to it.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.points import PackedPoints
from ..geometry.pose import Pose
from ..geometry.sphere import compute_rays, direction_to_pixel
from ..photo.panorama.texels import channel
from ..system.arrays import Array, Array32, Int32s, Int64s, Mask
from ..system.jobs.threads import Workers
from ..system.kernels.jit import F0, F1, Scalar, inline_kernel, kernel
from .zbuffer import Coordinates, View, indices_in_front, nearest_depth

NUM_SURFEL_NEIGHBORS = 10
SURFEL_CHUNK = 65_536  # points that one task fits
RADIUS_PER_REACH = 0.8  # surfel radius, divided by the distance of the farthest of these neighbours
# A ray that grazes an edge leaves points in the air behind it. Such a point is farther from its neighbours
# than they are from theirs.
MAX_REACH = 1.6  # largest radius, divided by the median of the neighbours' radii
MIN_FLATNESS = 0.05  # second eigenvalue to the largest; below, neighbours are on a line: no plane
MAX_THICKNESS = 0.12  # smallest eigenvalue to the sum of all three; for a ball, such as leaves, it is 1/3
THICK_RADIUS = 0.25  # factor of the radius of surfels that are not part of a surface
MIN_RADIUS_PX = np.float32(0.75)  # every surfel reaches the centre of a pixel
# Points up to this times the nearest range, and the offset, are one surface: noise of a scanner.
SURFACE_BAND = np.float32(1.01)
BAND_OFFSET = np.float32(0.02)  # [m]
LEAST_RIM_WEIGHT = np.float32(1e-4)  # weight at the rim, above 0 so that every pixel seen has a colour
MAX_SLOPE = np.float32(1.25)  # largest ratio of ranges within a surfel or a pixel
PIXELS_AT_ONCE = 1 << 21  # pixels that one thread draws at a time
MAX_SURFELS = 8_000_000  # if more points may be seen, only so many are drawn, evenly in space
MAX_SURFEL_ANGLE = 0.3  # [rad] largest angle of a surfel's radius
MIN_COSINE = 0.15  # a surfel seen at a flatter angle is turned towards the camera: normals have errors
# Rooms behind gaps leave lone points with large surfels, which are not drawn; far away, surfaces are sparse.
MAX_RADIUS = 1.5  # largest radius, divided by the radius that 95 % of the surfels stay below
MIN_RANGE = 1e-3  # [m] nothing nearer to the camera is drawn
HIDING_WIDTHS = (360, 720)  # cells of 1 and 1/2 degrees; wider ones hide what is seen through a door ajar
NOWHERE = np.float32(-1.0)  # extent of a surfel that is not drawn: no pixel is within -1 of it
FAR_ANGLE = 0.02  # [rad] up to this angle a surfel's radius may be larger than MAX_RADIUS allows

# a surfel in the camera's frame: centre [m], normal, their dot product, 1 / radius^2, range [m]
Disc = tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]


class Surfels(NamedTuple):
    """Coloured discs around N points."""

    points: PackedPoints
    normals: Array32  # (N, 3) unit, of either sign; 0 if there is no plane: the disc faces the camera
    radii: Array32  # (N,) [m], 0 for a surfel that is always drawn one pixel large

    def take(self, indices: NDArray[np.integer]) -> "Surfels":
        """Return the surfels at `indices`, in that order."""
        return Surfels(self.points.take(indices), self.normals[indices], self.radii[indices])


def make_surfels(points: PackedPoints, workers: Workers) -> Surfels:
    """Fit a surfel to each point and its nearest neighbours; leave out points in the air."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when a picture is drawn

    positions = points.stack()
    normals = np.zeros_like(positions)
    radii = np.zeros(len(positions), np.float32)
    if len(positions) <= NUM_SURFEL_NEIGHBORS:
        return Surfels(points, normals, radii)
    tree = cKDTree(positions, balanced_tree=False, compact_nodes=False)
    neighbors = np.empty((len(positions), NUM_SURFEL_NEIGHBORS + 1), np.int32)

    def run(lo: int) -> None:
        part = slice(lo, lo + SURFEL_CHUNK)
        distances, neighbors[part] = tree.query(positions[part], NUM_SURFEL_NEIGHBORS + 1)
        normals[part], is_thick = planes(positions[neighbors[part]])
        radii[part] = RADIUS_PER_REACH * distances[:, -1] * np.where(is_thick, THICK_RADIUS, 1.0)

    list(workers.map(run, range(0, len(positions), SURFEL_CHUNK), "surface"))
    is_surface = np.empty(len(positions), np.bool_)
    for lo in range(0, len(positions), SURFEL_CHUNK):
        part = slice(lo, lo + SURFEL_CHUNK)
        is_surface[part] = radii[part] <= MAX_REACH * np.median(radii[neighbors[part]], axis=1)
    return Surfels(points, normals, radii).take(np.flatnonzero(is_surface))


def planes(neighborhoods: Array32) -> tuple[Array32, Mask]:
    """Return the unit normals (N, 3) of neighbourhoods (N, K, 3), and a mask (N,) of those that are thick.

    The normal is 0 if the neighbours lie in no plane.
    """
    offsets = neighborhoods - neighborhoods.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    is_thick = values[:, 0] > MAX_THICKNESS * values.sum(axis=1)
    has_plane = (values[:, 1] > MIN_FLATNESS * values[:, 2]) & ~is_thick
    return np.asarray(vectors[:, :, 0] * has_plane[:, None], np.float32), is_thick


@inline_kernel
def hit(surfel: Disc, dx: Scalar, dy: Scalar, dz: Scalar, px_angle2: Scalar) -> tuple[Scalar, Scalar]:
    """Intersect a unit ray (dx, dy, dz) with a surfel's plane; return (distance / radius)^2 and range [m].

    The distance is that of the intersection from the surfel's centre. `px_angle2` is the square of the least
    radius [rad^2]: a ray nearer to the centre meets the surfel, however small it is.
    """
    x, y, z, nx, ny, nz, along, per_radius2, distance = surfel
    facing = nx * dx + ny * dy + nz * dz
    t = along / facing
    q = ((t * dx - x) ** 2 + (t * dy - y) ** 2 + (t * dz - z) ** 2) * per_radius2
    if not facing * along > F0:  # a plane along the ray divides by zero: NaN is no hit
        q = F1 + F1
        t = distance
    # A ray that misses the disc within the pixel: the surface goes on, but its range there is not known.
    t = min(max(t, distance / MAX_SLOPE), distance * MAX_SLOPE)
    gap2 = (dx - x / distance) ** 2 + (dy - y / distance) ** 2 + (dz - z / distance) ** 2
    return min(q, gap2 / px_angle2), t


@kernel
def splat(
    surfels: Array32,
    rgbx: Int32s,
    extents: Array32,
    columns: Array32,
    rows: Array32,
    first_row: int,
    depth: Array32,
    sums: Array32,
) -> None:
    """Draw surfels into n rows of a picture from `first_row` on: ranges first, then colours.

    `surfels` (N, 9) and `extents` (N, 4) are those of `pack_discs`. `columns` (W, 2) and `rows` (W / 2, 2)
    are cosines and sines of azimuths and elevations. If `sums` is empty, `depth` (n, W), which holds inf
    before, gets the nearest range [m]. Else `depth` is read, and `sums` (n, W, 5) gets the weighted sums of
    R, G, B [8-bit levels], range [m] and 1 over the surfels near that range.
    """
    width = depth.shape[1]
    px_angle2 = np.float32((MIN_RADIUS_PX * 2.0 * math.pi / width) ** 2)
    for n in range(len(surfels)):
        d = surfels[n]
        c = rgbx[n]
        surfel = (d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8])
        u = extents[n, 0] - 0.5
        v = extents[n, 1] - 0.5 - first_row
        half = extents[n, 2]
        reach = extents[n, 3]
        left = math.ceil(u - half)
        right = min(math.floor(u + half), left + width - 1)
        for i in range(max(math.ceil(v - reach), 0), min(math.floor(v + reach) + 1, len(depth))):
            cosine = rows[first_row + i, 0]
            sine = rows[first_row + i, 1]
            for at in range(left, right + 1):
                j = at + width if at < 0 else at - width if at >= width else at
                q, t = hit(surfel, cosine * columns[j, 0], cosine * columns[j, 1], sine, px_angle2)
                if q >= F1:
                    continue
                if len(sums) == 0:
                    depth[i, j] = min(depth[i, j], t)
                elif t <= depth[i, j] * SURFACE_BAND + BAND_OFFSET:
                    weight = (F1 - q) * (F1 - q) * (F1 - q) + LEAST_RIM_WEIGHT
                    s = sums[i, j]
                    s[0] += weight * channel(c, 0)
                    s[1] += weight * channel(c, 8)
                    s[2] += weight * channel(c, 16)
                    s[3] += weight * t
                    s[4] += weight


def axes_of_pixels(width: int) -> tuple[Array32, Array32]:
    """Return cosine and sine of each column's azimuth (width, 2) and each row's elevation (width / 2, 2)."""
    columns = compute_rays(np.arange(width) + 0.5, width / 4.0, width)[:, :2]
    rows = compute_rays(width / 2.0, np.arange(width // 2) + 0.5, width)[:, ::2]
    return columns.astype(np.float32), rows.astype(np.float32)


def render_points(points: PackedPoints, pose: Pose, width: int, workers: Workers) -> View:
    """Render the cloud as surfels at a pose, a sphere of (width / 2, width) pixels; colours are uint8."""
    visible = points.take(visible_indices(points, pose.center_world)).subsample(MAX_SURFELS)
    return render_surfels(make_surfels(visible, workers), pose, width, workers)


def visible_indices(points: PackedPoints, center_world: Array) -> Int64s:
    """Return the indices of the points that no surface hides, seen from a centre (3,) [m].

    In `visible_points` the nearest point of a cell hides all that is behind it in the cell: a picture would
    lack a rim of two degrees around each object. Here a point is hidden only if it is behind the nearest
    points of all nine cells around it, for cells of one of two sizes.
    """
    kept = np.arange(len(points))
    for width in HIDING_WIDTHS:
        depth = nearest_depth(points, Pose(np.eye(3), center_world), width)
        around = np.pad(depth, ((1, 1), (1, 1)), mode="wrap")
        around[[0, -1]] = -np.inf  # no row beyond a pole
        farthest = cv2.dilate(around, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
        indices = indices_in_front(points, center_world, np.ascontiguousarray(farthest))
        points = points.take(indices)
        kept = kept[indices]
    return kept


def render_surfels(surfels: Surfels, pose: Pose, width: int, workers: Workers) -> View:
    """Render surfels at a pose, a sphere of (width / 2, width) pixels; colours are uint8."""
    packed, extents = pack_discs(surfels, pose, width)
    columns, rows = axes_of_pixels(width)
    rgb = np.zeros((width // 2, width, 3), np.uint8)
    depth = np.full((width // 2, width), np.inf, np.float32)
    num_rows = max(1, PIXELS_AT_ONCE // width)

    def run(first: int) -> None:
        part = slice(first, first + num_rows)
        sums = np.zeros((*depth[part].shape, 5), np.float32)
        for drawn in (sums[:0], sums):
            splat(packed, surfels.points.rgbx, extents, columns, rows, first, depth[part], drawn)
        is_seen = sums[..., 4] > 0.0
        means = sums[..., :4] / np.where(is_seen, sums[..., 4], np.float32(1.0))[..., None]
        rgb[part] = np.rint(means[..., :3])
        depth[part] = np.where(is_seen, means[..., 3], np.float32(np.inf))

    list(workers.map(run, range(0, width // 2, num_rows), "draw"))
    return View(depth, rgb)


def pack_discs(surfels: Surfels, pose: Pose, width: int) -> tuple[Array32, Array32]:
    """Return surfels at a pose (N, 9) and their extents (N, 4) as `splat` reads them."""
    p = surfels.points
    largest = MAX_RADIUS * float(np.percentile(surfels.radii, 95.0)) if len(p) else 0.0
    packed = np.empty((len(p), 9), np.float32)
    extents = np.empty((len(p), 4), np.float32)
    R = pose.R_cam_from_world
    c = pose.center_world
    place_discs((p.x, p.y, p.z), surfels.normals, surfels.radii, R, c, largest, width, packed, extents)
    return packed, extents


@kernel
def place_discs(
    points: Coordinates,
    normals: Array32,
    radii: Array32,
    R_cam_from_world: Array,
    center_world: Array,
    largest: float,
    width: int,
    surfels: Array32,
    extents: Array32,
) -> None:
    """Write surfels (N, 9) in the camera's frame, and their extents (N, 4) in the picture.

    The nine numbers are those of `Disc`. An extent is column and row of the centre, and how far the disc
    reaches from there across columns and across rows [px]. The extent of a surfel that is too near, or larger
    than `largest` [m] and not far away, is NOWHERE.
    """
    R = R_cam_from_world
    step = math.tau / width
    least = float(MIN_RADIUS_PX) * step
    for n in range(len(radii)):
        dx = points[0][n] - center_world[0]
        dy = points[1][n] - center_world[1]
        dz = points[2][n] - center_world[2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        if distance <= MIN_RANGE or radii[n] > max(largest, FAR_ANGLE * distance):
            extents[n] = NOWHERE
            continue
        nx, ny, nz = normals[n]
        facing = (nx * dx + ny * dy + nz * dz) / distance
        sign = -1.0 if facing < 0.0 else 1.0
        # without a plane the normal is 0, and becomes the ray
        turn = max(MIN_COSINE - abs(facing), 0.0) / (1.0 - MIN_COSINE) / distance
        nx = sign * nx + turn * dx
        ny = sign * ny + turn * dy
        nz = sign * nz + turn * dz
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        disc = surfels[n]
        for k in range(3):
            disc[k] = R[k, 0] * dx + R[k, 1] * dy + R[k, 2] * dz
            disc[3 + k] = (R[k, 0] * nx + R[k, 1] * ny + R[k, 2] * nz) / length
        radius = min(max(radii[n], 1e-9), MAX_SURFEL_ANGLE * distance)
        disc[6] = (nx * dx + ny * dy + nz * dz) / length
        disc[7] = 1.0 / (radius * radius)
        disc[8] = distance
        level = math.hypot(disc[0], disc[1])
        angle = max(math.asin(radius / distance), least)
        sine = math.sin(angle) * distance  # divided by `level`, the sine of a cap's half width in azimuth
        extents[n, 0], extents[n, 1] = direction_to_pixel(disc[0], disc[1], disc[2], level, width)
        extents[n, 2] = (math.asin(sine / level) if sine < level else math.pi) / step
        extents[n, 3] = angle / step
