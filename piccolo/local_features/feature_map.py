"""Local features of the scan: positions of the views, the features in them, and an index of descriptors."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Array32, Bytes, Int8s, Int32s, Int64s, Mask
from ..cloud.octree import Octree
from ..geometry.pose import Pose
from ..geometry.sphere import compute_indices, direction_to_pixel, find_cell, pixel_rays
from ..geometry.vectors import minus, row
from ..jobs.threads import Workers, one_blas_thread
from ..kernels.jit import inline_kernel, kernel, whole
from .keypoints import DESCRIPTOR_SIZE, find_keypoints
from .perspective_view import cover_sphere
from .view_image import render_gray

MAP_VIEW_WIDTH = 640  # [px] of the views
NUM_COMPONENTS = 64
MAX_RANGE = 30.0  # [m] farther away the scan is too thin, and a match hardly constrains the position
SAMPLE = 20_000  # descriptors from which the components and the lists' middles are learnt
LIST_SIZE = 128  # features of a list, on average
MAX_LISTS = 4096
MOST_VIEWS = 1 << 16
GROWTH = 2  # of the number of lists for all features: from this factor on new lists are made
KMEANS_ROUNDS = 5
DESCRIPTORS_AT_ONCE = 4096  # descriptors that are projected, or that a thread sorts into lists, at a time
FEATURES_AT_ONCE = 256  # of these, whose distances from all lists' middles take 4 MB
# From where features are taken: few positions that see all that a camera can see
VIEW_SPACING = 2.5  # [m] across: a nearer place that is seen from a position needs none
LAYER = 2.4  # [m] in height
MAX_VIEWS = 2500  # some minutes and 0.4 GB
SPACING_GROWTH = 1.5  # growth of the spacing where there would be more
ABOVE_LOWEST = 1.0  # [m] first are positions so high above the lowest around
HEIGHT_STEP = 0.3  # [m]
Look = Callable[[int], Array32]  # ranges (cells,) [m] seen from a candidate, 0 for nothing
STOREY_CELL = np.array([2.5, 2.5, 3.0])  # [m] around: a part of a storey
TABLE_HEIGHT = 48  # rows of directions, 3.75 degrees each
SLACK = 1.0  # [m] a wall is so much nearer than what is behind it


class FeatureMap(NamedTuple):
    """Local features in the map's frame, sorted by the list that each is in."""

    points: Array32  # (F, 3) [m]
    directions: Int8s  # (F, 3) from the camera to the point, times 127
    tangents: Int8s  # (F, 3) in which the keypoint points, across the direction, times 127
    sizes: Array32  # (F,) diameter [m]
    descriptors: Int8s  # (F, NUM_COMPONENTS)
    views: NDArray[np.uint16]  # (F,) index of the view that each is from
    view_centers: Array  # (V, 3) [m]
    mean: NDArray[np.int16]  # (128,) of the descriptors, and
    components: Int8s  # (128, NUM_COMPONENTS) their principal components, times 127
    middles: Int8s  # (L, NUM_COMPONENTS) of the lists
    list_start: Int32s  # (L + 1,) where each begins


class FeaturesOfView(NamedTuple):
    """Features of one view: arrays of FeatureMap, but whole descriptors (F, 128)."""

    points: Array32
    directions: Int8s
    tangents: Int8s
    sizes: Array32
    descriptors: Bytes


_NO_ROWS = np.empty((0, 3), np.int8)
NO_FEATURES = FeaturesOfView(
    np.empty((0, 3), np.float32),
    _NO_ROWS,
    _NO_ROWS,
    np.empty(0, np.float32),
    np.empty((0, DESCRIPTOR_SIZE), np.uint8),
)


def extract_view_features(octree: Octree, center_map: Array) -> FeaturesOfView:
    """Find the features seen from a centre (3,) [m] whose ray meets the scan within MAX_RANGE."""
    is_drawn = np.ones((MAP_VIEW_WIDTH // 2, MAP_VIEW_WIDTH), np.bool_)
    image = render_gray(octree, Pose(np.eye(3), center_map), is_drawn)
    found = find_keypoints(image.gray, image.is_filled, cover_sphere(MAP_VIEW_WIDTH))
    ranges = image.ranges[compute_indices(found.rays, MAP_VIEW_WIDTH)]
    kept = np.flatnonzero((ranges > 0.0) & (ranges < MAX_RANGE))
    found = found.take(kept)
    ranges = ranges[kept]
    return FeaturesOfView(
        np.asarray(center_map + found.rays * ranges[:, None], np.float32),
        np.rint(found.rays * 127.0).astype(np.int8),
        np.rint(found.tangents * 127.0).astype(np.int8),
        np.asarray(found.sizes * ranges, np.float32),
        found.descriptors,
    )


def principal_components(descriptors: Bytes) -> tuple[NDArray[np.int16], Int8s]:
    """Return mean (128,) and first components (128, NUM_COMPONENTS), times 127, of descriptors (N, 128)."""
    values = descriptors.astype(np.float64)
    mean = np.rint(values.sum(axis=0) / max(len(values), 1))
    values -= mean
    axes = np.linalg.eigh(values.T @ values)[1][:, : -NUM_COMPONENTS - 1 : -1]
    axes *= np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(NUM_COMPONENTS)])
    return mean.astype(np.int16), np.rint(axes * 127.0).astype(np.int8)


