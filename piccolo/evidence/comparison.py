"""Compares the scan at a pose with the photo, in blocks of the sphere, over the area that both show.

An occluder costs the blocks that it hides and no more: a right pose explains some blocks well and others not
at all, a wrong one explains all of them a little.
"""

import math
from functools import lru_cache

import numpy as np

from ..geometry.pose import Pose
from ..geometry.sphere import BLOCK_RINGS, NUM_BLOCKS, find_cell, make_grid, pixel_rays
from ..judge.candidate import CONTRADICTS, Comparison, Unoccluded
from ..photo.panorama.local_normalization import opponent, zscore
from ..photo.panorama.texels import TEXEL_CHUNK, Texels, make_chunk, project, sample
from ..problem.problem import Problem
from ..problem.profile import VIEWS
from ..system.arrays import Array, Array32, Int32s
from ..system.kernels.jit import F0, copy_to, kernel
from ..views.points_around import round_position
from ..views.view import ViewArrays, ViewConfig, average_colors, cell_statistics, empty_cells, locate

FINE_VIEW = VIEWS["fine"]
MASK_WIDTH = 256  # [px] of the mask of blocks that contradict
PER_LEVEL = np.float32(1.0 / 255.0)


@kernel
def sample_photo(
    offsets: Array32,
    weights: Array32,
    photo: Texels,
    R_cam_from_map: Array,
    center: Array,
    colors: Array32,
    shared: Array32,
    rays: Array32,
) -> None:
    """Write the photo's opponent channels (3, N) at cells (3, N), weights of what both show, rays (3, N).

    The camera's `center` (3,) [m] is relative to the point from which the offsets of the cells are measured.
    """
    p = make_chunk()
    for lo in range(0, len(weights), TEXEL_CHUNK):
        hi = min(lo + TEXEL_CHUNK, len(weights))
        x = offsets[0][lo:hi]
        y = offsets[1][lo:hi]
        z = offsets[2][lo:hi]
        project(x, y, z, R_cam_from_map, center, photo.rgbx, photo.width, p)
        count = hi - lo
        c0 = colors[0, lo:hi]
        c1 = colors[1, lo:hi]
        c2 = colors[2, lo:hi]
        both = shared[lo:hi]
        weight = weights[lo:hi]
        for n in range(count):
            r, g, b, shown = sample(p, n)
            c0[n], c1[n], c2[n] = opponent(r * PER_LEVEL, g * PER_LEVEL, b * PER_LEVEL)
            both[n] = weight[n] * shown
        copy_to(rays[0][lo:hi], p.x[:count])
        copy_to(rays[1][lo:hi], p.y[:count])
        copy_to(rays[2][lo:hi], p.z[:count])


@kernel
def normalize(colors: Array32, shared: Array32, view: ViewArrays, normalized: Array32) -> None:
    """Write channels (3, N) minus local mean, divided by local deviation, over the shared cells."""
    moments = np.zeros((view.num_stats, 8), np.float32)
    stats = np.empty((6, len(shared)), np.float32)
    for n in range(len(shared)):
        m = moments[view.stats_cell[n]]
        w = shared[n]
        m[0] += w
        for k in range(3):
            m[1 + k] += w * colors[k, n]
            m[4 + k] += w * colors[k, n] * colors[k, n]
    cell_statistics(moments, view, shared, stats)
    for k in range(3):
        for n in range(len(shared)):
            normalized[k, n] = zscore(colors[k, n], stats[k, n], stats[3 + k, n]) if shared[n] > F0 else F0


@kernel
def correlate_blocks(
    first: Array32, second: Array32, shared: Array32, blocks: Int32s, correlation: Array, area: Array
) -> None:
    """Write the correlation and the area (blocks,) of two sets of channels (3, N) over the shared cells."""
    energy = np.zeros((len(area), 2))
    correlation[:] = 0.0
    area[:] = 0.0
    for n in range(len(shared)):
        b = blocks[n]
        w = shared[n]
        area[b] += w
        for k in range(3):
            correlation[b] += w * first[k, n] * second[k, n]
            energy[b, 0] += w * first[k, n] * first[k, n]
            energy[b, 1] += w * second[k, n] * second[k, n]
    for b in range(len(area)):
        correlation[b] /= math.sqrt(max(energy[b, 0] * energy[b, 1], 1e-12))


