"""Storeys of a building: level surfaces on which people can stand, one above another."""

from typing import NamedTuple

import cv2
import numpy as np

from ..cloud.octree import Octree
from ..geometry.points import FARTHEST_POINT
from ..system.arrays import Array, Array32, Int64s, Mask
from .camera_positions import SURFACE_VOXEL

HEADROOM_VOXELS = 11  # empty voxels above a surface on which a person can stand, 1.8 m
THICKNESS = 1  # [voxels] up and down within one floor: noise, thresholds, ramps
FLOOR_OPENING = 5  # [voxels] width of a disc that must fit on a floor, 0.8 m: it fits on no shelf or step
LEAST_AREA = 3.0  # [m2] of a floor
LEAST_FRACTION = 0.15  # least area of a floor, divided by the largest floor's
LEAST_STOREY_HEIGHT = 2.3  # [m] between the floors of two storeys
LEAST_ABOVE = 1.0  # least number of voxels a m2 above a floor; above a ceiling there are none
LEAST_OVERLAP = 0.15  # of the smaller floor; two that overlap less are one storey: two wings, a slope
# [m] a storey's surfaces are so far below and above its levels; the next storey's ceiling is lower
BELOW_LEVEL = 0.25
ABOVE_LEVEL = 0.5
FLOOR_GAP = 17  # [voxels] gaps of a floor that furniture hides from the scanner, 2.7 m
MOST_BESIDE_FLOOR = 1.5  # [m] across from a camera to the nearest scanned floor of its storey, at most
FIRST_REACH = 1.0  # [m] radius around a place in which surfaces are searched first
NUM_NEAREST = 40  # surfaces around a place, within about 0.6 m, that give the floor's height
LOW = 10.0  # [%] percentile of their heights that is the floor's


class Storey(NamedTuple):
    """One storey, in the map's frame."""

    floor: float  # [m] height of its largest level, in the map
    surfaces: Array32  # (N, 3) [m] points of its floor, sorted by x

    def nearest(self, center: Array, count: int) -> tuple[Array, Array]:
        """Return horizontal distances [m] and heights [m] of the `count` surfaces nearest to a place (3,).

        For the few places of a photo SciPy's tree is no faster, and takes 0.2 s to import.
        """
        x = self.surfaces[:, 0]
        reach = FIRST_REACH
        while True:
            begin, end = np.searchsorted(x, np.array([center[0] - reach, center[0] + reach], np.float32))
            near = self.surfaces[begin:end]
            distance = np.hypot(near[:, 0] - center[0], near[:, 1] - center[1])
            if np.count_nonzero(distance <= reach) >= count or reach > FARTHEST_POINT or len(near) == len(x):
                order = np.argsort(distance, kind="stable")[:count]
                return distance[order], near[order, 2].astype(np.float64)
            reach *= 2.0


class Storeys(NamedTuple):
    """Storeys of a map, lowest first; empty if nothing is level."""

    storeys: tuple[Storey, ...]

    def at(self, centers: Array) -> tuple[Int64s, Array]:
        """Return the index (N,) of the storey of each place (N, 3) [m], and the height (N,) [m] above it.

        The storey is the highest whose floor is below the place and was scanned near it; if no floor was
        scanned near, the highest with a floor below; else the lowest. Without storeys they are -1 and NaN.
        """
        storey = np.full(len(centers), -1)
        height = np.full(len(centers), np.nan)
        is_sure = np.zeros(len(centers), np.bool_)
        for k, one in enumerate(self.storeys if len(centers) else ()):
            found = [one.nearest(center, NUM_NEAREST) for center in centers]
            heights = np.array([around for _, around in found])
            above = centers[:, 2] - np.percentile(heights, LOW, axis=1)
            is_near = np.array([distance[0] < MOST_BESIDE_FLOOR for distance, _ in found], np.bool_)
            is_better = (above > 0.0) & (is_near | ~is_sure) | (storey < 0)
            storey[is_better] = k
            height[is_better] = above[is_better]
            is_sure |= is_near & (above > 0.0)
        return storey, height


