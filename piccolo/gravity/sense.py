"""Which end of a scan's vertical is up, by what people do over floors and not below ceilings.

Seats, tables and shelves are above floors as high as people reach. People walk from room to room over floors,
while lintels, beams and walls divide the space below ceilings. Each cue is the logarithm of a ratio.
"""

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from .planes import Planes, PointNormals, dot

LEVEL_ANGLE = np.radians(8.0)  # of a level surface's normal to the vertical: ramps up to 1 : 7 are floors
MIN_LEVEL = 0.3  # area of a floor or ceiling to that of the largest: tables have less
HEADROOM = 1.9  # of a person [m]
FURNITURE = 0.3, 1.2  # heights of seats, tables, counters, shelves above the floor [m]
SHEET = 0.12  # half of a floor's thickness [m]
STEP = 0.3  # what is lower does not keep anybody from walking [m]
CELL = 0.25  # of the grid in which people walk [m]
MAX_CELLS = 4e6  # of a grid: of wider scans the cells are larger
REACH = 2  # cells between the points of a floor, or between free space and the next thing over a floor
MIN_PIECE = 8  # cells of free space in one piece
FEW_POINTS, FEW_CELLS = 0.001, 20.0  # added to both counts of a ratio, so that a handful says little
PLAIN = 1.0  # sum of both cues from which on they decide: a ratio of e
LEAST = -0.5  # of the lesser cue, below which they disagree
HIGH, LEAST_IN_HIGH = 4.0, 0.3  # a storey from which on [m] trusses look like tables: both cues must agree


def find_sense(cloud: PointNormals, planes: Planes, axis: Array) -> tuple[float, str]:
    """Return 1 if up is along a vertical (3,), -1 if against it, 0 if that is not plain; and why."""
    levels = find_levels(planes, axis)
    if len(levels) < 2:
        return 0.0, "a floor and a ceiling are not both among the dominant planes"
    heights = dot(cloud.points, axis)
    is_level = cloud.is_flat & (np.abs(dot(cloud.normals, axis)) > np.cos(LEVEL_ANGLE))
    places = np.einsum("ni,ji->nj", cloud.points, np.linalg.svd(axis[None])[2][1:])
    passages = passage_cue(heights, is_level, levels, places)
    cues = np.array([furniture_cue(heights, is_level, levels), passages])
    sense = float(np.sign(cues.sum()))
    least = LEAST_IN_HIGH if np.diff(levels).max() > HIGH else LEAST
    is_plain = sense * cues.sum() > PLAIN and (sense * cues).min() > least
    reason = "furniture {:+.1f}, free ways {:+.1f}".format(*sense * cues)
    return (sense, reason) if is_plain else (0.0, f"floor and ceiling look alike: {reason}")


def find_levels(planes: Planes, axis: Array) -> Array:
    """Return the heights (L,) of floors and ceilings along a vertical (3,), ascending, a person apart."""
    is_level = np.abs(dot(planes.normals, axis)) > np.cos(LEVEL_ANGLE)
    levels: list[float] = []
    for height, area in zip(dot(planes.centers, axis)[is_level], planes.areas[is_level], strict=True):
        is_large = area > MIN_LEVEL * planes.areas[is_level][0]
        if is_large and all(abs(height - other) > HEADROOM for other in levels):
            levels.append(float(height))
    return np.array(sorted(levels))


def furniture_cue(heights: Array, is_level: NDArray[np.bool_], levels: Array) -> float:
    """Compare level faces as high as furniture above levels (L,) with those as far below."""
    next_level = np.searchsorted(levels, heights[is_level])
    above = heights[is_level] - np.append(-np.inf, levels)[next_level]
    below = np.append(levels, np.inf)[next_level] - heights[is_level]
    low, high = FURNITURE
    few = FEW_POINTS * len(heights)
    standing = np.count_nonzero((above > low) & (above < np.minimum(high, below)))
    hanging = np.count_nonzero((below > low) & (below < np.minimum(high, above)))
    return float(np.log((standing + few) / (hanging + few)))


def passage_cue(heights: Array, is_level: NDArray[np.bool_], levels: Array, places: Array) -> float:
    """Compare how far space that is free for a person is in one piece above levels (L,) and below them.

    That is the mean, over the free area of a level, of the fraction that the piece has of the level's.
    """
    from scipy import ndimage  # noqa: PLC0415  # only who asks for up waits for it

    low, high = np.quantile(places, [0.001, 0.999], axis=0)
    cell = max(CELL, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
    edges = [np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True)]

    def grid(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray(np.histogramdd(places[mask], edges)[0] > 0)

    pieces = np.full((2, 2), FEW_CELLS)  # above, below: free cells times their piece's fraction; free cells
    for level in levels:
        sheet = np.pad(grid(is_level & (np.abs(heights - level) < SHEET)), REACH)
        sheet = ndimage.binary_closing(sheet, iterations=REACH)[REACH:-REACH, REACH:-REACH]
        for k, off in enumerate((heights - level, level - heights)):
            is_free = sheet & ~grid((off > STEP) & (off < HEADROOM))
            is_free &= ndimage.binary_dilation(grid(off > STEP), iterations=REACH)
            areas = np.bincount(ndimage.label(is_free)[0].ravel())[1:]
            areas = areas[areas > MIN_PIECE]
            pieces[k] += (areas**2).sum() / max(areas.sum(), 1), areas.sum()
    above, below = pieces[:, 0] / pieces[:, 1]
    return float(np.log(above / below))
