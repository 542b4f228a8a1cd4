"""Pictures of the scan from few positions that together see all of it, each drawn when it is asked for.

Where a photo shows most of a place, views find its pose. Of one whose tilt is not known, or that people
hide, they do not tell the place; its local features do, matched with those of the pictures.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..cloud.octree import Octree
from ..geometry.pose import Pose
from ..geometry.sphere import compute_indices, direction_to_pixel, find_cell, pixel_rays
from ..geometry.vectors import minus, row
from ..local_features.keypoints import find_keypoints
from ..local_features.matching import Located
from ..local_features.perspective_view import cover_sphere
from ..system.arrays import Array, Array32, Int32s, Int64s
from ..system.jobs.threads import Once, Workers
from ..system.kernels.jit import kernel, whole
from ..views.candidate_views import SEARCH_VIEW
from ..views.view import ranges_around
from ..views.view_image import render_gray

PICTURE_WIDTH = 640  # [px] of the sphere
MAX_RANGE = 30.0  # [m] farther away the scan is too thin, and a match hardly constrains the position
SPACING = 2.5  # [m] across: a nearer place that is seen from a position needs none
NEAR = 3.5  # [m] a photo is from the nearest position, at most
LAYER = 2.4  # [m] in height
ABOVE_LOWEST = 1.0  # [m] first are positions so high above the lowest around
HEIGHT_STEP = 0.3  # [m]
STOREY_CELL = np.array([2.5, 2.5, 3.0])  # [m] around: a part of a storey
TABLE_HEIGHT = 48  # rows of directions, 3.75 degrees each
SLACK = 1.0  # [m] a wall is so much nearer than what is behind it
FIRST_ROOM = 64  # positions, at first
MOST_DRAWN = 512  # at which the scan is drawn for a photo without candidates
MOST_DRAWN_KEPT = 1024  # that are kept, 0.2 GB
Look = Callable[[int], Array32]  # ranges (cells,) [m] seen from a candidate, 0 for nothing


class DrawnPlaces:
    """Positions of a map, and their pictures, each drawn when it is first asked for, by any thread."""

    def __init__(self, octree: Octree, candidates: Array) -> None:
        """Begin without pictures; `candidates` (N, 3) [m] are where a camera may be."""
        self.octree = octree
        self._positions = Once(find_positions, octree, candidates)
        self._pictures: dict[int, Located] = {}
        self._lock = threading.Lock()

    @property
    def positions(self) -> Array:
        """Positions (P, 3) [m] of the pictures, in the map's frame."""
        return self._positions()

    def choose(self, allowed: Array, likely: Array, most_likely: int) -> Int64s:
        """Return the indices (n,) of positions near any of allowed centers (N, 3) [m].

        With likely centers (K, 3), those are the `most_likely` nearest to them, else MOST_DRAWN.
        """
        positions = self.positions
        near = [k for k, one in enumerate(positions) if measure_nearest(one, allowed) < NEAR]
        if len(likely) == 0:
            return np.array(near[:MOST_DRAWN], np.int64)
        near.sort(key=lambda k: measure_nearest(positions[k], likely))
        return np.array(near[:most_likely], np.int64)

    def draw(self, places: Sequence[int], workers: Workers) -> list[Located]:
        """Return the pictures at some of the positions."""
        positions = self.positions
        with self._lock:
            missing = [k for k in places if k not in self._pictures]
            if len(self._pictures) + len(missing) > MOST_DRAWN_KEPT:
                self._pictures.clear()
                missing = list(places)
            drawn = workers.map(lambda k: draw_around(self.octree, positions[k]), missing, "draw")
            self._pictures.update(zip(missing, drawn, strict=True))
            return [self._pictures[k] for k in places]


def measure_nearest(position: Array, centers: Array) -> float:
    """Return the distance [m] of a position (3,) from the nearest of centres (N, 3); infinity without any."""
    return float(np.sqrt(np.square(centers - position).sum(axis=1).min(initial=np.inf)))


