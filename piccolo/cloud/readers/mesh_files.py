"""Files that a mesh names: materials, buffers, textures of limited size; and glTF before trimesh reads it.

trimesh raises an error where data of glTF are cut off. But it reads compressed or sparse data as zeros,
ignores what it doesn't know, and follows nodes and copies shared data without a limit: these are checked
here, and unread parts are removed from the JSON.
"""

import json
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from PIL import Image

from ...system.arrays import Bytes
from ...system.errors import InputError

# of a map in a material library, before the name of its file
MAP_OPTIONS = re.compile(r"^(?:-\w+(?:\s+(?:-?[\d.]+|on|off|[a-z]))*\s+)+", re.IGNORECASE)
MAX_TEXELS = 1 << 28  # 16,384 x 16,384: 1 GiB while it is looked up, three while it is decoded
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF")
MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"})  # 8 bits a channel or less
GLB_MAGIC = b"glTF"
WANTED = "wanted a whole glTF 2.0 mesh"
KNOWN_EXTENSIONS = frozenset(
    {"KHR_materials_unlit", "EXT_texture_webp", "KHR_mesh_quantization"}
)  # of those a file may require
UNREAD_EXTENSIONS = frozenset({"KHR_materials_pbrSpecularGlossiness", "KHR_texture_transform"})
MAX_NODE_DEPTH = 200  # nodes below each other: a chain of n costs n^2
MAX_ROWS = 20_000_000  # vertices and indices of all primitives; more only in a file of more bytes
MAX_SHARING = 4  # times that a byte may be part of an accessor, on average

BYTES_OF_TYPE = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
NUM_OF_SHAPE = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
FLOAT = 5126
POINTS = 0
TRIANGLES = 4
TRIANGLE_STRIP = 5
FAN = 6
COUNTS = {  # numbers that trimesh would count from the end if they were negative
    "bufferViews": ("buffer", "byteOffset", "byteLength", "byteStride"),
    "accessors": ("bufferView", "byteOffset", "count"),
    "images": ("bufferView",),
    "nodes": ("mesh",),
}

Json = dict[str, Any]


class Texture(NamedTuple):
    """An image, still encoded: textures are decoded one at a time."""

    path: Path  # of the mesh
    content: bytes

    def texels(self) -> Bytes:
        """Decode the texels (H, W, 4) RGBA, the first row at the top."""
        with open_image(self.path, self.content) as image:
            return np.asarray(image.convert("RGBA"))


def read_texture(path: Path, image: Any) -> Texture | None:
    """Return the texture in an image that trimesh opened; None for its placeholder of a missing image."""
    file = getattr(image, "fp", None)
    if file is None:
        return None
    _check(path, image)
    file.seek(0)
    return Texture(path, file.read())


@contextmanager
def own_limit() -> Iterator[None]:
    """Lift Pillow's limit, which real textures exceed: MAX_TEXELS is held here before they are decoded."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


@contextmanager
def open_image(path: Path, content: bytes, name: str = "") -> Iterator[Image.Image]:
    """Yield an image of an allowed size; InputError if it can't be opened, or decoded by the caller."""
    with own_limit():
        try:
            with Image.open(BytesIO(content), formats=FORMATS) as image:
                _check(path, image)
                yield image
        except (InputError, MemoryError):
            raise
        except Exception as error:  # Pillow's decoders raise whatever their formats bring
            raise InputError(f"{path}: the texture{name} can't be read ({first_line(error)})") from error


def _check(path: Path, image: Any) -> None:
    width, height = image.size
    if width * height > MAX_TEXELS:
        raise InputError(f"{path}: a texture of {width} x {height} texels, wanted at most {MAX_TEXELS}")
    if image.mode not in MODES:
        raise InputError(f"{path}: a texture of mode {image.mode}, wanted 8 bits a channel")


def first_line(error: BaseException) -> str:
    """Return the type of an error and the beginning of its message."""
    text = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {text[:100]!a}" if text else type(error).__name__


