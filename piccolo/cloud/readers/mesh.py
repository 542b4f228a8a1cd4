"""Textured and coloured meshes as point clouds: OBJ, glTF, GLB, and PLY files with faces.

trimesh reads the files. Coordinates are those of the file's scene, in the file's axes and unit: the y of glTF
stays y.

The triangles are sampled evenly. Point k of N lies at the fraction (k + 1/2) / N of the cumulative area of
the triangles, so that the number of points in a triangle is proportional to its area, up to one point. Its
position in the triangle is the k-th point of the R2 sequence (Roberts, 2018), which leaves no clumps and no
gaps. All depends on k alone, not on chunks or on chance.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...geometry.colors import srgb_to_linear, to_bytes
from ...geometry.pose import transform_points
from ...system.arrays import Array, Bytes, Int64s, Mask
from ...system.errors import InputError
from ..cloud_settings import BY_FILE, Channel, CloudSettings, UpAxis
from .gltf import GLB_MAGIC
from .mesh_loading import WANTED, Loaded, Texture, load_gltf, load_obj, load_ply
from .reader import (
    GRAY,
    POINTS_A_CHUNK,
    USUAL,
    MissingChannelError,
    PointSource,
    RawCloud,
    find_brightest,
    in_chunks,
)

# 1 / p and 1 / p^2 of the plastic number p, the root of p^3 = p + 1
R2_STEPS = (0.7548776662466927, 0.5698402909980532)
TRIANGLES_AT_ONCE = 1 << 18  # triangles whose corners are held at once
DENSITY = 10_000.0  # points per square metre, 1 cm apart
MAX_MESH_POINTS = 30_000_000
MAX_TRIANGLES = 200_000_000  # those of a mesh count once for each node that places it


class Surface(NamedTuple):
    """Triangles of one material, in their own frame."""

    vertices: Array  # (V, 3); triangles with a NaN are left out
    triangles: Int64s  # (T, 3) rows of `vertices`
    uv: Array | None = None  # (V, 2) texture coordinates, v upwards from the lower edge
    texture: Texture | None = None
    colors: Array | None = None  # (C, 3) in [0, 1]; factors of the texture if there is one
    corners: Int64s | None = None  # (T, 3) rows of `colors`
    is_linear: bool = False  # `colors` are linear light, not sRGB
    T_world_from_surface: Array = np.eye(4)  # (4, 4) by which a node of the scene places it

    def areas(self) -> Array:
        """Return the areas (T,) of the triangles in the world; 0 for those that aren't finite."""
        areas = np.empty(len(self.triangles))
        with np.errstate(all="ignore"):
            for begin in range(0, len(areas), TRIANGLES_AT_ONCE):
                corners = self.vertices[self.triangles[begin : begin + TRIANGLES_AT_ONCE]]
                edges = (corners[:, 1:] - corners[:, :1]) @ self.T_world_from_surface[:3, :3].T
                normals = np.cross(edges[:, 0], edges[:, 1])
                areas[begin : begin + TRIANGLES_AT_ONCE] = 0.5 * np.sqrt(
                    np.einsum("ij,ij->i", normals, normals)
                )
        areas[~np.isfinite(areas)] = 0.0
        return areas


def sample_points(surfaces: Sequence[Surface], ends: Array, num_points: int) -> Iterator[RawCloud]:
    """Yield the points on P surfaces, at most POINTS_A_CHUNK at once; `ends` (P,) are cumulative areas."""
    area_per_point = float(ends[-1]) / num_points
    # the index of the first point at or beyond each surface's end
    behind = np.ceil(ends / area_per_point - 0.5).astype(np.int64)
    behind[-1] = num_points
    last: Texture | None = None
    texels: Bytes | None = None
    for i, surface in enumerate(surfaces):
        first = int(behind[i - 1]) if i else 0
        end = int(behind[i])
        if first == end:
            continue
        if surface.texture is not last:
            texels = None  # frees it before the next is decoded
            texels = surface.texture.texels() if surface.texture else None
            last = surface.texture
        area_up_to = np.add.accumulate(surface.areas())
        # rounding may put a point beyond the last triangle; the last with an area gets it
        last_row = int(np.searchsorted(area_up_to, area_up_to[-1]))
        area_before = float(ends[i - 1]) if i else 0.0
        for begin in range(first, end, POINTS_A_CHUNK):
            k = np.arange(begin, min(begin + POINTS_A_CHUNK, end))
            areas = (k + 0.5) * area_per_point - area_before
            rows = np.minimum(np.searchsorted(area_up_to, areas, side="right"), last_row)
            yield _points(surface, k, rows, texels)


