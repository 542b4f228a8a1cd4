"""The JSON of a glTF file, changed so that trimesh reads it as the specification says.

By itself trimesh reads sparse and compressed data as zeros, does not scale whole numbers to fractions, knows
only one set of texture coordinates, rounds base colours to bytes, and gives random names to parts of a mesh.
"""

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

from ...system.errors import InputError

GLB_MAGIC = b"glTF"
WANTED = "wanted a whole glTF 2.0 mesh"
# extensions that a file may require, and extensions that would change colours but are not read
KNOWN_EXTENSIONS = frozenset({"KHR_materials_unlit", "EXT_texture_webp", "KHR_mesh_quantization"})
UNREAD_EXTENSIONS = frozenset({"KHR_materials_pbrSpecularGlossiness", "KHR_texture_transform"})
FLOAT = 5126
POINTS = 0
TRIANGLES = 4
TRIANGLE_STRIP = 5
FAN = 6

Json = dict[str, Any]


class Material(NamedTuple):
    """The base colour of a glTF material."""

    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)  # linear light, times the texture
    texture: Json | None = None  # the JSON that refers to it


NO_MATERIAL = Material()  # of primitives without a material; index 0 of the list of materials


def prepare_gltf(
    path: Path, content: bytes, read_file: Callable[[str], bytes]
) -> tuple[bytes, list[Material]]:
    """Return a glTF or GLB file reduced to triangles, base colours and nodes, and the list of its materials.

    The name of a material in the file is its index in the list. `read_file` returns the content of a file
    that this file names.
    """
    head, text, data = _split(path, content)
    try:
        tree = json.loads(text)
        _check_version(path, tree)
        _check_files(path, tree, read_file)
        materials = [NO_MATERIAL, *(_material(path, given) for given in tree.get("materials", []))]
        _keep_base_colors(tree, materials)
        _keep_triangles(path, tree, materials)
        _split_meshes(tree)
        for image in _name_files(tree["images"]):
            read_file(image["uri"])
        for node in tree.get("nodes", []):
            node.pop("camera", None)  # trimesh ignores the mesh of a node with a camera
            node.pop("name", None)  # trimesh before 5 mixes up nodes named "world"
        text = json.dumps(tree).encode()
    except InputError:
        raise
    except (AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f"{path}: broken JSON ({type(error).__name__}: {error}), {WANTED}") from error
    return head + (struct.pack("<I4s", len(text), b"JSON") if head else b"") + text + data, materials


def _split(path: Path, content: bytes) -> tuple[bytes, bytes, bytes]:
    """Return the head of a GLB file, its JSON, and the chunks after it; a glTF file is all JSON."""
    if not content.startswith(GLB_MAGIC):
        return b"", content, b""
    version, size, json_size = struct.unpack_from("<III", content.ljust(16, b"\0"), 4)
    if version != 2:
        raise InputError(f"{path}: GLB version {version}, {WANTED}")
    if len(content) < max(size, 20 + json_size):
        raise InputError(f"{path}: {len(content)} bytes of {max(size, 20 + json_size)}, {WANTED}")
    return content[:12], content[20 : 20 + json_size], content[20 + json_size : size]


def _check_version(path: Path, tree: Json) -> None:
    if str(tree["asset"]["version"]).partition(".")[0] != "2":
        raise InputError(f"{path}: glTF version {str(tree['asset']['version'])[:20]!a}, {WANTED}")
    unknown = set(tree.get("extensionsRequired", [])) - KNOWN_EXTENSIONS
    if unknown:
        names = ", ".join(sorted(unknown))
        raise InputError(f"{path}: requires the extensions {names[:100]!a}, wanted a plain glTF mesh")


