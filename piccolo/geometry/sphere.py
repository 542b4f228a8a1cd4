"""The equirectangular camera: direction <-> pixel and its derivative. The only owner of the pixel convention.

For x_cam = (x, y, z), +x the image centre, +y left, +z up, and an image of W x H pixels, W = 2 H:
    azimuth phi = atan2(y, x),  elevation theta = atan2(z, hypot(x, y)),
    u = (1/2 - phi / 2 pi) W,   v = (1/2 - theta / pi) H,
continuous coordinates, the centre of image[i, j] at (j + 1/2, i + 1/2). u wraps, v does not.
As W = 2 H, both coordinates have the same scale: -W / 2 pi pixels a radian.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..system.arrays import Array, Array32, Floats, Int32s, Int64s
from ..system.kernels.jit import F0, HALF, Scalar, inline_kernel

PI = np.float32(math.pi)
HALF_PI = np.float32(math.pi / 2)
TINY_LENGTH = np.float32(1e-18)

# the text with which files describe their poses
CONVENTION = (
    "x_cam = R_cam_from_world @ (x_world - center_world) in metres; +x_cam points to the image centre, "
    "+y_cam left, +z_cam up; u = (1/2 - atan2(y, x) / 2 pi) W, v = (1/2 - atan2(z, hypot(x, y)) / pi) H, "
    "pixel centres at half-integers"
)

# atan(q) = q P(q^2) on [0, 1], minimax in the absolute error: 2.5e-7 rad, 3.4e-7 with float32 rounding.
# math.atan2 is a library call that keeps a loop from being vectorised.
A0 = np.float32(0.99999612569809)
A1 = np.float32(-0.33317369222641)
A2 = np.float32(0.19807815551758)
A3 = np.float32(-0.13233341276646)
A4 = np.float32(0.07962366193533)
A5 = np.float32(-0.03360421210527)
A6 = np.float32(0.00681171109960)
BLOCK_RINGS = 6  # of the blocks of 30 degrees in which a score is taken
CHANCE_CORRELATION = 0.35  # of a block, that wrong poses reach
SEARCH_RINGS = 24  # of the views that are searched: cells of 7.5 degrees
AREA_UNITS = 1000  # of the largest cell


@inline_kernel
def atan2(y: Scalar, x: Scalar) -> Scalar:
    """Return the angle [rad] of (x, y) in (-pi, pi], float32, within 6e-7 of math.atan2; 0 at the origin."""
    abs_x: Any = abs(x)  # of a union abs has no type
    abs_y: Any = abs(y)
    q = min(abs_x, abs_y) / max(abs_x, abs_y, TINY_LENGTH)
    s = q * q
    angle: Scalar = q * (A0 + s * (A1 + s * (A2 + s * (A3 + s * (A4 + s * (A5 + s * A6))))))
    angle = HALF_PI - angle if abs_y > abs_x else angle
    angle = PI - angle if x < F0 else angle
    return -angle if y < F0 else angle


@inline_kernel
def direction_to_pixel(x: Scalar, y: Scalar, z: Scalar, rho: Scalar, width: Scalar) -> tuple[Scalar, Scalar]:
    """Return the pixel (u, v) of a direction (x, y, z), rho = hypot(x, y), in an image of `width`."""
    scale = width / (PI + PI)
    u = HALF * width - scale * atan2(y, x)
    v = HALF * HALF * width - scale * atan2(z, rho)
    return u, v


@inline_kernel
def pixel_jacobian(
    x: Scalar, y: Scalar, z: Scalar, rho2: Scalar, width: Scalar
) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Return the derivatives du/dx, du/dy, dv/dx, dv/dy, dv/dz of a pixel (u, v); du/dz is 0.

    x, y, z are camera coordinates, rho2 is x^2 + y^2. At a pole and at the camera itself, where there is no
    derivative, the divisor stays above zero and the numbers finite.
    """
    scale = width / (PI + PI)
    rho2 = max(rho2, TINY_LENGTH)
    per_rho2 = scale / rho2
    per_rho_r2 = scale / (math.sqrt(rho2) * (rho2 + z * z))
    return y * per_rho2, -x * per_rho2, x * z * per_rho_r2, y * z * per_rho_r2, -rho2 * per_rho_r2