def compute_weights(k: Int64s) -> Array:
    """Return barycentric coordinates (N, 3) of points k (N,): the R2 sequence, folded to a triangle."""
    a, b = (np.modf(0.5 + k * step)[0] for step in R2_STEPS)
    is_beyond = a + b > 1.0
    a[is_beyond], b[is_beyond] = 1.0 - a[is_beyond], 1.0 - b[is_beyond]
    return np.stack([1.0 - a - b, a, b], axis=1)


def _points(surface: Surface, k: Int64s, rows: Int64s, texels: Bytes | None) -> RawCloud:
    """Return the points k (N,) in the triangles `rows` (N,), without those on texels of alpha 0."""
    weights = compute_weights(k)
    matrix = surface.T_world_from_surface
    triangles = surface.triangles[rows]
    points_world = _blend(surface.vertices, triangles, weights) @ matrix[:3, :3].T + matrix[:3, 3]
    factors = None
    if surface.colors is not None and surface.corners is not None:
        factors = _blend(surface.colors, surface.corners[rows], weights)
    if texels is None or surface.uv is None:
        gray = np.full(points_world.shape, GRAY, np.uint8)
        return RawCloud(points_world, gray if factors is None else to_bytes(factors, surface.is_linear))
    rgba = look_up_texels(texels, _blend(surface.uv, triangles, weights))
    colors = rgba[:, :3]
    is_visible = rgba[:, 3] > 0
    if factors is not None:
        colors = to_bytes(srgb_to_linear(colors) * factors, is_linear=True)
    return RawCloud(points_world[is_visible], np.ascontiguousarray(colors[is_visible]))


def _blend(values: Array, corners: Int64s, weights: Array) -> Array:
    """Interpolate values (V, D) by barycentric weights (N, 3) of their rows `corners` (N, 3)."""
    a, b, c = (values[corners[:, i]] * weights[:, i : i + 1] for i in range(3))
    return np.asarray(a + b + c)


def look_up_texels(texels: Bytes, uv: Array) -> Bytes:
    """Return the texels (N, 4) at uv (N, 2): u to the right, v upwards from the lower edge, both periodic."""
    height, width = texels.shape[:2]
    turned = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
    turned -= np.floor(turned)
    columns = np.minimum((turned[:, 0] * width).astype(np.int64), width - 1)  # 1 - 1e-17 is rounded to 1
    rows = np.minimum((turned[:, 1] * height).astype(np.int64), height - 1)
    return np.asarray(texels[rows, columns])