@dataclass
class FolderResolver:
    """The files in a mesh's own folder and below, and nothing else; a resolver for trimesh.

    trimesh continues without a file that it can't get, so the last refusal is kept for later.
    """

    path: Path  # the mesh
    is_lenient: bool = False  # a missing file costs its colours only
    refusal: InputError | None = None
    notes: dict[str, None] = field(default_factory=dict)  # of missing files, in order
    _contents: dict[Path, bytes] = field(default_factory=dict)

    @property
    def num_bytes(self) -> int:
        """Bytes of all files read so far."""
        return sum(map(len, self._contents.values()))

    def get(self, name: str) -> bytes:
        """Return the content of a file by the name that the mesh gives it, or else of the one beside it.

        Of its name, capitals don't count then.
        """
        folder = self.path.parent.resolve()
        problem = ""
        name = MAP_OPTIONS.sub("", name.strip())
        last = name.replace("\\", "/").rpartition("/")[2].lower()
        beside = [entry.name for entry in folder.iterdir() if entry.name.lower() == last]
        if len(beside) == 1 and not (folder / name.replace("\\", "/")).is_file():
            name = beside[0]
        try:
            file = (folder / name.strip().replace("\\", "/")).resolve()  # names may be written on Windows
            if ":" in name or not file.is_relative_to(folder):  # ':' of a drive or a URL
                problem = ", wanted names in the mesh's own folder or below"
            elif not file.is_file():
                problem = ", which is not in its folder"
            elif file not in self._contents:
                self._contents[file] = file.read_bytes()
        except (OSError, ValueError, RuntimeError) as error:
            problem = f" ({error})"
        if problem:
            refusal = InputError(f"{self.path}: names the file {name[:100]!a}{problem}")
            self.refusal = None if self.is_lenient else refusal
            self.notes[f"{refusal}; its colours are missing"] = None
            raise refusal
        return self._contents[file]

    __getitem__ = get

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Within this, a missing file ends the block, with a note, if that costs colours only."""
        num_notes = len(self.notes)
        try:
            yield
        except InputError:
            if not self.is_lenient or len(self.notes) == num_notes:
                raise


class Material(NamedTuple):
    """The base colour of a glTF material."""

    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)  # linear light
    texture: Json | None = None


NO_MATERIAL = Material()  # of primitives without one, the first of all


def sanitize_gltf(content: bytes, resolver: FolderResolver) -> tuple[bytes, list[Material]]:
    """Return a checked glTF or GLB file with triangles, base colours and nodes only, and its materials.

    In the file the materials are named by their index in the list.
    """
    path = resolver.path
    is_glb = content.startswith(GLB_MAGIC)
    head, text, data = _glb_parts(path, content) if is_glb else (b"", content, b"")
    try:
        tree = json.loads(text)
        _check_version(path, tree)
        for buffer, found in _read_files(tree.get("buffers", []), resolver):
            if len(found) < _count(buffer["byteLength"]):
                counts = f"has {len(found)} of {buffer['byteLength']} bytes"
                raise InputError(f"{path}: the buffer {buffer['uri'][:100]!a} {counts}, {WANTED}")
        num_bytes = len(content) + resolver.num_bytes
        _check_data(path, tree, num_bytes)
        _check_nodes(path, tree)
        materials = [NO_MATERIAL, *(_material(path, given) for given in tree.get("materials", []))]
        _keep_base_colors(tree, materials)
        _keep_triangles(path, tree, materials, num_bytes)
        _split_meshes(tree)
        list(_read_files(tree["images"], resolver))
        for node in tree.get("nodes", []):
            node.pop("camera", None)  # with which trimesh passes over the node's mesh
            node.pop("name", None)  # trimesh before 5 mixes up nodes named "world"
        text = json.dumps(tree).encode()
    except InputError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f"{path}: broken JSON ({first_line(error)}), {WANTED}") from error
    return head + (struct.pack("<I4s", len(text), b"JSON") if head else b"") + text + data, materials


def _glb_parts(path: Path, content: bytes) -> tuple[bytes, bytes, bytes]:
    """Return the head of a GLB file, its JSON, and the chunks after it."""
    version, size, json_size, kind = struct.unpack_from("<III4s", content.ljust(20, b"\0"), 4)
    if size > len(content) or 20 + json_size > size:
        raise InputError(f"{path}: {len(content)} bytes of {max(size, 20 + json_size)}, {WANTED}")
    if version != 2 or kind != b"JSON":
        raise InputError(f"{path}: GLB version {version}, first part {kind!r}, {WANTED}")
    return content[:12], content[20 : 20 + json_size], content[20 + json_size : size]


def _check_version(path: Path, tree: Json) -> None:
    if str(tree["asset"]["version"]).partition(".")[0] != "2":
        raise InputError(f"{path}: glTF version {str(tree['asset']['version'])[:20]!a}, {WANTED}")
    unknown = set(tree.get("extensionsRequired", [])) - KNOWN_EXTENSIONS
    if unknown:
        names = ", ".join(sorted(map(str, unknown)))
        raise InputError(f"{path}: requires the extensions {names[:100]!a}, wanted a plain glTF mesh")


def _read_files(entries: list[Json], resolver: FolderResolver) -> Iterator[tuple[Json, bytes]]:
    """Yield the entries that name files, with these; decode the names, which trimesh does not."""
    for entry in entries:
        if not entry.get("uri", "data:").startswith("data:"):
            entry["uri"] = unquote(entry["uri"])
            yield entry, resolver[entry["uri"]]


def _check_data(path: Path, tree: Json, num_bytes: int) -> None:
    """Refuse data that trimesh would read as zeros, index from the end or copy without a limit."""
    for kind, names in COUNTS.items():
        for entry in tree.get(kind, []):
            for name in entry.keys() & names:
                _count(entry[name])
    views = tree.get("bufferViews", [])
    accessors = tree.get("accessors", [])
    size = 0
    for i, accessor in enumerate(accessors):
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(f"{path}: accessor {i} is sparse or compressed, wanted plain data")
        row = BYTES_OF_TYPE[accessor["componentType"]] * NUM_OF_SHAPE[accessor["type"]]
        stride = views[accessor["bufferView"]].get("byteStride", row)
        if stride < row:
            raise InputError(f"{path}: accessor {i} has rows of {row} bytes, {stride} bytes apart, {WANTED}")
        size += accessor["count"] * row
    size = max(size, sum(view["byteLength"] for view in views))
    if size > MAX_SHARING * num_bytes:
        raise InputError(f"{path}: {size} bytes of data promised in {num_bytes}, {WANTED}")


def _check_nodes(path: Path, tree: Json) -> None:
    """Refuse nodes that form no tree: they could place any number of meshes."""
    scenes = tree.get("scenes", [])
    nodes = tree.get("nodes", [])
    seen = set[int]()
    level = scenes[_count(tree.get("scene", 0))].get("nodes", []) if scenes else []
    for _ in range(MAX_NODE_DEPTH):
        num_seen = len(seen)
        seen.update(level)
        if len(seen) < num_seen + len(level):
            raise InputError(f"{path}: a node is named twice in its scene, {WANTED}")
        level = [child for i in level for child in nodes[_count(i)].get("children", [])]
    if level:
        raise InputError(f"{path}: over {MAX_NODE_DEPTH} nodes below each other, {WANTED}")


def _material(path: Path, material: Json) -> Material:
    """Return the base colour of a material."""
    base = material.get("pbrMetallicRoughness", {})
    texture = base.get("baseColorTexture")
    for name in UNREAD_EXTENSIONS & {*material.get("extensions", {}), *(texture or {}).get("extensions", {})}:
        raise InputError(f"{path}: a material uses {name}, wanted plain base colours")
    red, green, blue, _ = map(float, base.get("baseColorFactor", [1.0] * 4))
    if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
        raise InputError(f"{path}: a base colour of {red:g} {green:g} {blue:g}, wanted 0 to 1")
    return Material((red, green, blue), texture)


def _keep_base_colors(tree: Json, materials: list[Material]) -> None:
    """Remove all images but those of base colours; name materials by their index."""
    shown = [tree["textures"][_count(m.texture["index"])] for m in materials if m.texture is not None]
    used = {_count(t.get("extensions", {}).get("EXT_texture_webp", t)["source"]) for t in shown}
    tree["images"] = [image if i in used else {} for i, image in enumerate(tree.get("images", []))]
    tree["materials"] = [
        {"name": str(i), "pbrMetallicRoughness": {"baseColorTexture": material.texture}}
        for i, material in enumerate(materials)
    ]


def _keep_triangles(path: Path, tree: Json, materials: list[Material], num_bytes: int) -> None:
    """Remove all primitives but those of triangles, or points if there are no triangles.

    Data that too many of them share are refused.
    """
    accessors = tree.get("accessors", [])
    num_rows = 0
    meshes = tree.get("meshes", [])
    modes = {p.get("mode", TRIANGLES) for mesh in meshes for p in mesh["primitives"]}
    wanted = modes & {TRIANGLES, TRIANGLE_STRIP, FAN} or {POINTS}
    for mesh in meshes:
        shown = [p for p in mesh["primitives"] if p.get("mode", TRIANGLES) in wanted]
        kept = [_primitive(path, accessors, materials, primitive) for primitive in shown]
        mesh.clear()
        mesh["primitives"] = kept
        rows = [p["attributes"]["POSITION"] for p in kept] + [p["indices"] for p in kept if "indices" in p]
        num_rows += sum(accessors[row]["count"] for row in rows)
    if num_rows > max(MAX_ROWS, num_bytes):
        raise InputError(f"{path}: over {MAX_ROWS} vertices and indices in {num_bytes} bytes")


def _split_meshes(tree: Json) -> None:
    """Place each primitive by a node of its own: trimesh names those of one mesh by chance, some alike."""
    parts: list[Json] = []
    nodes: list[Json] = tree.get("nodes", [])
    splits: list[list[int]] = []
    for mesh in tree.get("meshes", []):
        splits.append([*range(len(parts), len(parts) + len(mesh["primitives"]))])
        parts += [{"primitives": [primitive]} for primitive in mesh["primitives"]]
    for node in nodes[:]:
        if "mesh" in node:
            added = [{"mesh": part} for part in splits[node.pop("mesh")]]
            node["children"] = [*node.get("children", []), *range(len(nodes), len(nodes) + len(added))]
            nodes += added
    tree["meshes"] = parts


def _primitive(path: Path, accessors: list[Json], materials: list[Material], primitive: Json) -> Json:
    """Return a primitive with only its positions, colours and the base colour's uv."""
    if primitive.get("mode") == FAN:
        raise InputError(f"{path}: has triangle fans, wanted triangles")
    row = _count(primitive["material"]) + 1 if "material" in primitive else 0
    texture = materials[row].texture
    sources = {"POSITION": "POSITION", "COLOR_0": "COLOR_0"}
    if texture is not None:
        sources["TEXCOORD_0"] = f"TEXCOORD_{texture.get('texCoord', 0)}"  # the only one that trimesh reads
    given = primitive["attributes"]
    attributes = {name: _count(given[source]) for name, source in sources.items() if source in given}
    counts = {accessors[i]["count"] for i in attributes.values()}
    if len(counts) > 1:
        raise InputError(f"{path}: a primitive with {sorted(counts)} rows, wanted as many of each")
    for name in attributes.keys() - {"COLOR_0"}:
        data = accessors[attributes[name]]
        if data["componentType"] != FLOAT and (name != "POSITION" or data.get("normalized")):
            raise InputError(f"{path}: {name} of whole numbers for fractions, wanted floats")
    kept = {name: _count(primitive[name]) for name in ("mode", "indices") if name in primitive}
    return kept | {"attributes": attributes, "material": row}


def _count(value: object) -> int:
    """Check that a number from JSON is whole and not negative, and return it; else ValueError."""
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{str(value)[:40]} where a count or an index is wanted")
    return value