def project(descriptors: Bytes, mean: NDArray[np.int16], components: Int8s) -> Int8s:
    """Return the components (N, NUM_COMPONENTS) of descriptors (N, 128).

    Sums of whole numbers below 2^24 are exact in float32.
    """
    projected = np.empty((len(descriptors), NUM_COMPONENTS), np.int8)
    for lo in range(0, len(descriptors), DESCRIPTORS_AT_ONCE):
        values = descriptors[lo : lo + DESCRIPTORS_AT_ONCE].astype(np.float32) - mean.astype(np.float32)
        sums = values @ components.astype(np.float32)
        projected[lo : lo + DESCRIPTORS_AT_ONCE] = np.clip(np.rint(sums / np.float32(127.0)), -127, 127)
    return projected


@inline_kernel
def square_gap(first: Int8s, second: Int8s) -> np.int32:
    """Return the squared distance of two descriptors (NUM_COMPONENTS,) of 8 bits.

    Numba makes 64 bits of products of 32 bits; cut to 32 again, 16 are computed at a time.
    """
    total = np.int32(0)
    for d in range(NUM_COMPONENTS):
        gap = np.int32(np.int32(first[d]) - np.int32(second[d]))
        total = np.int32(total + np.int32(gap * gap))
    return total


def find_nearest(descriptors: Int8s, middles: Int8s) -> Int32s:
    """Return the index (N,) of the nearest middle (L, D) of each descriptor (N, D), the first of equal ones.

    Exact as in `project`: a squared distance less that of the descriptor from zero is below 2^24.
    """
    nearest = np.empty(len(descriptors), np.int32)
    values = middles.astype(np.float32)
    squares = np.sum(values * values, axis=1)
    values *= np.float32(-2.0)
    for lo in range(0, len(descriptors), FEATURES_AT_ONCE):
        gaps = descriptors[lo : lo + FEATURES_AT_ONCE].astype(np.float32) @ values.T
        gaps += squares
        nearest[lo : lo + FEATURES_AT_ONCE] = gaps.argmin(axis=1)
    return nearest