@kernel
def compare_cells(
    offsets: Array32,
    colors: Array32,
    weights: Array32,
    photo: Texels,
    R_cam_from_map: Array,
    center: Array,
    view: ViewArrays,
    num_columns: Int32s,
    first_cell: Int32s,
    correlation: Array,
    area: Array,
    visible_area: Array,
) -> None:
    """Write the correlation and the shared area (blocks,) of cells (3, N) around a camera with its photo.

    Blocks are cells of a grid in the camera's frame, whose rings have `num_columns` cells and begin with
    `first_cell`. Cells are compared twice: blocks that contradict are left out of the local means and
    deviations of the second comparison.
    """
    n = len(weights)
    of_photo = np.empty_like(colors)
    shared = np.empty_like(weights)
    rays = np.empty_like(colors)
    sample_photo(offsets, weights, photo, R_cam_from_map, center, of_photo, shared, rays)
    blocks = np.empty(n, np.int32)
    ranges = np.empty(n, np.float32)
    turns = np.empty(n, np.float32)
    locate(rays[0], rays[1], rays[2], num_columns, first_cell, blocks, ranges, turns)
    first = np.empty_like(colors)
    second = np.empty_like(colors)
    kept = shared.copy()
    for k in range(2):
        normalize(colors, kept, view, first)
        normalize(of_photo, kept, view, second)
        correlate_blocks(first, second, kept, blocks, correlation, area)
        if k == 0:
            copy_to(visible_area, area)
            for i in range(n):
                if correlation[blocks[i]] < CONTRADICTS:
                    kept[i] = F0


def compare(
    problem: Problem, pose: Pose, config: ViewConfig = FINE_VIEW, seen_from: Pose | None = None
) -> Comparison:
    """Compare the scan at a pose with the photo, by blocks, by default on fine cells.

    `seen_from` is a pose so near that the same is seen from there; its view may have been drawn already.
    """
    view = config.arrays
    place = round_position(seen_from or pose)
    sums = problem.averages_at(pose, place, config)
    offsets, colors, weights, center = empty_cells(len(sums), place)
    moments = np.empty((view.num_stats, 8), np.float32)
    average_colors(sums, view, np.ones(len(sums), np.bool_), offsets, colors, weights, moments)
    photo = problem.photo.small
    grid = make_grid(BLOCK_RINGS)
    by_block = np.empty((3, NUM_BLOCKS))
    compare_cells(
        offsets,
        colors,
        weights,
        photo,
        pose.R_cam_from_world,
        pose.center_world - center,
        view,
        grid.num_columns,
        grid.first,
        by_block[0],
        by_block[1],
        by_block[2],
    )
    return Comparison(by_block[0], by_block[1], by_block[2], photo.valid_share)


def mask_occluders(problem: Problem, seen: Comparison, known: Unoccluded | None = None) -> Unoccluded:
    """Return the photo without the blocks that contradict the scan at a pose; the whole if none does.

    `known` is the photo as masked at a pose nearby: it is returned if the same blocks are masked there.
    """
    if not seen.contradicts.any():
        return Unoccluded(b"", problem.photo)
    key = seen.contradicts.tobytes()
    if known is not None and known.contradicts == key:
        return known
    return Unoccluded(key, problem.photo.mask(seen.contradicts[pixel_blocks()]))


@lru_cache(maxsize=1)
def pixel_blocks() -> Int32s:
    """Return the block in which each pixel (h, 2 h) of a mask lies."""
    rays = pixel_rays(MASK_WIDTH).astype(np.float32)
    return find_cell(rays.reshape(-1, 3), BLOCK_RINGS).reshape(rays.shape[:2])
