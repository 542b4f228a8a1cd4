"""What tells the upper from the lower side of sheets: holes under scanners, tops, roofs; and steps.

A scanner sees nothing right below it: all around the hole the ground is there, and above it there is room for
a tripod. Things stand on floors, and hide them, more than they hang from ceilings.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from ..geometry.pose import Array
from .planes import PointNormals, dot

# Lengths of people, tripods and buildings, by hand
CELL = 0.2  # of the grids over a sheet [m]
SHEET = 0.12  # half of a sheet's thickness [m]
MIN_DENSITY = 12.0  # points a m2 of a sheet in which a hole is no accident
HOLE_RADIUS = (0.6, 1.3)  # of what a scanner 1.2 to 2 m high doesn't see [m]
RIM = 0.4  # width of the ring around a hole [m]
NUM_SECTORS, MIN_SECTORS = 12, 11  # of the ring, in which the sheet is there
MAX_HOLES = 30  # looked at in a sheet
HEADROOM = (0.25, 1.7)  # above a hole, empty where a tripod stood [m]
AROUND = 2.0  # beyond a hole's rim, where there are things on the side that was scanned [m]
MAX_CELLS = 4_000_000  # of a grid; in larger scans no holes are looked for
LEVEL_ANGLE = np.radians(8.0)  # of a normal to up: floors, tops
STEP = (0.15, 0.20)  # rise of stairs [m]
STEP_BIN, STEP_WINDOW = 0.02, 15  # of the histogram of heights [m]; bins of its running mean
STEEPNESS = np.radians((20.0, 60.0))  # of a normal to up: flights of stairs, roofs
NUM_SIDES = 3000  # points of which is looked at both sides
SIDE_REACH, SIDE_SKIN = 0.4, 0.08  # of these [m]
NUM_SIDE_NEIGHBORS = 48
NUM_BEYOND, BEYOND_SKIN = 800, 0.3  # points of the cloud that are before or behind a surface; how far [m]
COUNT_SOFTENING, SIDE_SOFTENING = 0.5, 0.01  # holes; fraction of the points


class Sides(NamedTuple):
    """Flat points with what is on either side of their tangent planes: -1 all behind, 1 all before it."""

    points: Array  # (S, 3) [m]
    normals: Array  # (S, 3) unit, of either sign
    near: Array  # (S,) [-1, 1] of the points within SIDE_REACH
    all: Array  # (S,) [-1, 1] of the whole cloud


def sides_of(cloud: PointNormals) -> Sides:
    """On which side of a sample of the flat points other surfaces are."""
    flat = np.flatnonzero(cloud.is_flat)
    flat = flat[:: 1 + len(flat) // NUM_SIDES]
    points, normals = cloud.points[flat], cloud.normals[flat]
    neighbors = cKDTree(cloud.points).query(points, NUM_SIDE_NEIGHBORS, distance_upper_bound=SIDE_REACH)[1]
    padded = np.vstack([cloud.points, np.full(3, np.nan)])  # where there are fewer neighbours
    near = np.einsum("sni,si->sn", padded[neighbors] - points[:, None], normals)
    some = cloud.points[:: 1 + len(cloud.points) // NUM_BEYOND]
    beyond = np.einsum("ni,si->sn", some, normals) - np.einsum("si,si->s", points, normals)[:, None]
    return Sides(points, normals, _balance(near, SIDE_SKIN, 4.0), _balance(beyond, BEYOND_SKIN, 1.0))


def _balance(offsets: Array, skin: float, softening: float) -> Array:
    """How far (S,) offsets (S, N) off the skin are rather positive, 1, or negative, -1."""
    num_before, num_behind = (offsets > skin).sum(axis=1), (offsets < -skin).sum(axis=1)
    return np.asarray((num_before - num_behind) / (num_before + num_behind + softening))


class SheetFeatures(NamedTuple):
    """Logarithms of ratios, above 0 where they speak for the sense; and the steps, for the axis."""

    hole_log_ratio: float  # of round holes that have headroom above to those that have it below
    top_log_ratio: float  # of small level surfaces with things below, tops, to those with things above
    roof_log_ratio: float  # of slanted surfaces with the cloud below to those with the cloud above
    steps: float  # [0, 1] how far heights repeat at the rise of stairs


def sheet_features(
    cloud: PointNormals, sides: Sides, axis: Array, is_level: NDArray[np.bool_], levels: Array
) -> SheetFeatures:
    """Features of a cloud along `axis` (3,), whose levels (L,) [m] ascend; some of its points are level."""
    cosines = dot(sides.normals, axis)
    upwards = np.sign(cosines)
    distances = np.abs(dot(sides.points, axis)[:, None] - levels).min(axis=1, initial=np.inf)
    is_small = (np.abs(cosines) > np.cos(LEVEL_ANGLE)) & (distances > SHEET)
    is_slanted = (np.abs(cosines) < np.cos(STEEPNESS[0])) & (np.abs(cosines) > np.cos(STEEPNESS[1]))
    heights = dot(cloud.points, axis)
    return SheetFeatures(
        hole_log_ratio=_hole_log_ratio(cloud.points, heights, axis, is_level, levels),
        top_log_ratio=_log_ratio_below(upwards * sides.near, is_small),
        roof_log_ratio=_log_ratio_below(upwards * sides.all, is_slanted),
        steps=_steps(heights),
    )


def _log_ratio_below(things_above: Array, mask: NDArray[np.bool_]) -> float:
    """Logarithm of how many surfaces have things below to how many have them above, among all (S,)."""
    above, below = (float((sign * things_above[mask]).clip(0.0).sum()) for sign in (1.0, -1.0))
    softening = SIDE_SOFTENING * max(len(mask), 1)
    return float(np.log((below + softening) / (above + softening)))


def _hole_log_ratio(
    points: Array, heights: Array, axis: Array, is_level: NDArray[np.bool_], levels: Array
) -> float:
    """Logarithm of the number of holes in the levels with headroom above to that with headroom below."""
    places = points @ np.linalg.svd(axis[None])[2][1:].T
    low, high = np.quantile(places, [0.001, 0.999], axis=0)
    cells = np.floor((places - low) / CELL).astype(np.int64)
    shape = np.floor((high - low) / CELL).astype(np.int64) + 1
    is_inside = np.all((cells >= 0) & (cells < shape), axis=1)
    if shape.prod() > MAX_CELLS:
        return 0.0
    counts = np.zeros(2)
    for level in levels:
        off = heights - level
        in_sheet = is_inside & is_level & (np.abs(off) < SHEET)
        sheet = _grid(cells[in_sheet], shape)
        if np.count_nonzero(in_sheet) > MIN_DENSITY * CELL**2 * sheet.sum():
            holes = _round_holes(sheet)
            for k, sign in enumerate((1.0, -1.0)):
                is_off = is_inside & (sign * off > HEADROOM[0]) & (sign * off < HEADROOM[1])
                things = _grid(cells[is_off], shape)
                counts[k] += sum(_has_headroom(things, *hole) for hole in holes)
    return float(np.log((counts[0] + COUNT_SOFTENING) / (counts[1] + COUNT_SOFTENING)))


def _grid(cells: NDArray[np.int64], shape: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which cells are among `cells` (N, 2)."""
    grid = np.zeros(shape, np.bool_)
    grid[cells[:, 0], cells[:, 1]] = True
    return grid