def open_mesh(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return points on the triangles of an OBJ, GLB or glTF file, 10,000 per square metre.

    The options' scale is the file's unit in metres. A file that would give more than 30 million points is
    sampled at a lower density, with a warning. Colours are the texture's, or else those of the vertices, the
    faces or the material; in glTF texture, base colour factor and vertex colours are multiplied in linear
    light. Textures repeat beyond their edges; points on texels of alpha 0 are left out. Surfaces without
    colours are left out, with a warning.
    """
    content = path.read_bytes()
    is_gltf = content.startswith(GLB_MAGIC) or path.suffix.lower() in (".glb", ".gltf")
    return _source((load_gltf if is_gltf else load_obj)(path, content), options, channel)


def open_ply_mesh(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return points on the faces of a PLY file, as `open_mesh` does; a comment may name a texture."""
    return _source(load_ply(path), options, channel)


def _source(loaded: Loaded, options: CloudSettings, channel: Channel) -> PointSource:
    if channel == "intensity":
        raise MissingChannelError(f"{loaded.path}: has no intensity")
    loaded = replace(loaded, settings=options)
    up: UpAxis = "y" if loaded.is_gltf else "z"  # by the specification of glTF
    if clouds := _clouds(loaded, channel == "shape"):
        num_points = sum(len(cloud.colors) for cloud in clouds)
        return PointSource(loaded.path, lambda: iter(clouds), num_points, tuple(loaded.notes), up=up)
    return _sample(loaded, channel == "shape")._replace(up=up)


def _sample(loaded: Loaded, is_bare: bool) -> PointSource:
    """Return points on the triangles of a file; `is_bare`: without colours."""
    path = loaded.path
    scale = loaded.settings.scale or 1.0
    surfaces, notes = _surfaces(loaded, is_bare)
    notes += loaded.notes
    num_triangles = sum(len(surface.triangles) for surface in surfaces)
    if num_triangles > MAX_TRIANGLES:
        raise InputError(f"{path}: {num_triangles} triangles, wanted at most {MAX_TRIANGLES}")
    sums = []
    num_flat = 0
    for surface in surfaces:
        areas = surface.areas()
        sums.append(areas.sum())
        num_flat += int(np.count_nonzero(areas == 0.0))
    ends = np.cumsum(sums, dtype=np.float64)
    total = float(ends[-1])
    if not 0.0 < total < np.inf:
        raise InputError(f"{path}: {num_triangles} triangles with an area of {total:g}, {WANTED}")
    if num_flat:
        notes.append(f"{path}: {num_flat} triangles without an area or with NaN coordinates left out")
    area = total * scale * scale  # [m^2]
    num_points = round(min(area * DENSITY, MAX_MESH_POINTS))
    if num_points == 0:
        raise InputError(f"{path}: an area of {area:.2g} square metres, too small for points; set `units`")
    if area * DENSITY > MAX_MESH_POINTS:
        density = f"{num_points / area:.3g} points on each instead of {DENSITY:.0f}"
        notes.append(f"{path}: {area:.3g} square metres of surface, sampled with {density}")
    read_chunks = partial(sample_points, surfaces, ends, num_points)
    return PointSource(path, read_chunks, num_points, tuple(notes))


def _clouds(loaded: Loaded, is_bare: bool) -> list[RawCloud]:
    """Return the points of a file without triangles, placed by its scene; empty if it has triangles."""
    parts = loaded.parts
    if any(hasattr(part, "faces") for part in parts.values()):
        return []
    clouds = []
    for matrix, name in loaded.nodes:
        vertices = np.array(parts[name].vertices, np.float64)
        if vertices.shape[1:] != (3,):
            raise InputError(f"{loaded.path}: vertices of shape {vertices.shape}, wanted three numbers each")
        points = transform_points(vertices, np.array(matrix, np.float64))
        raw = parts[name].metadata.get("color")
        if raw is None and not is_bare:
            raise MissingChannelError(f"{loaded.path}: points without colours, {WANTED}")
        colors = np.full(points.shape, GRAY, np.uint8)
        if not is_bare:
            colors = to_bytes(_fractions(loaded, raw, len(points)), loaded.is_gltf)
        clouds += [RawCloud(*some) for some in in_chunks([points, colors])]
    return clouds


def _surfaces(loaded: Loaded, is_bare: bool) -> tuple[list[Surface], list[str]]:
    """Return the coloured surfaces, placed by the scene, and warnings; `is_bare`: all, uncoloured."""
    path = loaded.path
    meshes = {name: mesh for name, mesh in loaded.parts.items() if hasattr(mesh, "faces")}
    by_name = {name: _surface(loaded, mesh) for name, mesh in meshes.items()}
    surfaces = []
    num_bare = 0
    for matrix, name in loaded.nodes:
        surface = by_name.get(name)
        if surface is None:
            continue
        if is_bare:
            surface = Surface(surface.vertices, surface.triangles)
        elif surface.colors is None and surface.texture is None:
            num_bare += 1
            continue
        surfaces.append(surface._replace(T_world_from_surface=np.array(matrix, dtype=np.float64)))
    if not surfaces and not num_bare:
        raise InputError(f"{path}: no triangles, {WANTED}")
    if not surfaces or (not is_bare and _is_one_color(surfaces)):
        raise MissingChannelError(f"{path}: no colours, {WANTED}")
    # surfaces with the same texture are put together, so that it is decoded once
    first = {id(surface.texture): i for i, surface in reversed(list(enumerate(surfaces)))}
    surfaces.sort(key=lambda surface: first[id(surface.texture)])
    return surfaces, [f"{path}: {num_bare} surfaces without colours left out"] if num_bare else []


def _is_one_color(surfaces: list[Surface]) -> bool:
    first = surfaces[0].colors
    return first is not None and all(s.texture is None and np.all(s.colors == first[0]) for s in surfaces)


def _surface(loaded: Loaded, mesh: Any) -> Surface | None:
    """Return the triangles of a mesh with its colours; None if it has no triangles."""
    path = loaded.path
    vertices = np.array(mesh.vertices, dtype=np.float64)
    triangles = np.array(mesh.faces, dtype=np.int64)
    if not len(triangles):
        return None
    if (vertices.shape[1:], triangles.shape[1:]) != ((3,), (3,)):
        found = f"vertices of shape {vertices.shape} and triangles of shape {triangles.shape}"
        raise InputError(f"{path}: {found}, wanted three numbers each")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        named = f"a face names vertex {triangles.max()} (from {triangles.min()})"
        raise InputError(f"{path}: {named}, found {len(vertices)} vertices")
    texture, factor = loaded.look_of(mesh.visual)
    uv = getattr(mesh.visual, "uv", None)
    surface = Surface(vertices, triangles, is_linear=loaded.is_gltf)
    if texture is not None:
        if uv is None:
            return surface  # no use of the material's colour, which is only a factor of the texture
        surface = surface._replace(uv=_check_uv(path, uv, vertices), texture=texture)
        if not loaded.is_gltf:
            return surface
    return _with_colors(surface, loaded, mesh, factor)


def _with_colors(surface: Surface, loaded: Loaded, mesh: Any, factor: Array | None) -> Surface:
    """Return a surface with the colours of its vertices or faces, or else the material's (1, 3)."""
    triangles = surface.triangles
    of_vertices = (mesh.visual if loaded.is_gltf else mesh).vertex_attributes.get("color")
    of_faces = mesh.face_attributes.get("color")
    if of_vertices is not None:
        colors = _fractions(loaded, of_vertices, len(surface.vertices))
        if loaded.is_gltf and factor is not None:
            colors = colors * factor
        return surface._replace(colors=colors, corners=triangles)
    rows = np.zeros(1, np.int64)
    if of_faces is not None:
        factor = _fractions(loaded, of_faces, len(triangles))
        rows = np.arange(len(triangles))
    if factor is None or (surface.texture is not None and np.all(factor == 1.0)):
        return surface
    return surface._replace(colors=factor, corners=np.broadcast_to(rows[:, None], triangles.shape))


def _check_uv(path: Path, raw: Any, vertices: Array) -> Array:
    """Return texture coordinates (V, 2), and make the vertices without finite ones NaN, in place."""
    uv: Array = np.array(raw, dtype=np.float64)
    if uv.shape != (len(vertices), 2):
        raise InputError(f"{path}: {len(uv)} texture coordinates, wanted {len(vertices)}")
    is_wrong: Mask = ~np.all(np.abs(uv) < 1e6, axis=1)
    vertices[is_wrong] = np.nan
    uv[is_wrong] = 0.0
    return uv


def _fractions(loaded: Loaded, raw: Any, count: int) -> Array:
    """Return colours (N, 3) in [0, 1]; in glTF their type decides their range."""
    path = loaded.path
    colors = np.array(raw)
    if colors.ndim != 2 or len(colors) != count or colors.shape[1] < 3:
        raise InputError(f"{path}: colours of shape {colors.shape}, wanted {count} rows of red green blue")
    brightest = USUAL.get(colors.dtype.str[1:], 255.0)
    if not loaded.is_gltf and (colors.dtype != np.uint8 or loaded.settings.color_range):
        parts = [(colors[:, :3], colors[:, :3])]
        brightest, notes = find_brightest(path, parts, loaded.settings, brightest)
        loaded.notes.update(dict.fromkeys(notes))
    fractions: Array = colors[:, :3] / brightest
    if not np.all((fractions >= 0.0) & (fractions <= 1.0)):
        raise InputError(f"{path}: a colour of {np.abs(colors).max():g}, wanted 0 to {brightest:g}")
    return np.asarray(fractions, dtype=np.float64)