def list_middles(descriptors: Int8s, num_lists: int) -> Int8s:
    """Cluster an even sample of descriptors (N, D) by Lloyd's k-means; return the middles (num_lists, D)."""
    sample = descriptors[:: 1 + len(descriptors) // SAMPLE]
    if len(sample) == 0:
        return np.zeros((num_lists, NUM_COMPONENTS), np.int8)
    middles = sample[np.linspace(0, len(sample) - 1, num_lists).astype(int)].copy()
    for _ in range(KMEANS_ROUNDS):
        nearest = find_nearest(sample, middles)
        order = np.argsort(nearest, kind="stable")
        lists, first, counts = np.unique(nearest[order], return_index=True, return_counts=True)
        sums = np.add.reduceat(sample[order].astype(np.int64), first, axis=0)
        middles[lists] = np.rint(sums / counts[:, None]).astype(np.int8)
    return np.asarray(middles)


def find_features(
    octree: Octree, centers: Array, workers: Workers
) -> tuple[FeaturesOfView, NDArray[np.uint16]]:
    """Find the features seen from centres (N, 3) [m]; return them and the index (F,) of the view of each."""
    views = list(workers.map(lambda c: extract_view_features(octree, c), list(centers), "find features"))
    joined: list[Any] = [np.concatenate(values) for values in zip(NO_FEATURES, *views, strict=True)]
    counts = np.array([len(view.points) for view in views], np.int64)
    return FeaturesOfView(*joined), np.repeat(np.arange(len(views), dtype=np.uint16), counts)


def num_lists(num_features: int) -> int:
    """Return the number of lists for a number of features."""
    return int(np.clip(num_features // LIST_SIZE, 1, MAX_LISTS))


def put_in_lists(
    of_points: Sequence[NDArray[Any]],
    of_all: tuple[Array, NDArray[np.int16], Int8s],
    middles: Int8s,
    workers: Workers,
) -> FeatureMap:
    """Sort features into the lists that have these middles; return the map.

    `of_points` are the first six arrays of FeatureMap, in any order of the features, `of_all` its next three.
    """
    descriptors = of_points[4]
    parts = [
        descriptors[lo : lo + DESCRIPTORS_AT_ONCE] for lo in range(0, len(descriptors), DESCRIPTORS_AT_ONCE)
    ]
    with one_blas_thread():
        found = workers.map(lambda part: find_nearest(part, middles), parts, "sort features")
    nearest = np.concatenate([np.empty(0, np.int32), *found])
    order = np.argsort(nearest, kind="stable")
    start = np.searchsorted(nearest[order], np.arange(len(middles) + 1)).astype(np.int32)
    arrays: list[Any] = [*(values[order] for values in of_points), *of_all, middles, start]
    return FeatureMap(*arrays)


def make_feature_map(octree: Octree, centers: Array, workers: Workers) -> FeatureMap:
    """Make the map of the features seen from centres (N, 3) [m]."""
    found, views = find_features(octree, centers, workers)
    mean, components = principal_components(found.descriptors[:: 1 + len(found.points) // SAMPLE])
    descriptors = project(found.descriptors, mean, components)
    of_points = (*found[:-1], descriptors, views)
    del found  # the room of its descriptors is needed
    middles = list_middles(descriptors, num_lists(len(descriptors)))
    return put_in_lists(of_points, (centers, mean, components), middles, workers)


def extend_feature_map(
    old: FeatureMap, is_kept: Mask, octree: Octree, centers: Array, workers: Workers
) -> FeatureMap:
    """Keep the features of some of the views (V,), and add those seen from more centres (N, 3) [m].

    The components do not change, nor do the lists, unless the features need GROWTH times as many.
    """
    num_kept = np.count_nonzero(is_kept)
    if num_kept == 0:
        return make_feature_map(octree, centers, workers)
    found, views = find_features(octree, centers, workers)
    rows = np.flatnonzero(is_kept[old.views])
    renumbered = (np.cumsum(is_kept) - 1).astype(np.uint16)[old.views]
    known: list[Any] = [*old[:5], renumbered]
    descriptors = project(found.descriptors, old.mean, old.components)
    more: list[Any] = [*found[:-1], descriptors, views + np.uint16(num_kept)]
    joined = [np.concatenate([a[rows], b]) for a, b in zip(known, more, strict=True)]
    middles = old.middles
    if num_lists(len(joined[0])) >= GROWTH * len(middles):
        middles = list_middles(joined[4], num_lists(len(joined[0])))
    of_all = (np.concatenate([old.view_centers[is_kept], centers]), old.mean, old.components)
    return put_in_lists(joined, of_all, middles, workers)


@kernel
def next_unseen(
    order: Int64s, begin: int, centers: Array, kept: Int64s, ranges: Array32, cells: Int32s, spacing: float
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
            if across >= spacing * spacing or up >= LAYER:
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


def view_positions(centers: Array, look: Look, num_rings: int, num_known: int = 0) -> Int64s:
    """Choose the candidates (N, 3) [m] from which features are taken; return at most MAX_VIEWS indices.

    The first `num_known` have features already: they are not returned. `look` returns the ranges that a
    candidate sees on the cells of `num_rings`.
    """
    if len(centers) == 0:
        return np.empty(0, np.int64)
    _, group = np.unique(np.floor(centers / STOREY_CELL), axis=0, return_inverse=True)
    lowest = np.full(group.max() + 1, np.inf)
    np.minimum.at(lowest, group.ravel(), centers[:, 2])
    off = np.abs(centers[:, 2] - lowest[group.ravel()] - ABOVE_LOWEST)
    order = np.argsort(np.rint(off / HEIGHT_STEP), kind="stable")
    order = order[order >= num_known]
    look = lru_cache(maxsize=None)(look)
    cells = cell_table(num_rings)
    spacing = VIEW_SPACING
    while (kept := choose(order, centers, num_known, look, cells, spacing)) is None:
        spacing *= SPACING_GROWTH
    return kept


def choose(
    order: Int64s, centers: Array, num_known: int, look: Look, cells: Int32s, spacing: float
) -> Int64s | None:
    """Choose, in order, each position that no known or chosen one sees; None if they exceed MAX_VIEWS."""
    room = num_known + MAX_VIEWS
    kept = np.arange(room)
    ranges = np.empty((room, cells.max() + 1), np.float32)
    count = num_known
    for k in range(num_known):
        ranges[k] = look(k)
    place = 0
    while (place := next_unseen(order, place, centers, kept[:count], ranges, cells, spacing)) < len(order):
        if count == room:
            return None
        kept[count] = order[place]
        ranges[count] = look(int(order[place]))
        count += 1
    return kept[num_known:count]
