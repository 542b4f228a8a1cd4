"""Align localized photos with each other, so that they show the same colours on the surfaces of a scan.

The sum over points, and over the pairs of photos that see them, of a robust loss of the difference of their
colours is minimised, with a charge for each pose's distance from where it was found before. All poses are
optimised jointly, because overlapping photos are coupled. After Zhou and Koltun, "Color Map Optimization for
3D Reconstruction with Consumer Depth Cameras" (SIGGRAPH 2014), who move one photo at a time. First, the
colours of each photo are multiplied by gains that make the exposures alike. A photo sees the nearest
surfaces, best where it looks at them squarely from near.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from ...cloud.octree import Octree
from ...geometry.gauss_newton import Equations, minimize
from ...geometry.pose import Pose, step, step_between
from ...geometry.robust import geman_mcclure, inline_geman_mcclure
from ...geometry.sphere import direction_to_pixel, pixel_jacobian, pixel_rays
from ...photo.panorama import Panorama, texels
from ...photo.panorama.panorama import resize
from ...system.arrays import Array, Array32, Int32s, Int64s
from ...system.jobs.threads import Workers
from ...system.kernels.jit import F0, Scalar, kernel, whole
from ...views.view_image import render_gray

ALIGNMENT_WIDTHS = 512, 1024, 2048  # [px] of the photos, from one round to the next
POINTS_PER_PHOTO = 5000
LEAST_ALIGNED_POINTS = 40_000
MOST_SEEN = 6  # photos that count for a point: those that see it best
PHOTOS_AT_ONCE = 16  # photos whose weights for all points are held
LOSS_SCALE = 20.0  # [8-bit levels] of the length of a colour difference
NOISE = 10.0  # [8-bit levels] of the length of a colour difference
NUM_ALIKE = 30.0  # points that count as one, as their errors are alike; if less, points outweigh the anchors
NUM_ALIGNMENT_STEPS = 15  # a round, at most
ALIGNMENT_SETTLED = 1e-4  # [rad, m] the largest part of a step after which a round ends
DARKEST = 8.0  # [8-bit levels] gains are not estimated from darker colours, nor from the brightest
BRIGHTEST_LEVEL = 247.0
SCALE = 0.2  # of a ratio's logarithm: a larger one counts little, as the photos show different things
NUM_ALIGNMENT_ROUNDS = 4
SIGHT_WIDTH = 1024  # [px] of the sphere on which ranges are found
HIDDEN_BEYOND = np.float32(1.02)  # a point is hidden beyond the surface's range times this
BEHIND_OFFSET = np.float32(0.03)  # [m] plus this distance
NEIGHBOR = 2  # [px] from a pixel to those by which its surface's slope is found
LEAST_COSINE = 0.02
LEAST_COUNTED_RANGE = 0.3  # [m] nearer surfaces count as much as this


class Anchor(NamedTuple):
    """The pose at which a photo was found, and how exact it is."""

    pose: Pose  # in the map
    information: Array  # (6, 6) of a step [rad, m] in the camera's frame


class Sight(NamedTuple):
    """The surfaces around a photo."""

    ranges: Array32  # (H, W) [m], 0 where nothing is seen
    weights: Array32  # (H, W) cosine of the angle to the surface's normal / range^2 [1 / m^2]


def look(octree: Octree, pose: Pose) -> Sight:
    """Return the surfaces that a photo at a pose in the map sees."""
    ranges = render_gray(octree, pose, np.ones((SIGHT_WIDTH // 2, SIGHT_WIDTH), np.bool_)).ranges
    rays = pixel_rays(SIGHT_WIDTH)
    smooth = np.asarray(cv2.medianBlur(ranges, 3), np.float64)
    points = np.pad(rays * smooth[..., None], ((NEIGHBOR, NEIGHBOR), (0, 0), (0, 0)), mode="edge")
    across = np.roll(points, -NEIGHBOR, axis=1) - np.roll(points, NEIGHBOR, axis=1)
    normals = np.cross(across[NEIGHBOR:-NEIGHBOR], points[2 * NEIGHBOR :] - points[: -2 * NEIGHBOR])
    along = np.abs((normals * rays).sum(axis=-1))
    cosine = along / np.maximum(np.linalg.norm(normals, axis=-1), 1e-12)
    weights = np.maximum(cosine, LEAST_COSINE) / np.maximum(ranges, LEAST_COUNTED_RANGE) ** 2
    return Sight(ranges, np.where(ranges > 0.0, weights, 0.0).astype(np.float32))


@kernel
def weigh_points(
    points: Array32, sight: Sight, R_cam_from_map: Array, center_map: Array, found: Array32
) -> None:
    """Write how well a photo sees each of some points (N, 3) of the map, 0 for what is hidden."""
    pose = texels.pose_float32(R_cam_from_map, center_map)
    height, width = sight.ranges.shape
    for n in range(len(points)):
        x, y, z = texels.in_camera(points[n, 0], points[n, 1], points[n, 2], pose)
        rho2 = x * x + y * y
        u, v = direction_to_pixel(x, y, z, np.sqrt(rho2), np.float32(width))
        i = min(whole(v), height - 1)
        j = min(whole(u), width - 1)
        is_seen = np.sqrt(rho2 + z * z) <= sight.ranges[i, j] * HIDDEN_BEYOND + BEHIND_OFFSET
        found[n] = sight.weights[i, j] if is_seen else F0


class Sightings(NamedTuple):
    """Which photos see which points: those of point n are first[n] to first[n + 1], in order of photos."""

    first: Int64s  # (N + 1,)
    point: Int64s  # (S,)
    photo: Int64s  # (S,)
    own: list[Int64s]  # indices of the sightings of each photo


class Readings(NamedTuple):
    """The colours that photos show at points, for each sighting."""

    values: Array32  # (S, 3) colours times gains [8-bit levels], NaN where the photo is masked
    rows: Array32  # (S, 3, 6) their derivatives by a step of the pose


def align(
    octree: Octree, panoramas: Sequence[Panorama], poses: list[Pose], anchors: list[Anchor], workers: Workers
) -> tuple[list[Pose], Array32]:
    """Move the poses of photos in a map until the photos agree on its surfaces, near their anchors.

    Return also the gains (photos, 3) by which colours are multiplied, so that exposures agree.
    """
    leaves = octree.level(octree.leaf_size)
    num_points = max(LEAST_ALIGNED_POINTS, POINTS_PER_PHOTO * len(poses))
    points = np.ascontiguousarray(leaves[:: -(-len(leaves) // num_points), :3])
    gains = np.ones((len(poses), 3), np.float32)
    for width in ALIGNMENT_WIDTHS:
        sized = [resize(panorama, width) for panorama in panoramas]
        images = [texels.pack_texels(panorama.rgb, panorama.is_valid) for panorama in sized]
        sightings = find_sightings(octree, points, poses, workers)
        read = partial(read_all, points, sightings, images, workers)
        values = read(poses, np.ones_like(gains)).values
        gains = balance(sightings.point, sightings.photo, values, len(poses))
        poses = agree_on_poses(partial(read, gains=gains), sightings, poses, anchors)
    return poses, gains


def find_sightings(octree: Octree, points: Array32, poses: Sequence[Pose], workers: Workers) -> Sightings:
    """Find which photos see points (N, 3); points that fewer than two photos see are left out."""

    def weigh(pose: Pose) -> Array32:
        found = np.empty(len(points), np.float32)
        weigh_points(points, look(octree, pose), pose.R_cam_from_world, pose.center_world, found)
        return found

    parts = (poses[begin : begin + PHOTOS_AT_ONCE] for begin in range(0, len(poses), PHOTOS_AT_ONCE))
    weights = (found for part in parts for found in workers.map(weigh, part, "see"))
    return keep_best(weights, len(points), len(poses))


def keep_best(weights: Iterable[Array32], num_points: int, num_photos: int) -> Sightings:
    """Keep the photos that see each point best, by weights (N,) of each photo, 0 for points not seen."""
    best = np.zeros((num_points, MOST_SEEN), np.float32)
    photos = np.full(best.shape, num_photos)
    for k, found in enumerate(weights):
        least = np.arange(num_points), best.argmin(axis=1)
        is_better = found > best[least]
        photos[least] = np.where(is_better, k, photos[least])
        best[least] = np.where(is_better, found, best[least])
    photos.sort(axis=1)
    is_seen = photos < num_photos
    is_seen &= is_seen.sum(axis=1, keepdims=True) > 1
    point = np.nonzero(is_seen)[0]
    photo = photos[is_seen]
    counts = np.bincount(photo, minlength=num_photos)
    own = np.split(np.argsort(photo, kind="stable"), np.cumsum(counts)[:-1])
    return Sightings(np.searchsorted(point, np.arange(num_points + 1)), point, photo, own)


def read_all(
    points: Array32,
    sightings: Sightings,
    images: Sequence[texels.Texels],
    workers: Workers,
    poses: Sequence[Pose],
    gains: Array32,
) -> Readings:
    """Read what the photos show at all points that they see."""
    count = len(sightings.point)
    readings = Readings(np.empty((count, 3), np.float32), np.empty((count, 3, 6), np.float32))

    def read(k: int) -> None:
        pose = poses[k]
        image = images[k]
        read_photo(
            points, sightings.own[k], sightings.point, image.rgbx, image.width, gains[k],
            pose.R_cam_from_world, pose.center_world, *readings,
        )  # fmt: skip

    workers.map(read, range(len(poses)), "read")
    return readings


def agree_on_poses(
    read: Callable[[Sequence[Pose]], Readings], sightings: Sightings, poses: list[Pose], anchors: list[Anchor]
) -> list[Pose]:
    """Return the poses at which photos agree best, near their anchors."""
    count = 6 * len(poses)
    information = np.zeros((count, count))
    for k, anchor in enumerate(anchors):
        information[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = anchor.information

    def equations(at: list[Pose]) -> Equations:
        matrix = np.zeros((count, count))
        gradient = np.zeros(count)
        loss = add_pairs(sightings.first, sightings.photo, *read(at), LOSS_SCALE, matrix, gradient)
        variance = NUM_ALIKE * NOISE**2
        found = Equations(loss / variance, gradient / variance, matrix / variance)
        away = [step_between(anchor.pose, pose) for pose, anchor in zip(at, anchors, strict=True)]
        return found.add_known(np.concatenate(away), information)

    def move(at: list[Pose], delta: Array) -> list[Pose]:
        return [step(pose, delta[6 * k : 6 * k + 6]) for k, pose in enumerate(at)]

    return minimize(equations, move, poses, NUM_ALIGNMENT_STEPS, ALIGNMENT_SETTLED)[0]


@kernel
def read_photo(
    points: Array32,
    own: Int64s,
    point: Int64s,
    image: Int32s,
    width: int,
    gains: Array32,
    R_cam_from_map: Array,
    center_map: Array,
    values: Array32,
    rows: Array32,
) -> None:
    """Write the values (S, 3) and rows (S, 3, 6) of one photo's own sightings."""
    pose = texels.pose_float32(R_cam_from_map, center_map)
    for s in own:
        n = point[s]
        x, y, z = texels.in_camera(points[n, 0], points[n, 1], points[n, 2], pose)
        rho2 = x * x + y * y
        k, fu, fv = texels.locate_texel(x, y, z, np.sqrt(rho2), width)
        below = k + width + 2
        t00, t10, t01, t11 = image[k], image[k + 1], image[below], image[below + 1]
        ux, uy, vx, vy, vz = pixel_jacobian(x, y, z, rho2, np.float32(width))
        is_shown = texels.is_valid(t00, t10, t01, t11) > F0
        for c in range(3):
            value, by_u, by_v = texels.blend_with_gradient(t00, t10, t01, t11, fu, fv, 8 * c)
            values[s, c] = value * gains[c] if is_shown else np.float32(np.nan)
            gx = gains[c] * (by_u * ux + by_v * vx)
            gy = gains[c] * (by_u * uy + by_v * vy)
            gz = gains[c] * (by_v * vz)
            rows[s, c, 0] = y * gz - z * gy
            rows[s, c, 1] = z * gx - x * gz
            rows[s, c, 2] = x * gy - y * gx
            rows[s, c, 3] = -gx
            rows[s, c, 4] = -gy
            rows[s, c, 5] = -gz