def _has_headroom(things: NDArray[np.bool_], i: int, j: int, radius: float) -> bool:
    """Whether nothing is at a hole itself, though there are things around: outside of a building are none."""

    def around(reach: float) -> NDArray[np.bool_]:
        k = max(int(reach), 1)
        return things[max(i - k, 0) : i + k + 1, max(j - k, 0) : j + k + 1]

    return not around(0.6 * radius).any() and bool(around(radius + AROUND / CELL).any())


def _round_holes(sheet: NDArray[np.bool_]) -> list[tuple[int, int, float]]:
    """Middles (cell, cell) and radii [cells] of the round holes of a sheet that surrounds them."""
    distances = distance_transform_edt(~np.pad(sheet, 1))[1:-1, 1:-1]
    holes: list[tuple[int, int, float]] = []
    low, high = HOLE_RADIUS[0] / CELL, HOLE_RADIUS[1] / CELL
    for _ in range(MAX_HOLES):
        i, j = np.unravel_index(distances.argmax(), distances.shape)
        radius = float(distances[i, j])
        if radius < low:
            break
        if radius < high and _is_ringed(sheet, int(i), int(j), radius):
            holes.append((int(i), int(j), radius))
        reach = int(radius) + 2
        distances[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1] = 0.0
    return holes


def _is_ringed(sheet: NDArray[np.bool_], i: int, j: int, radius: float) -> bool:
    """Whether the sheet is there all around a hole."""
    reach = int(radius + RIM / CELL) + 2
    a, b = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    distance = np.hypot(a, b)
    is_ring = (distance >= radius - 0.5) & (distance < radius + RIM / CELL)
    a, b = a[is_ring], b[is_ring]
    is_inside = (a + i >= 0) & (a + i < sheet.shape[0]) & (b + j >= 0) & (b + j < sheet.shape[1])
    a, b = a[is_inside], b[is_inside]
    a, b = a[sheet[a + i, b + j]], b[sheet[a + i, b + j]]
    sectors = np.floor((np.arctan2(b, a) / np.pi + 1.0) * 0.5 * NUM_SECTORS).astype(int) % NUM_SECTORS
    return len(np.unique(sectors)) >= MIN_SECTORS


def _steps(heights: Array) -> float:
    """Correlation of the heights' histogram, less its running mean, with itself a step higher."""
    low, high = np.quantile(heights, [0.01, 0.99])
    num_bins = int((high - low) / STEP_BIN)
    if not 3 * STEP_WINDOW < num_bins < 10_000:
        return 0.0
    middle, half = 0.5 * (low + high), 0.5 * num_bins * STEP_BIN  # the same upside down
    counts = np.histogram(heights, num_bins, (middle - half, middle + half))[0].astype(float)
    counts = np.minimum(counts, 4.0 * np.median(counts) + 1.0)
    counts -= np.convolve(counts, np.ones(STEP_WINDOW) / STEP_WINDOW, "same")
    energy = float(np.sum(counts**2)) + 1e-9
    lags = range(round(STEP[0] / STEP_BIN), round(STEP[1] / STEP_BIN) + 1)
    return max(float(np.sum(counts[lag:] * counts[:-lag])) / energy for lag in lags)
