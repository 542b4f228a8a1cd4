"""Normals of a cloud by PCA, its dominant planes by RANSAC, what they are, up and yaw as they agree on it."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.pose import Array

# Chosen by hand; the noise of scanners (2 to 5 mm) is far below the spacing of the points (8 cm)
MAX_POINTS = 40_000  # that get a normal: a plane of 1 % of the cloud still has 400
NUM_NEIGHBORS = 24  # with the point itself: at 8 cm a disc of radius 0.22 m
MAX_THICKNESS = 0.05  # of a flat neighbourhood: variance across it to the lesser variance along it
MIN_WIDTH = 0.1  # of a flat neighbourhood: lesser to larger variance along it; below, it is a line
Kind = Literal["floor", "ceiling", "platform", "wall", "slanted"]

SEED = 20  # of the draws
MAX_PLANES = 24
MIN_FRACTION = 0.01  # of all points, of a dominant plane
# A point and its normal are a hypothesis: one of 200 lies on a plane of 2 % of the points in 98 % of draws
NUM_HYPOTHESES = 200  # for each plane
NUM_SCORING_POINTS = 2000  # drawn, on which a hypothesis is scored: a plane of 1 % has 20 of them
TOLERANCE = 0.03  # of an inlier, from the plane: six times a scanner's noise of 5 mm [m]
INLIER_ANGLE = np.radians(15.0)  # of its normal, loose since normals near edges lean
NUM_REFITS = 4  # by least squares, until the inliers stay the same
KIND_ANGLE = np.radians(8.0)  # of a plane to level or upright: ramps up to 1 : 7 are floors
MIN_STOREY = 1.5  # of the cloud below a ceiling, lower than any room [m]
NEAR = 1.0  # height of furniture: what is so close above or below tells a floor from a ceiling [m]
AGREE_ANGLE = np.radians(3.0)  # of a plane to level or upright, that counts for up
EVEN = 0.01  # rms distance from which on a plane counts less: ground is uneven, and not level [m]
MAX_CHANGE = np.radians(1.0)  # of up by the planes
PEAK_ANGLE = np.radians(8.0)  # of a wall to those averaged with it, modulo a quarter turn; as KIND_ANGLE


class PointNormals(NamedTuple):
    """A sample of a cloud with the normals there."""

    points: Array  # (M, 3) [m]
    normals: Array  # (M, 3) unit, of either sign
    is_flat: NDArray[np.bool_]  # (M,) the neighbourhood is a plane
    neighborhood_radius: float  # median distance of the farthest neighbour [m]


def estimate_normals(points: NDArray[np.float32]) -> PointNormals:
    """Normals of an evenly strided sample of a cloud (N, 3) [m], by PCA of the nearest of all its points.

    Raises InputError if the shape is not (N, 3), or a coordinate is not finite.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who asks for up waits for it

    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: the shape is {points.shape}, must be (N, 3)")
    if not np.isfinite(points).all():
        raise InputError("points: a coordinate is not finite")
    if len(points) < NUM_NEIGHBORS:
        blank = np.zeros((len(points), 3))
        return PointNormals(points.astype(np.float64), blank, np.zeros(len(points), np.bool_), np.inf)
    stride = -(-len(points) // MAX_POINTS)
    all_points = points.astype(np.float64)
    sample = all_points[::stride]
    distances, indices = cKDTree(all_points).query(sample, NUM_NEIGHBORS)
    neighbors = all_points[indices]
    neighbors -= neighbors.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbors, neighbors))
    across, narrow, wide = variances.T
    is_flat = (across < MAX_THICKNESS * narrow) & (narrow > MIN_WIDTH * wide)
    return PointNormals(sample, axes[:, :, 0], is_flat, float(np.median(distances[:, -1])))


def dot(vectors: Array, axis: Array) -> Array:
    """Dot products (M,) of vectors (M, 3) and one axis (3,), the same for any number of threads.

    By einsum, since a BLAS may sum in an order that depends on its threads.
    """
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


class Plane(NamedTuple):
    """Points x with `normal_world @ x = offset`, and how many there are."""

    normal_world: Array  # (3,) unit; of level planes up, else away from the origin
    offset: float  # [m]
    num_inliers: int
    fraction: float  # of all points of the sample, which are spread evenly in space
    rms: float  # distance of the inliers [m]
    kind: Kind = "slanted"


def ransac_planes(cloud: PointNormals) -> list[Plane]:
    """The dominant planes, the largest first: RANSAC on flat points, least squares on all inliers."""
    rng = np.random.default_rng(SEED)
    is_left = cloud.is_flat.copy()
    least = MIN_FRACTION * len(is_left)
    planes: list[Plane] = []
    while len(planes) < MAX_PLANES and np.count_nonzero(is_left) > max(least, 3):
        left = np.flatnonzero(is_left)
        found = _fit(cloud, left, *_best_hypothesis(cloud, left, rng))
        if found is None:
            break
        plane, inliers = found
        is_left[inliers] = False
        if plane.num_inliers < least:
            break
        planes.append(plane)
    return sorted(planes, key=lambda plane: -plane.num_inliers)


def _best_hypothesis(
    cloud: PointNormals, left: NDArray[np.int64], rng: np.random.Generator
) -> tuple[Array, float]:
    """Normal and offset of the hypothesis with the most inliers among the points drawn."""
    drawn, scoring = rng.choice(left, NUM_HYPOTHESES), rng.choice(left, NUM_SCORING_POINTS)
    normals = cloud.normals[drawn]
    offsets = np.einsum("hi,hi->h", normals, cloud.points[drawn])
    distances = np.einsum("hi,ji->hj", normals, cloud.points[scoring]) - offsets[:, None]
    cosines = np.einsum("hi,ji->hj", normals, cloud.normals[scoring])
    is_inlier = (np.abs(distances) < TOLERANCE) & (np.abs(cosines) > np.cos(INLIER_ANGLE))
    best = int(is_inlier.sum(axis=1).argmax())
    return normals[best], float(offsets[best])


