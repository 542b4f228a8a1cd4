"""People and things that moved between photos: parts of a photo that others contradict give no colours.

If three or more photos show a point, those that differ from most of them are outvoted. If two photos show it
and differ, at first both are blamed, then each as far as it is outvoted around the point. Blame and agreement
spread to similar colours nearby, by a bilateral filter (Tomasi and Manduchi, ICCV 1998), and so also to
points that one photo alone shows.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from ...cloud.octree import Octree
from ...geometry.pose import Pose
from ...geometry.sphere import compute_indices
from ...photo.panorama import Panorama, texels
from ...system.arrays import Array32, Bytes, Int64s, Mask
from ...system.jobs.threads import Workers
from ...system.kernels.jit import F0, HALF, kernel
from .alignment import MOST_SEEN, POINTS_PER_PHOTO, Sightings, find_sightings, read_all

VOTE_WIDTH = 256  # [px] of the cells in which votes are counted: 1.4 degrees each
LEAST_VOTING_POINTS = 200_000  # points at which votes are cast, at least
# Chosen on a house whose three photos have six people in one colour, or in clothes of several (CHANGELOG.md);
# 30 and 40, 20 and 30, 5 and 7, 0.4 and 0.5 differ by 1 % of the points.
MOST_APART = 40.0  # [8-bit levels] in any channel, between photos that agree
ALIKE = np.float32(30.0)  # [8-bit levels] deviation of colours over which votes spread
VOTE_DEVIATION = np.float32(5.0)  # [cells] deviation of distances over which votes spread
VOTE_REACH = 12  # [cells] at most
FEW_VOTES = 1.0  # agreeing votes that every cell has from the start, as one contradiction alone proves little
MOST_BLAME = 0.5  # share of votes from which a cell gives no colours
FIRST_BLAME = 0.1  # of either of two photos that differ, before votes are counted
NUM_BLAME_ROUNDS = 3  # in which blame is divided between two photos
MOST_OF_A_PHOTO = 0.5  # share of a photo that may be blamed: if more is, the photo was taken in another light
BLAME_MARGIN = 1  # [cells] around what is blamed


class Votes(NamedTuple):
    """Whether other photos of the same points agree with each sighting."""

    is_agreed: Mask  # (S,)
    is_outvoted: Mask  # (S,)
    pairs: Int64s  # (P, 2) sightings of one point by the only two photos, which differ


def remove_passersby(
    octree: Octree, panoramas: Sequence[Panorama], poses: Sequence[Pose], gains: Array32, workers: Workers
) -> list[Panorama]:
    """Return photos at poses in a map without the parts that the others contradict."""
    leaves = octree.level(octree.leaf_size)
    num_points = max(LEAST_VOTING_POINTS, POINTS_PER_PHOTO * len(poses))
    points = np.ascontiguousarray(leaves[:: -(-len(leaves) // num_points), :3])
    sightings = find_sightings(octree, points, poses, workers)
    images = [texels.pack_texels(panorama.rgb, panorama.is_valid) for panorama in panoramas]
    values = read_all(points, sightings, images, workers, poses, gains).values
    cells = np.empty(len(sightings.point), np.int64)
    for k, pose in enumerate(poses):
        own = sightings.own[k]
        rays = (points[sightings.point[own]] - pose.center_world) @ pose.R_cam_from_world.T
        i, j = compute_indices(rays, VOTE_WIDTH)
        cells[own] = (k * (VOTE_WIDTH // 2) + i) * VOTE_WIDTH + j
    blame = find_blame(cast_votes(sightings, values), cells, [p.rgb for p in panoramas], workers)
    has_votes = np.bincount(cells, minlength=blame.size).reshape(blame.shape) > 0
    return [
        without(panorama, is_blamed) if is_blamed[voted].sum() < MOST_OF_A_PHOTO * voted.sum() else panorama
        for panorama, is_blamed, voted in zip(panoramas, blame > MOST_BLAME, has_votes, strict=True)
    ]


def cast_votes(sightings: Sightings, values: Array32) -> Votes:
    """Return the votes on sightings by their colours (S, 3), which are NaN where a photo is masked."""
    point = sightings.point
    slot = np.arange(len(point)) - sightings.first[point]
    by_point = np.full((len(sightings.first) - 1, MOST_SEEN, 3), np.nan, np.float32)
    by_point[point, slot] = values
    by_point.sort(axis=1)  # NaN last
    count = (~np.isnan(by_point[..., 0])).sum(axis=1)
    rows = np.arange(len(count))
    middle = 0.5 * (by_point[rows, np.maximum(count - 1, 0) // 2] + by_point[rows, count // 2])
    limit = np.where(count == 2, MOST_APART / 2.0, MOST_APART)[point]
    is_near = np.abs(values - middle[point]).max(axis=1) <= limit
    num_near = np.bincount(point, is_near, len(count))
    is_decided = ((2 * num_near > count) & (count > 1))[point] & ~np.isnan(values[:, 0])
    is_open = (count == 2)[point] & ~is_decided & ~np.isnan(values[:, 0])
    return Votes(is_decided & is_near, is_decided & ~is_near, np.flatnonzero(is_open).reshape(-1, 2))


def find_blame(votes: Votes, cells: Int64s, pictures: Sequence[Bytes], workers: Workers) -> Array32:
    """Return the share of contradicting votes (photos, cells down, cells across) of near, similar cells."""
    shape = (len(pictures), VOTE_WIDTH // 2, VOTE_WIDTH)
    num_cells = len(pictures) * (VOTE_WIDTH // 2) * VOTE_WIDTH
    guides = [
        cv2.resize(rgb, shape[:0:-1], interpolation=cv2.INTER_AREA).astype(np.float32) for rgb in pictures
    ]
    blame = np.full(shape, FIRST_BLAME, np.float32)
    counted = np.zeros((*shape, 2), np.float32)
    counted[..., 1] = np.bincount(cells, votes.is_agreed, num_cells).reshape(shape)

    def spread(k: int) -> None:
        found = np.empty_like(counted[k])
        spread_votes(counted[k], guides[k], found)
        blame[k] = found[..., 0] / (found.sum(axis=-1) + FEW_VOTES)

    for _ in range(NUM_BLAME_ROUNDS):
        own = blame.ravel()[cells[votes.pairs]] + 1e-3
        contradicted = votes.is_outvoted.astype(np.float64)
        contradicted[votes.pairs] = own / own.sum(axis=1, keepdims=True)
        counted[..., 0] = np.bincount(cells, contradicted, num_cells).reshape(shape)
        workers.map(spread, range(len(pictures)), "compare")
    return blame


@kernel
def spread_votes(votes: Array32, guide: Array32, found: Array32) -> None:
    """Write the sums of votes (H, W, 2) around each cell, weighted by distance and by colour (H, W, 3)."""
    height, width = votes.shape[:2]
    for i in range(height):
        for j in range(width):
            against = F0
            for_it = F0
            for y in range(max(0, i - VOTE_REACH), min(height, i + VOTE_REACH + 1)):
                for x in range(j - VOTE_REACH, j + VOTE_REACH + 1):
                    at = x % width
                    if votes[y, at, 0] + votes[y, at, 1] == F0:
                        continue
                    far = np.float32((y - i) ** 2 + (x - j) ** 2) / (VOTE_DEVIATION * VOTE_DEVIATION)
                    unlike = F0
                    for c in range(3):
                        unlike += (guide[y, at, c] - guide[i, j, c]) ** 2
                    weight = np.exp(-HALF * (far + unlike / (ALIKE * ALIKE)))
                    against += weight * votes[y, at, 0]
                    for_it += weight * votes[y, at, 1]
            found[i, j, 0] = against
            found[i, j, 1] = for_it


def without(panorama: Panorama, is_blamed: Mask) -> Panorama:
    """Return a photo without its cells that are blamed, and those around them."""
    size = 2 * BLAME_MARGIN + 1
    around = np.pad(is_blamed.astype(np.uint8), ((0, 0), (BLAME_MARGIN, BLAME_MARGIN)), mode="wrap")
    grown = cv2.dilate(around, np.ones((size, size), np.uint8))[:, BLAME_MARGIN:-BLAME_MARGIN]
    height, width = panorama.is_valid.shape
    enlarged = cv2.resize(np.ascontiguousarray(grown), (width, height), interpolation=cv2.INTER_NEAREST)
    return replace(panorama, is_valid=panorama.is_valid & (enlarged == 0))