@kernel
def add_pairs(
    first: Int64s, photo: Int64s, values: Array32, rows: Array32, scale: float, matrix: Array, gradient: Array
) -> float:
    """Add the normal equations (6 K, 6 K), (6 K,) of the pairs of sightings of each point; return the loss.

    Each pair of a point that n photos see counts 1 / n, so that its pairs weigh as much as n - 1 colours.
    """
    total = 0.0
    per_scale2 = np.float32(1.0 / (scale * scale))
    for n in range(len(first) - 1):
        begin, end = first[n], first[n + 1]
        for a in range(begin, end):
            for b in range(begin, a):
                square = F0
                for c in range(3):
                    square += (values[a, c] - values[b, c]) ** 2
                if not square >= F0:  # NaN: masked
                    continue
                loss, weight = inline_geman_mcclure(square, per_scale2)
                weight /= end - begin
                total += loss / (end - begin)
                i, j = 6 * photo[a], 6 * photo[b]
                for c in range(3):
                    add_pair(
                        rows[a, c], rows[b, c], values[a, c] - values[b, c], weight, i, j, matrix, gradient
                    )
    return total


@kernel
def add_pair(
    row: Array32,
    other: Array32,
    error: Scalar,
    weight: Scalar,
    i: int,
    j: int,
    matrix: Array,
    gradient: Array,
) -> None:
    """Add the equations of one difference, with the derivatives (6,) `row` for photo i and -`other` for j."""
    for p in range(6):
        gradient[i + p] += weight * error * row[p]
        gradient[j + p] -= weight * error * other[p]
        for q in range(6):
            cross = weight * row[p] * other[q]
            matrix[i + p, i + q] += weight * row[p] * row[q]
            matrix[j + p, j + q] += weight * other[p] * other[q]
            matrix[i + p, j + q] -= cross
            matrix[j + q, i + p] -= cross