def _check_files(path: Path, tree: Json, read_file: Callable[[str], bytes]) -> None:
    """Refuse buffers that are cut off, and data that trimesh would read as zeros."""
    for buffer in _name_files(tree.get("buffers", [])):
        num_bytes = len(read_file(buffer["uri"]))
        if num_bytes < buffer["byteLength"]:
            counts = f"has {num_bytes} of {buffer['byteLength']} bytes"
            raise InputError(f"{path}: the buffer {buffer['uri'][:100]!a} {counts}, {WANTED}")
    for i, accessor in enumerate(tree.get("accessors", [])):
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(f"{path}: accessor {i} is sparse or compressed, wanted plain data")


def _name_files(entries: list[Json]) -> Iterator[Json]:
    """Yield the entries that name files, with the names percent-decoded, which trimesh does not do."""
    for entry in entries:
        if not entry.get("uri", "data:").startswith("data:"):
            entry["uri"] = unquote(entry["uri"])
            yield entry


def _material(path: Path, material: Json) -> Material:
    """Return the base colour of a material."""
    base = material.get("pbrMetallicRoughness", {})
    texture = base.get("baseColorTexture")
    for name in UNREAD_EXTENSIONS & {*material.get("extensions", {}), *(texture or {}).get("extensions", {})}:
        raise InputError(f"{path}: a material uses {name}, wanted plain base colours")
    red, green, blue, _ = map(float, base.get("baseColorFactor", [1.0] * 4))
    return Material((red, green, blue), texture)


def _keep_base_colors(tree: Json, materials: list[Material]) -> None:
    """Remove all images but those of base colours; name materials by their index."""
    textures = [tree["textures"][m.texture["index"]] for m in materials if m.texture is not None]
    used = {t.get("extensions", {}).get("EXT_texture_webp", t)["source"] for t in textures}
    tree["images"] = [image if i in used else {} for i, image in enumerate(tree.get("images", []))]
    tree["materials"] = [
        {"name": str(i), "pbrMetallicRoughness": {"baseColorTexture": material.texture}}
        for i, material in enumerate(materials)
    ]


def _keep_triangles(path: Path, tree: Json, materials: list[Material]) -> None:
    """Remove all primitives but triangles, or all but points if there are no triangles."""
    meshes = tree.get("meshes", [])
    modes = {p.get("mode", TRIANGLES) for mesh in meshes for p in mesh["primitives"]}
    if FAN in modes:
        raise InputError(f"{path}: has triangle fans, wanted triangles")
    wanted = modes & {TRIANGLES, TRIANGLE_STRIP} or {POINTS}
    for mesh in meshes:
        chosen = [p for p in mesh["primitives"] if p.get("mode", TRIANGLES) in wanted]
        kept = [_primitive(path, tree["accessors"], materials, primitive) for primitive in chosen]
        mesh.clear()
        mesh["primitives"] = kept


def _primitive(path: Path, accessors: list[Json], materials: list[Material], primitive: Json) -> Json:
    """Return a primitive with only its positions, colours and texture coordinates of the base colour."""
    row = primitive["material"] + 1 if "material" in primitive else 0
    texture = materials[row].texture
    sources = {"POSITION": "POSITION", "COLOR_0": "COLOR_0"}
    if texture is not None:
        sources["TEXCOORD_0"] = f"TEXCOORD_{texture.get('texCoord', 0)}"  # trimesh reads only TEXCOORD_0
    given = primitive["attributes"]
    attributes = {name: given[source] for name, source in sources.items() if source in given}
    for name in attributes.keys() - {"COLOR_0"}:
        data = accessors[attributes[name]]
        if data["componentType"] != FLOAT and (name != "POSITION" or data.get("normalized")):
            raise InputError(f"{path}: {name} of whole numbers for fractions, wanted floats")
    kept = {name: primitive[name] for name in ("mode", "indices") if name in primitive}
    return kept | {"attributes": attributes, "material": row}


def _split_meshes(tree: Json) -> None:
    """Give each primitive a mesh and a node of its own: trimesh's names for those of one are random."""
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