def pixel_rays(width: int, rows: slice = slice(None)) -> Array:
    """Return the unit camera directions (width / 2, width, 3) of pixel centres, or of some `rows` of them."""
    return compute_rays(np.arange(width) + 0.5, np.arange(width // 2)[rows, None] + 0.5, width)


def compute_rays(u: Any, v: Any, width: int) -> Array:
    """Return the unit camera directions (..., 3) of continuous pixels u, v (...) in an image of `width`."""
    azimuth = (0.5 - u / width) * 2.0 * np.pi
    elevation = (0.5 - v / (width / 2.0)) * np.pi
    rays = np.empty((*np.broadcast_shapes(np.shape(u), np.shape(v)), 3))
    rays[..., 0] = np.cos(elevation) * np.cos(azimuth)
    rays[..., 1] = np.cos(elevation) * np.sin(azimuth)
    rays[..., 2] = np.sin(elevation)
    return rays


def compute_pixels(rays: Floats, width: int) -> tuple[Floats, Floats]:
    """Return the continuous pixels u, v (...) of camera directions (..., 3) in an image of `width`."""
    x, y, z = np.moveaxis(rays, -1, 0)
    u = (0.5 - np.arctan2(y, x) / (2.0 * np.pi)) * width
    v = (0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi) * width / 2.0
    return u, v


def compute_indices(rays: Floats, width: int) -> tuple[Int64s, Int64s]:
    """Return rows and columns (...) of the pixels that contain directions (..., 3) in an image of `width`."""
    u, v = compute_pixels(rays, width)
    return np.minimum(v.astype(np.int64), width // 2 - 1), u.astype(np.int64) % width


def solid_angles(width: int) -> Array:
    """Return the solid angle [sr] of a pixel of each row (width / 2,); exact: all pixels' sum to 4 pi."""
    edges = np.sin((0.5 - np.arange(width // 2 + 1) / (width // 2)) * np.pi)
    return np.asarray((edges[:-1] - edges[1:]) * 2.0 * np.pi / width)


@dataclass(frozen=True)
class SphereGrid:
    """`num_rings` rings of equal height; ring i has about 2 num_rings cos(elevation) cells."""

    num_columns: Int32s  # (rings,) cells of each ring
    first: Int32s  # (rings,) index of its first cell
    directions: Array32  # (cells, 3) unit vectors of the cell centres
    solid_angle: Array32  # (cells,) fractions of the sphere, sum 1

    def __len__(self) -> int:
        return len(self.solid_angle)


@dataclass(frozen=True)
class Neighbors:
    """Gaussian weights from the cells of one grid to those of another, as compressed rows."""

    row: Int32s  # (cells + 1,)
    cell: Int32s
    weight: Array32  # not normalised: the valid weights are summed where they are used


@lru_cache(maxsize=8)
def make_grid(num_rings: int) -> SphereGrid:
    """Make a grid of rings from the zenith down; within a ring the azimuth grows from -pi."""
    edges = np.pi * (0.5 - np.arange(num_rings + 1) / num_rings)
    middle = 0.5 * (edges[:-1] + edges[1:])
    num_columns = np.maximum(np.rint(2 * num_rings * np.cos(middle)), 3).astype(np.int32)
    first = np.concatenate([[0], np.cumsum(num_columns)[:-1]]).astype(np.int32)
    directions = []
    solid_angle = []
    for ring in range(num_rings):
        n = num_columns[ring]
        azimuth = ((np.arange(n) + 0.5) / n - 0.5) * 2 * np.pi
        c = np.cos(middle[ring])
        s = np.sin(middle[ring])
        directions.append(np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.full(n, s)], axis=1))
        solid_angle.append(np.full(n, 0.5 * (np.sin(edges[ring]) - np.sin(edges[ring + 1])) / n))
    all_directions = np.concatenate(directions).astype(np.float32)
    return SphereGrid(num_columns, first, all_directions, np.concatenate(solid_angle).astype(np.float32))


NUM_BLOCKS = len(make_grid(BLOCK_RINGS))


@lru_cache(maxsize=8)
def make_neighbors(num_rings: int, sigma_deg: float) -> Neighbors:
    """Compute the Gaussian weights of the cells of a grid within 2.3 sigmas of each cell.

    In float64, and without BLAS: rounded to float32 they are the same on all processors.
    """
    grid = make_grid(num_rings)
    sigma = np.radians(sigma_deg)
    x, y, z = grid.directions.T.astype(np.float64)
    cosine = np.multiply.outer(x, x) + np.multiply.outer(y, y) + np.multiply.outer(z, z)
    rows, cells = np.nonzero(cosine > np.cos(2.3 * sigma))
    weight = np.exp((cosine[rows, cells] - 1) / sigma**2) * grid.solid_angle[cells]
    row = np.searchsorted(rows, np.arange(len(grid) + 1)).astype(np.int32)
    return Neighbors(row, cells.astype(np.int32), weight.astype(np.float32))


@lru_cache(maxsize=8)
def interpolation(num_rings: int, coarse_rings: int) -> tuple[Int32s, Array32]:
    """Return the `cells_around` (cells, 4) of a coarser grid around each cell's centre, and their weights."""
    return cells_around(make_grid(num_rings).directions.astype(np.float64), coarse_rings)


def cells_around(fine: Array, coarse_rings: int) -> tuple[Int32s, Array32]:
    """Return the cells (N, 4) of a grid around each unit direction (N, 3), and their bilinear weights.

    The four are two cells in each of two rings; beyond the last ring that ring is used again, on the other
    side of the pole.
    """
    coarse = make_grid(coarse_rings)
    place = (0.5 - np.arcsin(np.clip(fine[:, 2], -1.0, 1.0)) / np.pi) * coarse_rings - 0.5
    turn = np.arctan2(fine[:, 1], fine[:, 0]) / (2.0 * np.pi) + 0.5
    cells = []
    weights = []
    for step in (0, 1):
        along = 1.0 - np.abs(place - np.floor(place) - step)
        beside = np.floor(place).astype(int) + step
        ring = np.clip(beside, 0, coarse_rings - 1)
        n = coarse.num_columns[ring]
        column = (turn + 0.5 * (beside != ring)) * n - 0.5
        for side in (0, 1):
            across = 1.0 - np.abs(column - np.floor(column) - side)
            cells.append(coarse.first[ring] + (np.floor(column).astype(int) + side) % n)
            weights.append(along * across)
    return np.stack(cells, axis=1).astype(np.int32), np.stack(weights, axis=1).astype(np.float32)


@lru_cache(maxsize=4)
def wider_cells(num_rings: int) -> tuple[Int32s, Array32]:
    """Return, for each search cell, the cell of `num_rings` that it lies in, and the areas (cells,) of those.

    The area is the sum of the search cells' `whole_areas`.
    """
    cells = find_cell(make_grid(SEARCH_RINGS).directions, num_rings)
    areas = np.bincount(cells, whole_areas(SEARCH_RINGS), len(make_grid(num_rings)))
    return cells, areas.astype(np.float32)


def whole_areas(num_rings: int) -> Array32:
    """Return the solid angles (cells,) of a grid in whole numbers up to AREA_UNITS: their sums are exact."""
    area = make_grid(num_rings).solid_angle
    return np.asarray(np.rint(area / area.max() * np.float32(AREA_UNITS)))


def find_cell(directions: Array32, num_rings: int) -> Int32s:
    """Return the cell (N,) of a grid in which each direction (N, 3) lies."""
    d = directions.astype(np.float64)
    grid = make_grid(num_rings)
    place = (0.5 - np.arcsin(np.clip(d[:, 2], -1, 1)) / np.pi) * num_rings
    ring = np.clip(place.astype(int), 0, num_rings - 1)
    n = grid.num_columns[ring]
    column = np.minimum(((np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) + 0.5) * n).astype(int), n - 1)
    return np.asarray(grid.first[ring] + column, dtype=np.int32)
