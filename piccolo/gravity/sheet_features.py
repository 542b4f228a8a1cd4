"""What tells the upper from the lower side of sheets: holes under scanners, passages, roofs; and steps.

A scanner sees nothing right below it: all around the hole the ground is there, and above it there is room for
a tripod. People walk from room to room through doors, below beams and lamps: over a floor the free space is
in one piece, below a ceiling walls and lintels and beams divide it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from .planes import PointNormals, dot

# Lengths of people, tripods and buildings, by hand
CELL = 0.2  # of the grids over a sheet in which holes are looked for [m]
SHEET = 0.12  # half of a sheet's thickness [m]
HOLE_RADIUS = (0.6, 1.3)  # of what a scanner 1.2 to 2 m high doesn't see [m]
RIM = 0.4  # width of the ring around a hole [m]
NUM_SECTORS, MIN_SECTORS = 12, 11  # of the ring, in which the sheet is there
MAX_HOLES = 30  # looked at in a sheet
HEADROOM = (0.25, 1.7)  # above a hole, empty where a tripod stood [m]
REVEAL = (0.06, 0.4)  # behind a sheet, where windows and doors have jambs, and the ground has nothing [m]
AROUND = 2.0  # beyond a hole's rim, where there are things on the side that was scanned [m]
MAX_CELLS = 4_000_000  # of a grid; in larger scans no holes are looked for
PASSAGE_CELL = 0.25  # of the grid over a sheet on which people may walk [m]
PASSAGE = (0.3, 1.9)  # above it, free where people walk [m]
REACH = 2  # cells between the points of a sheet, or of what is above it
MIN_AREA, MIN_AREAS = 8, 100  # cells, in one piece and in all
AREA_SOFTENING = 20.0  # cells
STEP = (0.15, 0.20)  # rise of stairs [m]
STEP_BIN, STEP_WINDOW = 0.02, 15  # of the histogram of heights [m]; bins of its running mean
STEEPNESS = np.radians((20.0, 60.0))  # of a normal to up: flights of stairs, roofs
NUM_SIDES = 3000  # points of which is looked at both sides
NUM_BEYOND, BEYOND_SKIN = 800, 0.3  # points of the cloud that are before or behind a surface; how far [m]
COUNT_SOFTENING, SIDE_SOFTENING = 0.5, 0.01  # holes; fraction of the points


class Sides(NamedTuple):
    """Normals of flat points, and on which side of their tangent planes the cloud is."""

    normals: Array  # (S, 3) unit, of either sign
    balance: Array  # (S,) [-1, 1]: all of it behind, all before

    def roof_log_ratio(self, axis: Array) -> float:
        """Logarithm of how many slanted points have the cloud below to how many have it above."""
        cosines = dot(self.normals, axis)
        is_slanted = (np.abs(cosines) < np.cos(STEEPNESS[0])) & (np.abs(cosines) > np.cos(STEEPNESS[1]))
        is_above = (np.sign(cosines) * self.balance)[is_slanted]
        softening = SIDE_SOFTENING * max(len(cosines), 1)
        below, above = (float((sign * is_above).clip(0.0).sum()) + softening for sign in (-1.0, 1.0))
        return float(np.log(below / above))


def sides_of(cloud: PointNormals) -> Sides:
    """On which side of a sample of the flat points the cloud is."""
    flat = np.flatnonzero(cloud.is_flat)
    flat = flat[:: 1 + len(flat) // NUM_SIDES]
    points, normals = cloud.points[flat], cloud.normals[flat]
    some = cloud.points[:: 1 + len(cloud.points) // NUM_BEYOND]
    offsets = np.einsum("ni,si->sn", some, normals) - np.einsum("si,si->s", points, normals)[:, None]
    num_before = (offsets > BEYOND_SKIN).sum(axis=1)
    num_behind = (offsets < -BEYOND_SKIN).sum(axis=1)
    return Sides(normals, (num_before - num_behind) / (num_before + num_behind + 1.0))


class SheetFeatures(NamedTuple):
    """Logarithms of ratios, above 0 where they speak for the sense; and the steps, for the axis."""

    hole_log_ratio: float  # of round holes that have headroom above to those that have it below
    passage_log_ratio: float  # of how far free space above the levels is in one piece to that below them
    roof_log_ratio: float  # of slanted surfaces with the cloud below to those with the cloud above
    steps: float  # [0, 1] how far heights repeat at the rise of stairs


def sheet_features(
    cloud: PointNormals, sides: Sides, axis: Array, is_level: NDArray[np.bool_], levels: Array
) -> SheetFeatures:
    """Features of a cloud along `axis` (3,), whose levels (L,) [m] ascend; some of its points are level."""
    heights = dot(cloud.points, axis)
    places = cloud.points @ np.linalg.svd(axis[None])[2][1:].T
    return SheetFeatures(
        hole_log_ratio=_hole_log_ratio(_grid_over(places, CELL), heights, is_level, levels),
        passage_log_ratio=_passage_log_ratio(_grid_over(places, PASSAGE_CELL), heights, is_level, levels),
        roof_log_ratio=sides.roof_log_ratio(axis),
        steps=_steps(heights),
    )


class _Grid(NamedTuple):
    """Cells of a grid across an axis, and which of them each point is in."""

    shape: NDArray[np.int64]  # (2,)
    cells: NDArray[np.int64]  # (N,) in row order; one more cell for strays

    def occupied(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which cells have points of a mask (N,)."""
        grid = np.zeros(int(self.shape.prod()) + 1, np.bool_)
        grid[self.cells[mask]] = True
        return grid[:-1].reshape(self.shape)


