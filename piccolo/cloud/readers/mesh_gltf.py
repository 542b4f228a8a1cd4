"""The JSON of glTF and GLB files, cut down to what is read here before trimesh sees it.

trimesh passes over what it doesn't know (compression, sparse accessors) and takes zeros; here it is refused.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from .mesh_files import Beside
from .mesh_glb import WANTED, glb_parts, has_glb_magic
from .mesh_texture import check_image, first_line

KNOWN_EXTENSIONS = frozenset({"KHR_materials_unlit", "EXT_texture_webp"})  # of those a file may require
MAX_DEPTH = 200  # nodes below each other: a chain of n costs n^2
MAX_ROWS = 20_000_000  # vertices and indices of all primitives; more only in a file of more bytes
MAX_SHARING = 4  # times that a byte may be part of an accessor, on average

BYTES_OF_TYPE = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
NUM_OF_SHAPE = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
FLOAT = 5126
NORMALIZED = frozenset({5121, 5123, FLOAT})
TRIANGLES, STRIP, FAN = 4, 5, 6

Json = dict[str, Any]


@dataclass(frozen=True)
class Material:
    """The base colour of a glTF material."""

    factor: tuple[float, float, float]  # linear light
    has_texture: bool
    is_given: bool = True  # False: the primitive has no material


NO_MATERIAL = Material((1.0, 1.0, 1.0), False, False)


@dataclass(frozen=True)
class Narrowed:
    """A glTF file with nothing in it but triangles, base colours and nodes."""

    content: bytes  # JSON, without the buffers
    materials: list[Material]  # named by their rows


def narrow(content: bytes, beside: Beside) -> Narrowed:
    """Check a glTF or GLB file against its sizes; its buffers are then found `beside` it."""
    path = beside.path
    text, binary = glb_parts(path, content) if has_glb_magic(content) else (content, None)
    try:
        tree = json.loads(text)
        return _Narrower(path, beside, tree, binary, len(content)).narrowed()
    except InputError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f"{path}: broken JSON ({first_line(error)}), {WANTED}") from error


@dataclass
class _Narrower:
    path: Path
    beside: Beside
    tree: Json
    binary: bytes | None
    num_bytes: int
    num_rows: int = 0  # of the primitives so far

    def narrowed(self) -> Narrowed:
        self._check_extensions()
        buffers = self._buffers()
        self._check_views(buffers)
        self._check_accessors()
        self._check_nodes()
        images = self._images(buffers)
        given = self.tree.get("materials", [])
        materials = [self._material(material) for material in given]
        kept = [self._kept_material(i, material) for i, material in enumerate(given)]
        meshes = [
            {"primitives": [p for p in map(self._primitive, mesh["primitives"]) if p]}
            for mesh in self.tree.get("meshes", [])
        ]
        tree = {
            "asset": {"version": str(self.tree["asset"]["version"])},
            "buffers": [{"uri": name} for name in self._in_memory(buffers)],
            "bufferViews": self.tree.get("bufferViews", []),
            "accessors": self.tree.get("accessors", []),
            "images": images,
            "textures": [{"source": i} for i in range(len(images))],
            "materials": [*kept, {"name": str(len(kept))}],
            "meshes": meshes,
            "nodes": [_kept_node(node) for node in self.tree.get("nodes", [])],
            "scenes": [{"nodes": self._roots()}],
        }
        return Narrowed(json.dumps(tree).encode(), [*materials, NO_MATERIAL])

    def _check_extensions(self) -> None:
        unknown = set(self.tree.get("extensionsRequired", [])) - KNOWN_EXTENSIONS
        if unknown:
            names = ", ".join(sorted(map(str, unknown)))
            raise InputError(
                f"{self.path}: requires the extensions {names[:100]!a}, wanted a plain glTF mesh"
            )

    def _buffers(self) -> list[bytes]:
        buffers = []
        for i, buffer in enumerate(self.tree.get("buffers", [])):
            if "uri" in buffer:
                content = self.beside.uri_content(buffer["uri"])
            elif i == 0 and self.binary is not None:
                content = self.binary
            else:
                raise InputError(f"{self.path}: buffer {i} has no data, {WANTED}")
            if _count(buffer["byteLength"]) > len(content):
                raise InputError(
                    f"{self.path}: buffer {i} promises {buffer['byteLength']} bytes, found {len(content)}"
                )
            buffers.append(content)
        self.num_bytes += sum({id(content): len(content) for content in buffers}.values())
        return buffers

    def _in_memory(self, buffers: list[bytes]) -> list[str]:
        """Names under which trimesh finds the buffers; no file has them, as ':' is refused there."""
        names = [f":{i}" for i in range(len(buffers))]
        self.beside.in_memory.update(zip(names, buffers, strict=True))
        return names

    def _check_views(self, buffers: list[bytes]) -> None:
        total = 0
        for i, view in enumerate(self.tree.get("bufferViews", [])):
            size = _count(view["byteLength"])
            if _count(view.get("byteOffset", 0)) + size > len(buffers[_count(view["buffer"])]):
                raise InputError(f"{self.path}: buffer view {i} lies outside its buffer, {WANTED}")
            total += size
        self._check_total(total)

    def _check_accessors(self) -> None:
        total, views = 0, self.tree.get("bufferViews", [])
        for i, accessor in enumerate(self.tree.get("accessors", [])):
            if "sparse" in accessor or "bufferView" not in accessor:
                raise InputError(f"{self.path}: accessor {i} is sparse or compressed, wanted plain data")
            row = BYTES_OF_TYPE[accessor["componentType"]] * NUM_OF_SHAPE[accessor["type"]]
            view = views[_count(accessor["bufferView"])]
            count = _count(accessor["count"])
            stride = _count(view.get("byteStride", row))
            needed = _count(accessor.get("byteOffset", 0)) + max(count - 1, 0) * stride + row
            if (count and needed > view["byteLength"]) or stride < row:
                raise InputError(
                    f"{self.path}: accessor {i} promises {count} rows of {row} bytes, its data have "
                    f"{view['byteLength']}; the file is cut off or broken"
                )
            total += count * row
        self._check_total(total)

    def _check_total(self, total: int) -> None:
        if total > MAX_SHARING * self.num_bytes:
            raise InputError(f"{self.path}: {total} bytes of data promised in {self.num_bytes}, {WANTED}")

    def _roots(self) -> list[int]:
        scenes = self.tree.get("scenes", [])
        if not scenes:
            return []
        return [_count(i) for i in scenes[_count(self.tree.get("scene", 0))].get("nodes", [])]

    def _check_nodes(self) -> None:
        """Refuse nodes that are no tree: they could stand for any number of meshes."""
        nodes, level, seen, depth = self.tree.get("nodes", []), self._roots(), set[int](), 0
        while level:
            if len(set(level)) < len(level) or seen.intersection(level):
                raise InputError(f"{self.path}: a node is named twice in its scene, {WANTED}")
            depth += 1
            if depth > MAX_DEPTH:
                raise InputError(f"{self.path}: over {MAX_DEPTH} nodes below each other, {WANTED}")
            seen.update(level)
            level = [_count(child) for i in level for child in nodes[i].get("children", [])]

    def _images(self, buffers: list[bytes]) -> list[Json]:
        """The images of base colours, checked; empty ones instead of all others."""
        textures = [_base(material).get("baseColorTexture") for material in self.tree.get("materials", [])]
        wanted = {self._image_row(texture) for texture in textures if texture}
        views = dict[int, bytes]()  # one copy, however many images share it
        kept: list[Json] = []
        for i, image in enumerate(self.tree.get("images", [])):
            if i not in wanted:
                kept.append({})
                continue
            name = f":image {i}"
            if "bufferView" in image:
                row = _count(image["bufferView"])
                view = self.tree["bufferViews"][row]
                start = view.get("byteOffset", 0)
                if row not in views:
                    views[row] = buffers[view["buffer"]][start : start + view["byteLength"]]
                content = views[row]
            else:
                content = self.beside.uri_content(image["uri"])
            check_image(self.path, f"of image {i}", content)
            self.beside.in_memory[name] = content
            kept.append({"uri": name})
        return kept

    def _material(self, material: Json) -> Material:
        base = _base(material)
        extensions = {
            *material.get("extensions", {}),
            *(base.get("baseColorTexture") or {}).get("extensions", {}),
        }
        for name in ("KHR_materials_pbrSpecularGlossiness", "KHR_texture_transform"):
            if name in extensions:
                raise InputError(f"{self.path}: a material uses {name}, wanted plain base colours")
        red, green, blue, _ = map(float, base.get("baseColorFactor", [1.0] * 4))
        if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
            raise InputError(f"{self.path}: a base colour of {red:g} {green:g} {blue:g}, wanted 0 to 1")
        return Material((red, green, blue), "baseColorTexture" in base)

    def _image_row(self, texture: Json) -> int:
        """Which image a material's texture shows."""
        given = self.tree["textures"][_count(texture["index"])]
        webp = given.get("extensions", {}).get("EXT_texture_webp", {})
        return _count(webp.get("source", given.get("source")))

    def _kept_material(self, i: int, material: Json) -> Json:
        texture = _base(material).get("baseColorTexture")
        base = {"baseColorTexture": {"index": self._image_row(texture)}} if texture else {}
        return {"name": str(i), "pbrMetallicRoughness": base}

    def _primitive(self, primitive: Json) -> Json | None:
        """A primitive with its positions, colours and the uv of its base colour; None for points, lines."""
        mode = primitive.get("mode", TRIANGLES)
        if mode == FAN:
            raise InputError(f"{self.path}: has triangle fans, wanted triangles")
        if mode not in (TRIANGLES, STRIP):
            return None
        given = primitive["attributes"]
        materials = self.tree.get("materials", [])
        row, material = len(materials), {}
        if "material" in primitive:
            row = _count(primitive["material"])
            material = materials[row]
        texture = _base(material).get("baseColorTexture") or {}
        names = {
            "POSITION": "POSITION",
            "TEXCOORD_0": f"TEXCOORD_{_count(texture.get('texCoord', 0))}",
            "COLOR_0": "COLOR_0",
        }
        attributes = {name: _count(given[source]) for name, source in names.items() if source in given}
        if not texture:
            attributes.pop("TEXCOORD_0", None)
        self._check_types(attributes)
        self._count_rows(attributes, primitive)
        kept = {"mode": mode, "attributes": attributes, "material": row}
        if "indices" in primitive:
            kept["indices"] = _count(primitive["indices"])
        return kept

    def _count_rows(self, attributes: dict[str, int], primitive: Json) -> None:
        """Refuse attributes of different lengths, and data that primitives share without end."""
        accessors = self.tree["accessors"]
        counts = {accessors[row]["count"] for row in attributes.values()}
        if len(counts) > 1:
            raise InputError(f"{self.path}: a primitive with {sorted(counts)} rows, wanted as many of each")
        rows = [_count(primitive["indices"])] if "indices" in primitive else []
        self.num_rows += sum(counts) + sum(accessors[row]["count"] for row in rows)
        if self.num_rows > max(MAX_ROWS, self.num_bytes):
            raise InputError(f"{self.path}: over {MAX_ROWS} vertices and indices in {self.num_bytes} bytes")

    def _check_types(self, attributes: dict[str, int]) -> None:
        wanted = {"POSITION": ({FLOAT}, {"VEC3"}), "TEXCOORD_0": ({FLOAT}, {"VEC2"})}
        for name, row in attributes.items():
            accessor = self.tree["accessors"][row]
            types, shapes = wanted.get(name, (NORMALIZED, {"VEC3", "VEC4"}))
            if accessor["componentType"] not in types or accessor["type"] not in shapes:
                raise InputError(
                    f"{self.path}: {name} of type {accessor['componentType']} {accessor['type']}, wanted "
                    f"float {' or '.join(sorted(shapes))}"
                )


def _count(value: object) -> int:
    """A number from JSON that must be whole and not negative."""
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{str(value)[:40]} where a count or an index is wanted")
    return value


def _base(material: Json) -> Json:
    base: Json = material.get("pbrMetallicRoughness", {})
    return base


def _kept_node(node: Json) -> Json:
    return {
        name: node[name]
        for name in ("mesh", "children", "matrix", "translation", "rotation", "scale")
        if name in node
    }