def balance(point: Int64s, photo: Int64s, values: Array32, num_photos: int) -> Array32:
    """Return the gains (photos, 3) by which the colours of photos are multiplied to be alike.

    `values` (S, 3) are the colours that `photo` (S,) shows at `point` (S,), sorted by points. The logarithms
    of the gains are found by robust least squares on the logarithms of ratios of colours; their mean is 0.
    """
    is_plain = np.asarray(np.all((values > DARKEST) & (values < BRIGHTEST_LEVEL), axis=1))  # not NaN either
    logs = np.log(np.where(is_plain[:, None], values, 1.0).astype(np.float64))
    pairs = [np.empty((0, 2), np.int64)]
    for apart in range(1, num_photos):
        a = np.arange(len(point) - apart)
        a = a[point[a] == point[a + apart]]
        if not len(a):
            break
        pairs.append(np.stack([a, a + apart], axis=1)[is_plain[a] & is_plain[a + apart]])
    a, b = np.concatenate(pairs).T
    i = photo[a]
    j = photo[b]
    ratios = logs[b] - logs[a]
    gains = np.zeros((num_photos, 3))
    for _ in range(NUM_ALIGNMENT_ROUNDS):
        errors = ratios - (gains[i] - gains[j])
        _, weights = geman_mcclure((errors**2).sum(axis=1), SCALE**-2)
        gains = solve(i, j, ratios * weights[:, None], weights, num_photos)
    return np.exp(gains).astype(np.float32)


def solve(i: Int64s, j: Int64s, loads: Array, weights: Array, count: int) -> Array:
    """Return x (count, 3) of least squares weights (P,) on x[i] - x[j] = loads / weights (P, 3), mean 0."""
    cross = np.bincount(i * count + j, weights, count * count).reshape(count, count)
    cross = cross + cross.T
    matrix = np.diag(cross.sum(axis=1) + 1.0) - cross  # one observation that a photo is like others
    right = [np.bincount(i, load, count) - np.bincount(j, load, count) for load in loads.T]
    found = np.linalg.solve(matrix, np.stack(right, axis=1))
    return np.asarray(found - found.mean(axis=0))
