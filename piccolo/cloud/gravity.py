"""The vertical of a scan and the direction of its walls, by its planes; and which end of the vertical is up.

Planes are found by RANSAC. Two cues tell a floor from a ceiling. Seats, tables and shelves stand on floors,
as high as people reach; little hangs so far below ceilings. And people walk from room to room over floors,
while lintels, beams and walls divide the space below ceilings. Each cue is the logarithm of a ratio.
"""

from typing import NamedTuple

import numpy as np

from ..system.arrays import Array, Array32, Int64s, Mask
from .octree import Octree

# Chosen by hand; the noise of scanners (2 to 5 mm) is far below the spacing of the points
POINT_SPACING = 0.08  # [m] between the points that are used
MAX_NORMALS = 40_000  # points that get a normal: a plane of 1 % of the cloud still has 400
NUM_PLANE_NEIGHBORS = 24  # including the point itself: at a spacing of 8 cm a disc of radius 0.22 m
MIN_FRACTION = 0.01  # a dominant plane has at least this fraction of all points
NUM_HYPOTHESES = 200  # for each plane: one lies on a plane of 2 % of the points in 98 % of draws
PLANE_TOLERANCE = 0.03  # [m] from a plane to its inliers: six times a scanner's noise of 5 mm
INLIER_ANGLE = np.radians(15.0)  # between their normals and the plane's; large, as normals near edges lean
MAX_LEAN = np.radians(15.0)  # between the vertical and a given direction of up, at most
AGREE_ANGLE = np.radians(3.0)  # a plane this near to level or upright is used to refine the vertical
MIN_ALIGNED = 0.6  # least fraction of the planes' area that is level or upright: roofs are neither
LEVEL_ANGLE = np.radians(8.0)  # between a level surface's normal and the vertical: ramps to 1 : 7 count
PERSON_HEIGHT = 1.9  # [m]
FURNITURE = 0.3, 1.2  # [m] heights of seats, tables, counters, shelves above the floor
BUILDING_GAP = 3.0  # [m] buildings with a cell so wide without points between them lie apart
LEAST_BUILDING = 0.02  # of the points, that a building has at least
WALKABLE_STEP = 0.3  # [m] people walk over lower things
WALKING_CELL = 0.25  # [m] of the grid in which free floor is found; larger in wide scans
FLOOR_REACH = 2  # cells between the points of a floor, or between free space and the next thing over a floor
ADDED_CELLS = 20.0  # added to both counts of a ratio, so that a handful of cells decides little


class PointNormals(NamedTuple):
    """A sample of a cloud's points with their normals."""

    points: Array  # (M, 3) [m]
    normals: Array  # (M, 3) unit, of either sign
    is_flat: Mask  # (M,) the points around lie in a plane


class DominantPlanes(NamedTuple):
    """Dominant planes, the largest first."""

    normals: Array  # (P, 3) unit, of either sign
    centers: Array  # (P, 3) mean of the inliers [m]
    areas: Array  # (P,) fraction of all points of the sample, which are spread evenly in space


def dot_products(vectors: Array, axis: Array) -> Array:
    """Return dot products (M,) of vectors (M, 3) and an axis (3,); those of BLAS depend on threads."""
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