def find_storeys(octree: Octree) -> Storeys:
    """Find the storeys of a map in the surfaces of its octree."""
    xyz = octree.level(SURFACE_VOXEL)[:, :3]
    ijk = np.floor(xyz / SURFACE_VOXEL).astype(np.int64)
    ijk -= ijk.min(axis=0) - 1
    is_top = _is_standable(ijk)
    tops = ijk[is_top]
    top_xyz = xyz[is_top]
    masks = _find_levels(ijk, tops)
    storeys = []
    for group in _unite_levels(masks):
        level_z = [float(np.median(top_xyz[tops[:, 2] == k, 2])) for k in group]
        above = top_xyz[:, 2, None] - np.array(level_z)
        is_of = ((above > -BELOW_LEVEL) & (above < ABOVE_LEVEL)).any(axis=1)
        largest = max(range(len(group)), key=lambda i: masks[group[i]].sum())
        surfaces = top_xyz[is_of]
        surfaces = np.asfortranarray(surfaces[np.argsort(surfaces[:, 0], kind="stable")])
        storeys.append(Storey(level_z[largest], surfaces))
    return Storeys(tuple(storeys))


def _is_standable(ijk: Int64s) -> Mask:
    """Return a mask (N,) of the voxels (N, 3) with room for a person above them."""
    shape = ijk.max(axis=0, initial=0) + HEADROOM_VOXELS + 2
    code = (ijk[:, 0] * shape[1] + ijk[:, 1]) * shape[2] + ijk[:, 2]
    order = np.argsort(code)
    # voxels from each one up to the next; the last one has none above it
    gap = np.append(np.diff(code[order]), HEADROOM_VOXELS + 1)
    is_free = np.empty(len(code), np.bool_)
    is_free[order] = gap > HEADROOM_VOXELS
    return is_free


def _find_levels(ijk: Int64s, tops: Int64s) -> dict[int, Mask]:
    """Return the mask (I, J) of each floor's cells by the floor's height [voxels], lowest first.

    `ijk` (N, 3) are all voxels, `tops` those with room above. The largest floor is found first; each further
    one must be LEAST_STOREY_HEIGHT from those before or hardly overlap them. Floors on which nothing stands
    are left out.
    """
    if not len(tops):
        return {}
    counts = np.bincount(tops[:, 2])
    thick = np.convolve(counts, np.ones(2 * THICKNESS + 1), "same")
    found: dict[int, Mask] = {}
    most = LEAST_AREA / SURFACE_VOXEL**2
    while thick.max() > most:
        around = slice(max(int(thick.argmax()) - THICKNESS, 0), int(thick.argmax()) + THICKNESS + 1)
        level = around.start + int(counts[around].argmax())
        mask = _open_level(ijk, tops, level)
        is_apart = all(
            abs(level - other) * SURFACE_VOXEL >= LEAST_STOREY_HEIGHT or _overlap(mask, below) < LEAST_OVERLAP
            for other, below in found.items()
        )
        if is_apart and mask.sum() > most and _has_things_above(ijk, level, mask):
            found[level] = mask
            most = max(most, LEAST_FRACTION * mask.sum())
        thick[max(level - THICKNESS, 0) : level + THICKNESS + 1] = 0.0
    return dict(sorted(found.items()))


def _open_level(ijk: Int64s, tops: Int64s, level: int) -> Mask:
    """Return the mask (I, J) of a level's cells on which a disc fits, with small gaps closed."""
    mask = np.zeros(ijk.max(axis=0)[:2] + 2, np.uint8)
    own = tops[np.abs(tops[:, 2] - level) <= THICKNESS]
    mask[own[:, 0], own[:, 1]] = 1
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (FLOOR_OPENING, FLOOR_OPENING))
    return np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc) > 0)


def _has_things_above(ijk: Int64s, level: int, mask: Mask) -> bool:
    """Return True if anything stands on a floor or around it."""
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((FLOOR_OPENING, FLOOR_OPENING), np.uint8))
    is_above = (ijk[:, 2] > level + THICKNESS) & (ijk[:, 2] <= level + HEADROOM_VOXELS)
    count = wide[ijk[is_above, 0], ijk[is_above, 1]].sum()
    return bool(count >= LEAST_ABOVE * mask.sum() * SURFACE_VOXEL**2)


def _overlap(mask: Mask, other: Mask) -> float:
    """Return the fraction of the smaller of two floors (I, J) that overlaps the other, gaps filled."""
    square = np.ones((FLOOR_GAP, FLOOR_GAP), np.uint8)
    one, two = (cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_CLOSE, square) > 0 for m in (mask, other))
    return float((one & two).sum() / max(min(one.sum(), two.sum()), 1))


def _unite_levels(masks: dict[int, Mask]) -> list[list[int]]:
    """Group levels into storeys: a level that hardly overlaps those below it joins their storey."""
    groups: list[list[int]] = []
    for level, mask in masks.items():
        below = sum((masks[other] for other in groups[-1]), np.zeros_like(mask)) if groups else mask
        if groups and _overlap(mask, below) < LEAST_OVERLAP:
            groups[-1].append(level)
        else:
            groups.append([level])
    return groups
