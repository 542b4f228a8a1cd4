"""Points spread evenly over triangles, and their colours.

Point k of N stands at the fraction (k + 1/2) / N of the area, triangles laid one after the other, so that
every triangle gets its part of the points within one. Its place in the triangle is the k-th point of the R2
sequence (Roberts, 2018), which leaves no clumps and no gaps. All depends on k alone: not on chunks, not on
chance.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...geometry.pose import Array
from .mesh_files import Texture
from .reader import CHUNK, RawCloud

# 1 / p and 1 / p^2 of the plastic number p, the root of p^3 = p + 1
R2_STEPS = (0.7548776662466927, 0.5698402909980532)
BLOCK = 1 << 18  # triangles whose corners are held at once


class Surface(NamedTuple):
    """Triangles of one material, in a frame of their own."""

    vertices: Array  # (V, 3), NaN: the triangle is left out
    triangles: NDArray[np.int64]  # (T, 3) rows of vertices
    uv: Array | None = None  # (V, 2), v upwards from the lower edge
    texture: Texture | None = None
    colors: Array | None = None  # (C, 3) in [0, 1]; with a texture: factors
    corners: NDArray[np.int64] | None = None  # (T, 3) rows of colors
    is_linear: bool = False  # colors are linear light, not sRGB


class SurfaceInstance(NamedTuple):
    """A surface where a node places it in the world."""

    surface: Surface
    T_world_from_surface: Array  # (4, 4)

    def areas(self) -> Array:
        """Areas (T,) of the triangles; 0 for those that aren't finite."""
        surface = self.surface
        areas = np.empty(len(surface.triangles))
        with np.errstate(all="ignore"):
            matrix = self.T_world_from_surface[:3, :3]
            for begin in range(0, len(areas), BLOCK):
                corners = surface.vertices[surface.triangles[begin : begin + BLOCK]]
                edges = (corners[:, 1:] - corners[:, :1]) @ matrix.T
                normals = np.cross(edges[:, 0], edges[:, 1])
                areas[begin : begin + BLOCK] = 0.5 * np.sqrt(np.einsum("ij,ij->i", normals, normals))
        areas[~np.isfinite(areas)] = 0.0
        return areas


def sample_points(instances: Sequence[SurfaceInstance], ends: Array, num_points: int) -> Iterator[RawCloud]:
    """Yield points of one surface after the other, at most CHUNK at once; `ends` (P,) are sums of areas."""
    area_per_point = float(ends[-1]) / num_points
    # the first point at or behind each instance's end
    behind = np.ceil(ends / area_per_point - 0.5).astype(np.int64)
    behind[-1] = num_points
    last: Texture | None = None
    texels: NDArray[np.uint8] | None = None
    for i, instance in enumerate(instances):
        first, end = (int(behind[i - 1]) if i else 0), int(behind[i])
        if first == end:
            continue
        texture = instance.surface.texture
        if texture is not last:
            texels = None  # before the next is decoded
            texels = texture.texels() if texture else None
            last = texture
        area_up_to = np.add.accumulate(instance.areas())
        # rounding may put an area behind all ends; never a triangle of area 0
        last_row = int(np.searchsorted(area_up_to, area_up_to[-1]))
        area_before = float(ends[i - 1]) if i else 0.0
        for begin in range(first, end, CHUNK):
            k = np.arange(begin, min(begin + CHUNK, end))
            areas = (k + 0.5) * area_per_point - area_before
            rows = np.minimum(np.searchsorted(area_up_to, areas, side="right"), last_row)
            yield _points(instance, k, rows, texels)


def weights_of(k: NDArray[np.int64]) -> Array:
    """Barycentric coordinates (N, 3) of the points k: the R2 sequence, its square folded to a triangle."""
    a, b = (np.modf(0.5 + k * step)[0] for step in R2_STEPS)
    is_beyond = a + b > 1.0
    a[is_beyond], b[is_beyond] = 1.0 - a[is_beyond], 1.0 - b[is_beyond]
    return np.stack([1.0 - a - b, a, b], axis=1)


def _points(
    instance: SurfaceInstance, k: NDArray[np.int64], rows: NDArray[np.int64], texels: NDArray[np.uint8] | None
) -> RawCloud:
    """The points k in the triangles `rows`; those on texels of alpha 0 are left out."""
    surface, weights = instance.surface, weights_of(k)
    matrix = instance.T_world_from_surface
    triangles = surface.triangles[rows]
    points_world = _blend(surface.vertices, triangles, weights) @ matrix[:3, :3].T + matrix[:3, 3]
    factors = None
    if surface.colors is not None and surface.corners is not None:
        factors = _blend(surface.colors, surface.corners[rows], weights)
    if texels is None or surface.uv is None:
        if factors is None:
            raise ValueError("a surface without colours")
        return RawCloud(points_world, _bytes(linear_to_srgb(factors) if surface.is_linear else factors))
    found = look_up(texels, _blend(surface.uv, triangles, weights))
    colors, is_visible = found[:, :3], found[:, 3] > 0
    if factors is not None:
        colors = _bytes(linear_to_srgb(srgb_to_linear(colors) * factors))
    return RawCloud(points_world[is_visible], np.ascontiguousarray(colors[is_visible]))


def _blend(values: Array, corners: NDArray[np.int64], weights: Array) -> Array:
    """Values (N, D) between those at the corners (N, 3)."""
    a, b, c = (values[corners[:, i]] * weights[:, i : i + 1] for i in range(3))
    return np.asarray(a + b + c)


def look_up(texels: NDArray[np.uint8], uv: Array) -> NDArray[np.uint8]:
    """The texels (N, 4) under uv (N, 2): u to the right, v upwards from the lower edge, both repeating."""
    height, width = texels.shape[:2]
    turned = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
    turned -= np.floor(turned)
    columns = np.minimum((turned[:, 0] * width).astype(np.int64), width - 1)  # 1 - 1e-17 is 1
    rows = np.minimum((turned[:, 1] * height).astype(np.int64), height - 1)
    return np.asarray(texels[rows, columns])


def srgb_to_linear(colors: NDArray[np.uint8]) -> Array:
    """Linear light in [0, 1] of sRGB bytes (IEC 61966-2-1)."""
    levels = np.arange(256) / 255.0
    return np.asarray(np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)[colors])


def linear_to_srgb(linear: Array) -> Array:
    """Values of sRGB in [0, 1] of linear light in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)


def _bytes(colors: Array) -> NDArray[np.uint8]:
    return np.rint(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)
