"""Views from a map's candidates: on wide cells for all that are searched, on fine cells for some.

Views on wide cells are prepared with the map. A view on fine cells is rendered when a search first needs it,
and kept until there are too many.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree
from ..geometry.cone import EVERYWHERE
from ..geometry.sphere import SEARCH_RINGS, make_grid
from ..photo.panorama.local_normalization import LEVELS_PER_UNIT
from ..system.arrays import Array, Array32, Bytes, Int8s, Int64s, Mask
from ..system.jobs.memory import check_memory
from ..system.jobs.threads import Workers
from ..system.kernels.jit import F0, F1, HALF, Scalar, inline_kernel, kernel
from .view import (
    VIEWS_A_TASK,
    Scratch,
    ViewArrays,
    ViewConfig,
    average_nodes,
    normalize_cells,
    thread_scratch,
)

WIDE_RINGS = 12  # rings of wide cells on the sphere, 15 degrees each
SEARCH_VIEW = ViewConfig(num_rings=SEARCH_RINGS, stats_rings=16, sigma_deg=22.0, voxel_per_range=1 / 15)
WIDE_VOXEL_PER_RANGE = 1 / 8  # the same of views that are averaged over wide cells
LEAST_ROOM = 256  # views for which memory is allocated at first
MOST_KEPT = 1 << 15  # views that are kept, 0.24 GB


class Views(NamedTuple):
    """Views from n centres in the map, as kernels read them."""

    centers: Array  # (n, 3) [m]
    offsets: NDArray[np.int16]  # (n, 3, cells) from the centre to the surface, times 1 / offset_unit
    offset_unit: Array32  # (n,) [m]
    features: Int8s  # (n, 3, cells) channels in levels, 0 where nothing is seen
    is_seen: Mask  # (n, cells)


class WideViews(NamedTuple):
    """Views from n centres in the map, averaged over wide cells."""

    features: Int8s  # (n, 3 * wide cells) channels in levels
    seen: Bytes  # (n, wide cells) fraction of the cell in which the scan is seen, 255 for all of it


def empty_views(num: int, num_cells: int) -> Views:
    """Return uninitialised arrays for `num` views of `num_cells` cells."""
    if num:
        bytes_per_cell = 6 + 3 + 1  # offsets, channels, seen
        check_memory(num * num_cells * bytes_per_cell, f"the scan: {num} views", "cut out a part of it")
    return Views(
        np.empty((num, 3)),
        np.empty((num, 3, num_cells), np.int16),
        np.empty(num, np.float32),
        np.empty((num, 3, num_cells), np.int8),
        np.empty((num, num_cells), np.bool_),
    )


@inline_kernel
def encode_level(channel: Scalar) -> np.int8:
    """Return a normalised channel [standard deviations] in levels of 8 bits."""
    level: Scalar = math.floor(channel * np.float32(LEVELS_PER_UNIT) + HALF)
    return np.int8(min(max(level, np.float32(-127)), np.float32(127)))


@kernel
def render_block(
    tree: Octree, voxel_per_range: float, view: ViewArrays, scratch: Scratch, views: Views
) -> None:
    """Render the views from `views.centers` and write them into the other arrays of `views`."""
    n = len(view.solid_angle)
    points = np.empty((3, n), np.float32)
    channels = np.empty((3, n), np.float32)
    weights = np.empty(n, np.float32)
    shown = np.ones(n, np.bool_)
    sums = np.empty((n, 8), np.float32)
    for k in range(len(views.centers)):
        average_nodes(tree, views.centers[k], voxel_per_range, view, EVERYWHERE, scratch, sums)
        normalize_cells(sums, view, shown, points, channels, weights)
        largest = np.float32(1e-3)
        for i in range(3):
            for c in range(n):
                largest = max(largest, abs(points[i, c]))
        views.offset_unit[k] = largest / np.float32(32767)
        for i in range(3):
            for c in range(n):
                views.offsets[k, i, c] = np.int16(points[i, c] / views.offset_unit[k])
                views.features[k, i, c] = encode_level(channels[i, c])
        for c in range(n):
            views.is_seen[k, c] = weights[c] > F0


@kernel
def render_wide_block(
    tree: Octree,
    centers: Array,
    voxel_per_range: float,
    view: ViewArrays,
    scratch: Scratch,
    features: Int8s,
    seen: Bytes,
) -> None:
    """Write views from several centres (n, 3) [m], averaged over wider cells, in few bits.

    The wider cells are those of the view's statistics. `features` (n, 3, wider cells) get the channels in
    levels, averaged over the whole area of a cell; channels are 0 where nothing is seen. `seen` (n, wider
    cells) gets the fraction of this area in which something is seen, 255 for all of it.
    """
    n = len(view.solid_angle)
    points = np.empty((3, n), np.float32)
    channels = np.empty((3, n), np.float32)
    weights = np.empty(n, np.float32)
    shown = np.ones(n, np.bool_)
    sums = np.empty((n, 8), np.float32)
    wide = np.empty((view.num_stats, 4), np.float32)
    area = np.zeros(view.num_stats, np.float32)
    for c in range(n):
        area[view.stats_cell[c]] += view.solid_angle[c]
    for k in range(len(centers)):
        average_nodes(tree, centers[k], voxel_per_range, view, EVERYWHERE, scratch, sums)
        normalize_cells(sums, view, shown, points, channels, weights)
        wide[:] = F0
        for c in range(n):
            if weights[c] > F0:
                total = wide[view.stats_cell[c]]
                for i in range(3):
                    total[i] += weights[c] * channels[i, c]
                total[3] += weights[c]
        for c in range(view.num_stats):
            for i in range(3):
                features[k, i, c] = encode_level(wide[c, i] / area[c])
            seen[k, c] = np.uint8(min(wide[c, 3] / area[c], F1) * np.float32(255) + HALF)


def render_views(octree: Octree, centers: Array, config: ViewConfig, workers: Workers) -> Views:
    """Render the views from some centres (n, 3) [m]."""
    views = empty_views(len(centers), len(make_grid(config.num_rings)))
    views.centers[:] = centers

    def run(lo: int) -> None:
        part: list[Any] = [values[lo : lo + VIEWS_A_TASK] for values in views]
        render_block(octree, config.voxel_per_range, config.arrays, thread_scratch(), Views(*part))

    list(workers.map(run, range(0, len(centers), VIEWS_A_TASK), "render views"))
    return views


def render_wide(octree: Octree, centers: Array, config: ViewConfig, workers: Workers) -> WideViews:
    """Render the views from some centres (n, 3) [m], averaged over wide cells.

    The voxels are WIDE_VOXEL_PER_RANGE wide, not as `config` says: averages need no finer ones.
    """
    config = replace(config, stats_rings=WIDE_RINGS, voxel_per_range=WIDE_VOXEL_PER_RANGE)
    num, num_wide = len(centers), len(make_grid(WIDE_RINGS))
    check_memory(num * num_wide * 4, f"the scan: {num} prepared views", "cut out a part of it")
    features = np.empty((num, 3, num_wide), np.int8)
    seen = np.empty((num, num_wide), np.uint8)

    voxel = config.voxel_per_range
    view = config.arrays

    def run(lo: int) -> None:
        part = slice(lo, lo + VIEWS_A_TASK)
        render_wide_block(octree, centers[part], voxel, view, thread_scratch(), features[part], seen[part])

    list(workers.map(run, range(0, num, VIEWS_A_TASK), "render views"))
    return WideViews(features.reshape(num, 3 * num_wide), seen)


@dataclass(eq=False)
class CandidateViews:
    """Views on fine cells from a map's candidates, each rendered at its first use; threads may share this."""

    octree: Octree
    centers: Array  # (candidates, 3) [m]
    config: ViewConfig = SEARCH_VIEW
    most_kept: int = MOST_KEPT
    made: Views = field(init=False)  # the first `num_made` rows are views, the rest is free
    num_made: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        """Begin without views."""
        self._lock = threading.Lock()
        self._forget()

    def _forget(self) -> None:
        self.made = empty_views(0, len(make_grid(self.config.num_rings)))
        self.num_made = 0
        self._row = np.full(len(self.centers), -1, np.int64)

    def at(self, candidates: Int64s, workers: Workers) -> tuple[Int64s, Views]:
        """Return (rows, views): the rows (n,) of candidates (n,) in the views; missing views are rendered."""
        with self._lock:
            missing = np.unique(candidates[self._row[candidates] < 0])
            if len(missing) and self.num_made + len(missing) > self.most_kept:
                missing = np.unique(candidates)
                self._forget()  # callers keep the old arrays that they hold
            if len(missing):
                self._append(render_views(self.octree, self.centers[missing], self.config, workers))
                self._row[missing] = np.arange(self.num_made - len(missing), self.num_made)
            return self._row[candidates], self.made

    def _append(self, views: Views) -> None:
        """Append views; if there is no room, first copy the old ones to larger arrays. Rows stay the same."""
        begin = self.num_made
        self.num_made += len(views.centers)
        if self.num_made > len(self.made.centers):
            room = max(self.num_made, min(max(2 * begin, LEAST_ROOM), self.most_kept))
            larger = empty_views(room, self.made.is_seen.shape[1])
            put_rows(larger, 0, [values[:begin] for values in self.made])
            self.made = larger
        put_rows(self.made, begin, views)


def put_rows(wholes: Sequence[Any], begin: int, parts: Sequence[Any]) -> None:
    """Copy each array of `parts` into the array of `wholes` with the same index, from row `begin` on."""
    for whole, part in zip(wholes, parts, strict=True):
        whole[begin : begin + len(part)] = part