def _fit(
    cloud: PointNormals, left: NDArray[np.int64], normal: Array, offset: float
) -> tuple[Plane, NDArray[np.int64]] | None:
    """The plane by least squares on its inliers among the points `left`, and their indices."""
    points, normals = cloud.points[left], cloud.normals[left]
    for _ in range(NUM_REFITS):
        is_near = np.abs(dot(points, normal) - offset) < TOLERANCE
        is_inlier = is_near & (np.abs(dot(normals, normal)) > np.cos(INLIER_ANGLE))
        inliers = points[is_inlier]
        if len(inliers) < 3:
            return None
        mean = inliers.mean(axis=0)
        variances, axes = np.linalg.eigh(np.einsum("ni,nj->ij", inliers - mean, inliers - mean))
        normal, offset = axes[:, 0], float(axes[:, 0] @ mean)
    sign = -1.0 if offset < 0.0 else 1.0
    rms = float(np.sqrt(max(variances[0], 0.0) / len(inliers)))
    plane = Plane(sign * normal, sign * offset, len(inliers), len(inliers) / len(cloud.points), rms)
    return plane, left[is_inlier]


def refine_up(up: Array, planes: list[Plane]) -> tuple[Array, float | None]:
    """Up (3,) by least squares on the level and upright planes, and their rms angle to it [rad].

    Even planes, which are built, count more than uneven ones. Without a level plane, or if it would change by
    more than a degree, up stays as it is. The angle is None where fewer than two planes count.
    """
    sines = np.array([plane.normal_world @ up for plane in planes])
    is_level, is_upright = np.abs(sines) > np.cos(AGREE_ANGLE), np.abs(sines) < np.sin(AGREE_ANGLE)
    weights = np.array([plane.fraction / (1.0 + (plane.rms / EVEN) ** 2) for plane in planes])
    if not is_level.any():
        return up, None
    normals = np.array([plane.normal_world for plane in planes])
    signs = is_upright.astype(float) - is_level
    refined = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights * signs, normals, normals))[1][:, 0]
    refined = refined * np.sign(refined @ up)
    if np.linalg.norm(refined - up) > MAX_CHANGE:
        refined = up
    counts = is_level | is_upright
    if np.count_nonzero(counts) < 2:
        return refined, None
    sines = np.minimum(np.abs(dot(normals, refined)), 1.0)
    angles = np.where(is_level, np.arccos(sines), np.arcsin(sines))
    return refined, float(np.sqrt(np.average(angles[counts] ** 2, weights=weights[counts])))


def classify_planes(planes: list[Plane], cloud: PointNormals, up: Array) -> list[Plane]:
    """The planes, the largest first, with their kinds.

    A ceiling has more things within a metre below it than above it. What is level and less than a storey from
    a floor or ceiling twice as large is a table or a stage: `platform`.
    """
    classified: list[Plane] = []
    storeys: list[tuple[float, Plane]] = []  # floors and ceilings with their heights
    heights = dot(cloud.points, up)
    is_upright = np.abs(dot(cloud.normals, up)) < np.sin(KIND_ANGLE)
    things = np.sort(heights[~cloud.is_flat | is_upright])
    lowest = float(np.quantile(heights, 0.01))
    for plane in planes:
        sine = float(plane.normal_world @ up)
        if abs(sine) < np.cos(KIND_ANGLE):
            classified.append(plane._replace(kind="wall" if abs(sine) < np.sin(KIND_ANGLE) else "slanted"))
            continue
        distances = dot(cloud.points, plane.normal_world) - plane.offset
        height, sign = float(np.median(heights[np.abs(distances) < TOLERANCE])), float(np.sign(sine))
        ends = np.searchsorted(things, height + np.array([-NEAR, -2.0 * TOLERANCE, 2.0 * TOLERANCE, NEAR]))
        is_more_below = ends[1] - ends[0] > ends[3] - ends[2]
        kind: Kind = "ceiling" if height - lowest > MIN_STOREY and is_more_below else "floor"
        near = (other for level, other in storeys if abs(level - height) < MIN_STOREY)
        if any(other.num_inliers > 2 * plane.num_inliers for other in near):
            kind = "platform"
        normal_world, offset = sign * plane.normal_world, sign * plane.offset
        classified.append(plane._replace(normal_world=normal_world, offset=offset, kind=kind))
        if kind != "platform":
            storeys.append((height, classified[-1]))
    return classified


def manhattan_yaw(planes: list[Plane], R_level_from_scan: Array) -> float | None:
    """The smallest turn about z [rad], in (-45, 45] deg, that puts the dominant walls along x and y.

    None without walls. Walls a quarter turn apart count as one direction, the larger ones for more.
    """
    walls = [plane for plane in planes if plane.kind == "wall"]
    if not walls:
        return None
    normals = np.array([R_level_from_scan @ wall.normal_world for wall in walls])
    weights = np.array([wall.fraction for wall in walls])
    # four times the azimuth is the same for all four directions of a rectangle
    phases = np.exp(4j * np.arctan2(normals[:, 1], normals[:, 0]))
    is_near = np.abs(np.angle(phases[:, None] / phases)) < 4.0 * PEAK_ANGLE
    peak = int((is_near * weights).sum(axis=1).argmax())
    mean = np.sum(weights[is_near[peak]] * phases[is_near[peak]])
    turn = -0.25 * float(np.angle(mean))
    return turn + 0.5 * np.pi if turn <= -0.25 * np.pi else turn