def draw_around(octree: Octree, center_map: Array) -> Located:
    """Draw all that is seen from a centre (3,) [m]; return the keypoints whose rays meet the scan."""
    pose = Pose(np.eye(3), center_map)
    image = render_gray(octree, pose, np.ones((PICTURE_WIDTH // 2, PICTURE_WIDTH), np.bool_))
    found = find_keypoints(image.gray, image.is_filled, cover_sphere(PICTURE_WIDTH))
    ranges = image.ranges[compute_indices(found.rays, PICTURE_WIDTH)]
    kept = np.flatnonzero((ranges > 0.0) & (ranges < MAX_RANGE))
    return Located(found.take(kept), ranges[kept], pose)


def find_positions(octree: Octree, candidates: Array) -> Array:
    """Return those of candidates (N, 3) [m] that together see all that a camera can see."""

    def look(k: int) -> Array32:
        ranges: Array32 = ranges_around(octree, candidates[k : k + 1], SEARCH_VIEW)[0]
        return ranges

    return candidates[choose_positions(candidates, look)]


@kernel
def next_unseen(
    order: Int64s, begin: int, centers: Array, kept: Int64s, ranges: Array32, cells: Int32s
) -> int:
    """Return the first place in `order`, from `begin`, whose position none of the kept ones (k,) sees nearby.

    Ranges (k, cells) [m] are those of the view from each kept position, 0 where nothing is seen; `cells` is a
    table (h, 2 h) of the cell in each direction. The length of `order` is returned if there is no such place.
    """
    height, width = cells.shape
    for place in range(begin, len(order)):
        is_covered = False
        for k in range(len(kept)):
            dx, dy, dz = minus(row(centers, order[place]), row(centers, kept[k]))
            across = dx * dx + dy * dy
            up: Any = abs(dz)  # of a union abs has no type
            if across >= SPACING * SPACING or up >= LAYER:
                continue
            u, v = direction_to_pixel(dx, dy, dz, np.sqrt(across), width)
            limit = ranges[k, cells[min(whole(v), height - 1), min(whole(u), width - 1)]]
            if limit == 0.0 or np.sqrt(across + dz * dz) < limit + SLACK:
                is_covered = True
                break
        if not is_covered:
            return place
    return len(order)


def cell_table(num_rings: int) -> Int32s:
    """Return the grid cell (h, 2 h) at each pixel of an equirectangular table of directions."""
    rays = pixel_rays(2 * TABLE_HEIGHT).astype(np.float32)
    return find_cell(rays.reshape(-1, 3), num_rings).reshape(rays.shape[:2])


def choose_positions(centers: Array, look: Look) -> Int64s:
    """Choose the candidates (N, 3) [m] from which the scan is drawn; return their indices.

    Each is chosen, in order of height, that none before sees nearby. `look` returns the ranges that a
    candidate sees on the cells of the search.
    """
    if len(centers) == 0:
        return np.empty(0, np.int64)
    _, group = np.unique(np.floor(centers / STOREY_CELL), axis=0, return_inverse=True)
    lowest = np.full(group.max() + 1, np.inf)
    np.minimum.at(lowest, group.ravel(), centers[:, 2])
    off = np.abs(centers[:, 2] - lowest[group.ravel()] - ABOVE_LOWEST)
    order = np.argsort(np.rint(off / HEIGHT_STEP), kind="stable")
    cells = cell_table(SEARCH_VIEW.num_rings)
    kept = np.empty(FIRST_ROOM, np.int64)
    ranges = np.empty((FIRST_ROOM, cells.max() + 1), np.float32)
    count = 0
    place = 0
    while (place := next_unseen(order, place, centers, kept[:count], ranges, cells)) < len(order):
        if count == len(kept):
            kept = np.concatenate([kept, kept])
            ranges = np.concatenate([ranges, ranges])
        kept[count] = order[place]
        ranges[count] = look(int(order[place]))
        count += 1
        place += 1
    return kept[:count]