def estimate_normals(points: Array32) -> PointNormals:
    """Return normals of an evenly strided sample of a cloud (N, 3) [m], by PCA of the nearest points."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # imported only when up is estimated

    sample = points[:: -(-len(points) // MAX_NORMALS)].astype(np.float64)
    nearest = list(range(1, min(NUM_PLANE_NEIGHBORS, len(points)) + 1))
    neighbors = points[cKDTree(points).query(sample, nearest)[1]].astype(np.float64)
    neighbors -= neighbors.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbors, neighbors))
    across, narrow, wide = variances.T
    is_flat = (across < 0.05 * narrow) & (narrow > 0.1 * wide)  # thin, and not a line
    return PointNormals(sample, axes[:, :, 0], is_flat)


def ransac_planes(cloud: PointNormals) -> DominantPlanes:
    """Return the dominant planes: RANSAC on flat points, least squares on all inliers."""
    rng = np.random.default_rng(20)
    left = np.flatnonzero(cloud.is_flat)
    found: list[tuple[Array, Array, float]] = []
    least = max(MIN_FRACTION * len(cloud.points), 3)
    while len(found) < 24 and len(left) > least:
        drawn = rng.choice(left, NUM_HYPOTHESES)
        scoring = rng.choice(left, 2000)  # a plane of 1 % has 20 of them
        votes = _are_inliers(cloud, scoring, cloud.normals[drawn], cloud.points[drawn]).sum(axis=1)
        normal = cloud.normals[drawn[votes.argmax()]]
        center = cloud.points[drawn[votes.argmax()]]
        for _ in range(4):  # refits, until the inliers stay the same
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
    return DominantPlanes(np.reshape(normals, (-1, 3)), np.reshape(centers, (-1, 3)), np.array(areas))


def _are_inliers(cloud: PointNormals, some: Int64s, normals: Array, points: Array) -> Mask:
    """Return the mask (H, S) of the points `some` (S,) that lie on each of H planes.

    A plane is given by its normal (H, 3) and a point on it (H, 3) [m].
    """
    offsets = np.einsum("hi,hi->h", normals, points)[:, None]
    distances = np.einsum("hi,ji->hj", normals, cloud.points[some]) - offsets
    cosines = np.einsum("hi,ji->hj", normals, cloud.normals[some])
    return np.asarray((np.abs(distances) < PLANE_TOLERANCE) & (np.abs(cosines) > np.cos(INLIER_ANGLE)))


def find_up(octree: Octree) -> tuple[Array, float, str, DominantPlanes]:
    """Return a scan's vertical (3,), the sign of up along it, a reason, and the planes.

    The vertical is the normal of the largest area of parallel planes; along it the scan must be lower than it
    is wide. The sign is 1 or -1, or 0 if up is not clear; the reason is a text.
    """
    cloud = estimate_normals(octree.level(POINT_SPACING)[:, :3])
    planes = ransac_planes(cloud)
    if not len(planes.areas):
        return np.array([0.0, 0.0, 1.0]), 0.0, "there are no dominant planes", planes
    level_areas, aligned_areas = _areas_by(planes)
    largest = int(level_areas.argmax())
    axis = _refine(planes, planes.normals[largest])
    heights = dot_products(cloud.points, axis)
    places = np.einsum("ni,ji->nj", cloud.points, np.linalg.svd(axis[None])[2][1:])
    across = places @ np.linalg.eigh(np.cov(places.T))[1][:, 0]
    height, width = (np.ptp(np.quantile(x, [0.01, 0.99])) for x in (heights, across))
    if aligned_areas[largest] < MIN_ALIGNED:
        return axis, 0.0, "too many planes are neither horizontal nor vertical", planes
    if height > 0.75 * width:
        return axis, 0.0, f"{height:.1f} m high and {width:.1f} m wide, a wall may be the floor", planes
    return axis, *find_sense(cloud, planes, axis, heights, places), planes


def level(planes: DominantPlanes, given_up: Array) -> Array:
    """Return the vertical (3,) by the planes near a given direction of up (3,), pointing up.

    Return the given direction itself if the planes have no vertical near it, or differ by less than 0.2 deg.
    """
    is_near = np.abs(dot_products(planes.normals, given_up)) > np.cos(MAX_LEAN)
    is_vertical = is_near & (_areas_by(planes)[1] > MIN_ALIGNED)
    if not is_vertical.any():
        return given_up
    axis = _refine(planes, planes.normals[is_vertical.argmax()])
    cosine = float(axis @ given_up)
    return given_up if abs(cosine) > np.cos(np.radians(0.2)) else axis * np.sign(cosine)


def _areas_by(planes: DominantPlanes) -> tuple[Array, Array]:
    """Return two fractions (P,) of the planes' area, supposing that the normal of each plane is vertical.

    They are the fraction that would be level, and the fraction that would be level or upright.
    """
    cosines = np.abs(planes.normals @ planes.normals.T)
    areas = planes.areas / planes.areas.sum()
    is_level = cosines > np.cos(LEVEL_ANGLE)
    return is_level @ areas, (is_level | (cosines < np.sin(LEVEL_ANGLE))) @ areas


def _refine(planes: DominantPlanes, axis: Array) -> Array:
    """Return the vertical (3,) near an axis, by least squares on planes nearly level or upright."""
    cosines = np.abs(dot_products(planes.normals, axis))
    signs = 1.0 * (cosines < np.sin(AGREE_ANGLE)) - (cosines > np.cos(AGREE_ANGLE))
    spread = np.einsum("n,ni,nj->ij", signs * planes.areas, planes.normals, planes.normals)
    return np.asarray(np.linalg.eigh(spread)[1][:, 0])


def wall_yaw(planes: DominantPlanes, R_level_from_scan: Array) -> float | None:
    """Return the turn about z [rad], in (-45, 45] deg, that aligns walls with x and y; None without."""
    x, y, z = R_level_from_scan @ planes.normals.T
    is_wall = np.abs(z) < np.sin(LEVEL_ANGLE)
    if not is_wall.any():
        return None
    k = (is_wall * _areas_by(planes)[1]).argmax()  # the wall to which most area is parallel or square
    turns = -np.arctan2(y[k], x[k]) / (0.5 * np.pi)
    return float(turns - np.ceil(turns - 0.5)) * 0.5 * np.pi


def find_yaw_of_walls(octree: Octree) -> float | None:
    """Return the turn of `wall_yaw` for the octree of a cloud whose z is up."""
    return wall_yaw(ransac_planes(estimate_normals(octree.level(POINT_SPACING)[:, :3])), np.eye(3))


def find_sense(
    cloud: PointNormals, planes: DominantPlanes, axis: Array, heights: Array, places: Array
) -> tuple[float, str]:
    """Return 1 if up is along a vertical (3,), -1 if against it, 0 if that is not clear; and the reason.

    `heights` (M,) [m] and `places` (M, 2) [m] are the points' heights along the vertical and their positions
    in the plan. Each building has floors at its own heights, so that each has its own cues; a building counts
    by its points.
    """
    found = []
    for is_part in list_buildings(places):
        part = PointNormals(cloud.points[is_part], cloud.normals[is_part], cloud.is_flat[is_part])
        levels = find_levels(planes if is_part.all() else ransac_planes(part), axis)
        if len(levels) >= 2:
            is_level = part.is_flat & (np.abs(dot_products(part.normals, axis)) > np.cos(LEVEL_ANGLE))
            furniture = furniture_cue(heights[is_part], is_level, levels)
            passage = passage_cue(heights[is_part], is_level, levels, places[is_part])
            found.append([furniture, passage, float(np.diff(levels).max()), float(is_part.sum())])
    if not found:
        return 0.0, "a floor and a ceiling are not both among the dominant planes"
    furniture_cues, passage_cues, highest, counts = np.array(found).T
    cues = np.average([furniture_cues, passage_cues], axis=1, weights=counts)
    sense = float(np.sign(cues.sum()))
    # least value of the smaller cue: in high storeys, whose trusses look like tables, both cues must agree
    least = 0.3 if highest.max() > 4.0 else -0.5
    is_plain = sense * cues.sum() > 1.0 and (sense * cues).min() > least
    reason = "furniture {:+.1f}, free space {:+.1f}".format(*sense * cues)
    return (sense, reason) if is_plain else (0.0, f"floor and ceiling look alike: {reason}")


def list_buildings(places: Array) -> list[Mask]:
    """Return masks (M,) of the points in each part of the plan that lies apart; of all if only one is large.

    `places` (M, 2) [m] are the points' positions in the plan.
    """
    from scipy import ndimage  # noqa: PLC0415  # imported only when up is estimated

    low, high = np.quantile(places, [0.001, 0.999], axis=0)
    cells = (np.clip(places, low, high) - low) // BUILDING_GAP
    cells = cells.astype(np.intp)
    grid = np.zeros(cells.max(axis=0) + 1, bool)
    grid[tuple(cells.T)] = True
    parts = ndimage.label(grid, np.ones((3, 3)))[0][tuple(cells.T)]
    large = np.flatnonzero(np.bincount(parts) > LEAST_BUILDING * len(places))
    return [parts == k for k in large] if len(large) > 1 else [np.ones(len(places), bool)]


def find_levels(planes: DominantPlanes, axis: Array) -> Array:
    """Return the heights (L,) [m] of floors and ceilings along a vertical (3,), lowest first.

    Levels nearer to each other than a person's height count as one, that of the largest plane.
    """
    is_level = np.abs(dot_products(planes.normals, axis)) > np.cos(LEVEL_ANGLE)
    levels: list[float] = []
    for height, area in zip(
        dot_products(planes.centers, axis)[is_level], planes.areas[is_level], strict=True
    ):
        is_large = area > 0.3 * planes.areas[is_level][0]  # tables have less
        if is_large and all(abs(height - other) > PERSON_HEIGHT for other in levels):
            levels.append(float(height))
    return np.array(sorted(levels))


def furniture_cue(heights: Array, is_level: Mask, levels: Array) -> float:
    """Return a log ratio: level points as high as furniture above levels (L,), to those as far below."""
    next_level = np.searchsorted(levels, heights[is_level])
    above = heights[is_level] - np.append(-np.inf, levels)[next_level]
    below = np.append(levels, np.inf)[next_level] - heights[is_level]
    low, high = FURNITURE
    few = 0.001 * len(heights)  # added to both counts, like ADDED_CELLS
    standing = np.count_nonzero((above > low) & (above < np.minimum(high, below)))
    hanging = np.count_nonzero((below > low) & (below < np.minimum(high, above)))
    return float(np.log((standing + few) / (hanging + few)))


def passage_cue(heights: Array, is_level: Mask, levels: Array, places: Array) -> float:
    """Return a log ratio: how connected the space free for a person is above levels, to below.

    `levels` (L,) [m] are floors and ceilings. A level's free area falls into connected pieces. How connected
    it is, is the mean over its cells of the fraction of the area that belongs to the cell's piece.
    """
    from scipy import ndimage  # noqa: PLC0415  # imported only when up is estimated

    low, high = np.quantile(places, [0.001, 0.999], axis=0)
    cell = max(WALKING_CELL, float(np.sqrt(np.prod(high - low) / 4e6)))
    edges = [np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True)]

    def grid(mask: Mask) -> Mask:
        return np.asarray(np.histogramdd(places[mask], edges)[0] > 0)

    pieces = np.full((2, 2), ADDED_CELLS)  # above, below: the sum of cells' fractions, their count
    for level in levels:
        sheet = np.pad(grid(is_level & (np.abs(heights - level) < 0.12)), FLOOR_REACH)
        sheet = ndimage.binary_closing(sheet, iterations=FLOOR_REACH)[
            FLOOR_REACH:-FLOOR_REACH, FLOOR_REACH:-FLOOR_REACH
        ]
        for k, off in enumerate((heights - level, level - heights)):
            is_free = sheet & ~grid((off > WALKABLE_STEP) & (off < PERSON_HEIGHT))
            is_free &= ndimage.binary_dilation(grid(off > WALKABLE_STEP), iterations=FLOOR_REACH)
            areas = np.bincount(ndimage.label(is_free)[0].ravel())[1:]
            areas = areas[areas > 8]  # smaller pieces do not count
            pieces[k] += (areas**2).sum() / max(areas.sum(), 1), areas.sum()
    above, below = pieces[:, 0] / pieces[:, 1]
    return float(np.log(above / below))