def _grid_over(places: Array, cell: float) -> _Grid | None:
    """The grid over places (N, 2) [m]; None where it had too many cells."""
    low, high = np.quantile(places, [0.001, 0.999], axis=0)
    cells = np.floor((places - low) / cell).astype(np.int64)
    shape = np.floor((high - low) / cell).astype(np.int64) + 1
    if shape.prod() > MAX_CELLS:
        return None
    is_inside = np.all((cells >= 0) & (cells < shape), axis=1)
    return _Grid(shape, np.where(is_inside, cells[:, 0] * shape[1] + cells[:, 1], shape.prod()))


def _passage_log_ratio(
    grid: _Grid | None, heights: Array, is_level: NDArray[np.bool_], levels: Array
) -> float:
    """Logarithm of how far free space above the levels is in one piece to how far that below them is.

    That is the mean, over the free area of a level, of the fraction that the piece has of the level's.
    """
    from scipy.ndimage import binary_dilation, label  # noqa: PLC0415  # only who asks for up waits for it

    in_pieces, in_all = np.zeros(2), np.zeros(2)
    if grid is None:
        return 0.0
    for level in levels:
        off = heights - level
        sheet = _closed(grid.occupied(is_level & (np.abs(off) < SHEET)))
        for k, sign in enumerate((1.0, -1.0)):
            is_off = sign * off > PASSAGE[0]
            is_free = sheet & ~grid.occupied(is_off & (sign * off < PASSAGE[1]))
            pieces, _ = label(is_free & binary_dilation(grid.occupied(is_off), iterations=REACH))
            areas = np.bincount(pieces.ravel())[1:]
            areas = areas[areas > MIN_AREA]
            in_all[k] += areas.sum()
            in_pieces[k] += (areas**2).sum() / max(areas.sum(), 1)
    if in_all.min() < MIN_AREAS:
        return 0.0
    above, below = (in_pieces + AREA_SOFTENING) / (in_all + AREA_SOFTENING)
    return float(np.log(above / below))


def _closed(sheet: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A sheet without the gaps between its points."""
    from scipy.ndimage import binary_closing  # noqa: PLC0415  # only who asks for up waits for it

    closed = binary_closing(np.pad(sheet, 2 * REACH), iterations=REACH)
    return np.asarray(closed[2 * REACH : -2 * REACH, 2 * REACH : -2 * REACH])


def _hole_log_ratio(grid: _Grid | None, heights: Array, is_level: NDArray[np.bool_], levels: Array) -> float:
    """Logarithm of the number of holes in the levels with headroom above to that with headroom below."""
    counts = np.zeros(2)
    if grid is None:
        return 0.0
    for level in levels:
        off = heights - level
        sheet = grid.occupied(is_level & (np.abs(off) < SHEET))
        holes = _round_holes(sheet) if sheet.any() else []
        for k, sign in enumerate((1.0, -1.0) if holes else ()):
            things = grid.occupied((sign * off > HEADROOM[0]) & (sign * off < HEADROOM[1]))
            behind = grid.occupied((sign * off < -REVEAL[0]) & (sign * off > -REVEAL[1]))
            counts[k] += sum(_has_headroom(things, behind, *hole) for hole in holes)
    return float(np.log((counts[0] + COUNT_SOFTENING) / (counts[1] + COUNT_SOFTENING)))


def _has_headroom(
    things: NDArray[np.bool_], behind: NDArray[np.bool_], i: int, j: int, radius: float
) -> bool:
    """Whether nothing is at a hole, nor behind it, though there are things around: outside are none."""

    def has(grid: NDArray[np.bool_], reach: float) -> bool:
        k = max(int(reach), 1)
        return bool(grid[max(i - k, 0) : i + k + 1, max(j - k, 0) : j + k + 1].any())

    is_clear = not has(things, 0.6 * radius) and not has(behind, radius + 1.0)
    return is_clear and has(things, radius + AROUND / CELL)


def _round_holes(sheet: NDArray[np.bool_]) -> list[tuple[int, int, float]]:
    """Middles (cell, cell) and radii [cells] of the round holes of a sheet that surrounds them."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  # only who asks for up waits for it

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
