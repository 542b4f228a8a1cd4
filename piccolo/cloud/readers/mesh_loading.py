"""Meshes read by trimesh, with checks, before and after, of faults that it ignores silently."""

import logging
import re
import warnings
from dataclasses import dataclass, field
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ...system.arrays import Array
from ...system.errors import InputError, import_optional
from ..settings import BY_FILE, CloudSettings
from . import mesh_files
from .mesh_files import GLB_MAGIC, NO_MATERIAL, FolderResolver, Material, Texture

WANTED = "wanted a mesh with textures, vertex colours or materials"
# faces whose indices count back from the last vertex, or are 0; trimesh would take wrong vertices
ODD_FACE = re.compile(rb"^f(?=[ \t])[^\n]*?[ \t/](?:-|0+[ \t/\r\n])", re.MULTILINE)
# trimesh knows a line by its very first letters and one space, and finds `usemtl` in comments too
ODD_STARTS = (
    (re.compile(rb"\\\r?\n"), b" "),  # a line that goes on in the next
    (re.compile(rb"\n[ \t]+"), b"\n"),
    (re.compile(rb"\n#[^\n]*"), b"\n"),
    (re.compile(rb"\n(v[tn]?|f|usemtl|mtllib)\t"), rb"\n\1 "),
)
LIBRARY_LINE = re.compile(rb"^[ \t]*mtllib[ \t]+(.*?)[ \t\r]*$", re.MULTILINE)
TEXTURE_LINE = re.compile(r"^[ \t]*map_Kd[ \t]+(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
TEXTURE_COMMENT = re.compile(r"TextureFile[ \t]*(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)

# Once, here: the filters are of the process, and no thread may change them.
# NumPy before 2.3 only warned where it stopped at what is no number.
warnings.filterwarnings("ignore", module=r"trimesh\.")
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else Python prints what nobody listens to
warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)


@dataclass(frozen=True)
class Loaded:
    """A file as trimesh loaded it."""

    path: Path
    scene: Any  # trimesh.Scene
    materials: list[Material] | None = None  # of glTF, named by their rows
    textures: dict[int, Texture | None] = field(default_factory=dict)  # by their images' identity
    settings: CloudSettings = BY_FILE
    notes: dict[str, None] = field(default_factory=dict)  # for the user, in order

    @property
    def is_gltf(self) -> bool:
        """True for glTF, whose colours are linear light and whose y is up."""
        return self.materials is not None

    def look_of(self, visual: Any) -> tuple[Texture | None, Array | None]:
        """Return the texture and the colour (1, 3) of a surface's material, by trimesh's description."""
        given: Any = getattr(visual, "material", None)
        if self.materials is None:
            has_color = "kd" in getattr(given, "kwargs", {})
            color: Array | None = np.array([given.diffuse[:3]], np.float64) / 255.0 if has_color else None
            return self._texture(getattr(given, "image", None)), color
        material = self.materials[int(given.name)]
        texture = self._texture(given.baseColorTexture)
        if material.texture is not None and (texture is None or visual.uv is None):
            raise InputError(f"{self.path}: a texture can't be read or its coordinates are missing, {WANTED}")
        return texture, None if material is NO_MATERIAL else np.array([material.factor])

    def _texture(self, image: Any) -> Texture | None:
        """Return the texture in an image, one object for all surfaces that share it."""
        if id(image) not in self.textures:
            self.textures[id(image)] = mesh_files.read_texture(self.path, image)
        return self.textures[id(image)]


def load_gltf(path: Path, content: bytes) -> Loaded:
    """Load a glTF or GLB file."""
    resolver = FolderResolver(path)
    sanitized, materials = mesh_files.sanitize_gltf(content, resolver)
    kind = "glb" if content.startswith(GLB_MAGIC) else "gltf"
    return Loaded(path, _scene(resolver, sanitized, kind), materials)


def load_obj(path: Path, content: bytes) -> Loaded:
    """Load an OBJ file with its materials."""
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("latin-1").encode()  # names in an older code
    content = b"\n" + content
    for odd_start, plain in ODD_STARTS:
        content = odd_start.sub(plain, content)
    odd = ODD_FACE.search(content)
    if odd:
        raise InputError(f"{path}: a face {odd[0][:40].decode('latin-1')!a}, wanted indices from 1 upwards")
    resolver = FolderResolver(path, is_lenient=True)
    names = set(LIBRARY_LINE.findall(content))
    if len(names) > 1:
        raise InputError(f"{path}: names {len(names)} files of materials, wanted one")
    for name in names:
        with resolver.noting():
            text = resolver.get(name.decode()).decode("utf-8", "replace")
            _check_textures(resolver, TEXTURE_LINE.findall(text))
    return Loaded(path, _scene(resolver, content, "obj"), notes=resolver.notes)


def _check_textures(resolver: FolderResolver, names: list[str]) -> None:
    """Refuse what is no image, which trimesh would ignore."""
    for name in sorted(set(names)):
        with resolver.noting(), mesh_files.open_image(resolver.path, resolver.get(name), f" {name[:100]!a}"):
            pass


def _with_raw_colors(parsed: dict[str, Any]) -> dict[str, Any]:
    """Make trimesh load colours as they are, without guessing their range or clipping them."""
    for mesh in (parsed, *parsed.get("geometry", {}).values()):
        if "faces" in mesh:
            mesh["process"] = False
        for kind in ("vertex", "face"):
            colors = mesh.pop(f"{kind}_colors", None)
            if colors is not None:
                mesh[f"{kind}_attributes" if "faces" in mesh else "metadata"] = {"color": colors}
    return parsed


def _scene(resolver: FolderResolver, content: bytes, kind: str, has_texture: bool = True) -> Any:
    trimesh = import_optional(resolver.path, "trimesh")
    try:
        with mesh_files.own_limit():
            # vertices are split by texture coordinates only if there is a texture: colours go by vertices
            options = {"fix_texture": has_texture} if kind == "ply" else {}
            load = trimesh.exchange.load.mesh_loaders[kind]
            parsed = load(BytesIO(content), resolver=resolver, **options)
            scene = trimesh.load_scene(_with_raw_colors(parsed))
    except (InputError, MemoryError):
        raise
    except Exception as error:  # whatever trimesh stumbles over
        if resolver.refusal is None:
            why = f"({mesh_files.first_line(error)}); the file may be damaged or cut off"
            raise InputError(f"{resolver.path}: trimesh can't read it {why}") from error
    if resolver.refusal is not None:
        raise resolver.refusal
    return scene


def load_ply(path: Path) -> Loaded:
    """Load a PLY file with faces."""
    content = path.read_bytes()
    resolver = FolderResolver(path)
    header = content.partition(b"end_header")[0].decode("utf-8", "replace")
    textures = TEXTURE_COMMENT.findall(header)
    if len(textures) > 1:
        raise InputError(f"{path}: names {len(textures)} textures, wanted one")
    _check_textures(resolver, textures)
    loaded = Loaded(path, _scene(resolver, content, "ply", bool(textures)))
    raw = [m.metadata["_ply_raw"] for m in loaded.scene.geometry.values() if "_ply_raw" in m.metadata]
    for elements, name in product(raw, ("vertex", "face")):
        data = elements[name].get("data")
        count = elements[name]["length"]
        columns = data.values() if isinstance(data, dict) else [data]
        found = min((len(column) for column in columns if column is not None), default=0)
        if found != count:
            raise InputError(f"{path}: the header promises {count} rows of '{name}', found {found}")
    return loaded
