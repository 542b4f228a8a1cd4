"""Views from a map's candidates: wide cells of all that are searched, fine ones of some.

Wide cells are prepared with the map. A view of fine cells is made when a search first comes upon its
candidate, and kept until there are many.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cloud.octree import Octree
from ..geometry.sphere import SEARCH_RINGS, make_grid
from ..jobs.memory import check_memory
from ..jobs.threads import Workers
from .view import BLOCK, ViewConfig, render_block, render_wide_block, thread_scratch

WIDE_RINGS = 12
SEARCH_VIEW = ViewConfig(num_rings=SEARCH_RINGS, stats_rings=16, sigma_deg=22.0, voxel_per_range=1 / 15)
WIDE_VOXEL_PER_RANGE = 1 / 8  # of the same view where it is averaged over wide cells
LEAST_ROOM = 256  # views
MOST_KEPT = 1 << 15  # views, 0.24 GB


class Views(NamedTuple):
    """Views from some centres, as kernels read them."""

    centers: NDArray[np.float64]  # (n, 3) [m]
    offsets: NDArray[np.int16]  # (n, 3, cells) from the centre to what is seen, in units of
    offset_unit: NDArray[np.float32]  # (n,) [m]
    features: NDArray[np.int8]  # (n, 3, cells) channels in levels, 0 where nothing is seen
    is_seen: NDArray[np.bool_]  # (n, cells)


class WideViews(NamedTuple):
    """Views from some centres, averaged over wide cells."""

    features: NDArray[np.int8]  # (n, 3 * wide cells) channels in levels
    seen: NDArray[np.uint8]  # (n, wide cells) fraction seen of each, 255 for all


def empty_views(num: int, num_cells: int) -> Views:
    """Room for some views."""
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


def render_views(octree: Octree, centers: NDArray[np.float64], config: ViewConfig, workers: Workers) -> Views:
    """The views from some centres (n, 3) [m]."""
    views = empty_views(len(centers), len(make_grid(config.num_rings)))
    views.centers[:] = centers

    def run(lo: int) -> None:
        some, *out = (values[lo : lo + BLOCK] for values in views)
        render_block(octree, some, config.voxel_per_range, config.arrays, thread_scratch(), *out)

    list(workers.map(run, range(0, len(centers), BLOCK), "render views"))
    return views


def render_wide(
    octree: Octree, centers: NDArray[np.float64], config: ViewConfig, workers: Workers
) -> WideViews:
    """The views from some centres (n, 3) [m], averaged over wide cells.

    They are drawn of larger voxels than `config` has, as averages ask for no more.
    """
    config = replace(config, stats_rings=WIDE_RINGS, voxel_per_range=WIDE_VOXEL_PER_RANGE)
    num, num_wide = len(centers), len(make_grid(WIDE_RINGS))
    check_memory(num * num_wide * 4, f"the scan: {num} prepared views", "cut out a part of it")
    features = np.empty((num, 3, num_wide), np.int8)
    seen = np.empty((num, num_wide), np.uint8)

    def run(lo: int) -> None:
        some, *out = (values[lo : lo + BLOCK] for values in (centers, features, seen))
        render_wide_block(octree, some, config.voxel_per_range, config.arrays, thread_scratch(), *out)

    list(workers.map(run, range(0, num, BLOCK), "render views"))
    return WideViews(features.reshape(num, 3 * num_wide), seen)


@dataclass(eq=False)
class CandidateViews:
    """Views of fine cells from a map's candidates, each made when it is first asked for, by any thread."""

    octree: Octree
    centers: NDArray[np.float64]  # (candidates, 3) [m]
    config: ViewConfig = SEARCH_VIEW
    made: Views = field(init=False)  # with room for more
    num_made: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        """None is made."""
        self._lock = threading.Lock()
        self._forget()

    def _forget(self) -> None:
        self.made = empty_views(0, len(make_grid(self.config.num_rings)))
        self.num_made = 0
        self._row = np.full(len(self.centers), -1, np.int64)

    def at(self, candidates: NDArray[np.int64], workers: Workers) -> tuple[NDArray[np.int64], Views]:
        """The rows (n,) of some candidates (n,) among the views made, and these."""
        with self._lock:
            missing = np.unique(candidates[self._row[candidates] < 0])
            if len(missing) and self.num_made + len(missing) > MOST_KEPT:
                missing = np.unique(candidates)
                self._forget()  # who was given the old ones has them
            if len(missing):
                self._append(render_views(self.octree, self.centers[missing], self.config, workers))
                self._row[missing] = np.arange(self.num_made - len(missing), self.num_made)
            return self._row[candidates], self.made

    def _append(self, views: Views) -> None:
        """Put views behind those made, in arrays twice as long if there is no room: nobody's rows change."""
        begin = self.num_made
        self.num_made += len(views.centers)
        if self.num_made > len(self.made.centers):
            room = max(self.num_made, min(2 * begin, MOST_KEPT), LEAST_ROOM)
            larger = empty_views(room, self.made.is_seen.shape[1])
            put_rows(larger, 0, [values[:begin] for values in self.made])
            self.made = larger
        put_rows(self.made, begin, views)


def put_rows(wholes: Sequence[Any], begin: int, parts: Sequence[Any]) -> None:
    """Write some views into others, from a row on."""
    for whole, part in zip(wholes, parts, strict=True):
        whole[begin : begin + len(part)] = part
