"""Meshes read by trimesh, with the files that they name, and checks for faults that trimesh ignores."""

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from itertools import product
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from ...system.arrays import Array, Bytes
from ...system.errors import InputError, import_optional
from ..cloud_settings import BY_FILE, CloudSettings
from .gltf import GLB_MAGIC, NO_MATERIAL, Material, prepare_gltf

WANTED = "wanted a mesh with textures, vertex colours or materials"
# faces with an index that is 0 or counts back from the last vertex: trimesh would take wrong vertices
ODD_FACE = re.compile(rb"^f(?=[ \t])[^\n]*?[ \t/](?:-|0+[ \t/\r\n])", re.MULTILINE)
# trimesh wants each keyword at the very beginning of a line, and one space after it; it reads comments too
ODD_STARTS = (
    (re.compile(rb"\\\r?\n"), b" "),  # a line that continues on the next
    (re.compile(rb"\n[ \t]+"), b"\n"),
    (re.compile(rb"\n#[^\n]*"), b"\n"),
    (re.compile(rb"\n(v[tn]?|f|usemtl|mtllib)\t"), rb"\n\1 "),
)
LIBRARY_LINE = re.compile(rb"^[ \t]*mtllib[ \t]+(.*?)[ \t\r]*$", re.MULTILINE)
TEXTURE_LINE = re.compile(r"^[ \t]*map_Kd[ \t]+(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
# options of a map in a material library, before the name of its file
MAP_OPTIONS = re.compile(r"^(?:-\w+(?:\s+(?:-?[\d.]+|on|off|[a-z]))*\s+)+", re.IGNORECASE)
TEXTURE_COMMENT = re.compile(r"TextureFile[ \t]*(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
MAX_TEXELS = 1 << 28  # 16,384 x 16,384: takes 1 GiB in use, and 3 GiB while it is decoded
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF")
MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"})  # 8 bits a channel or less

# Filters are the process's, so they are set once, here, and not by threads.
warnings.filterwarnings("ignore", module=r"trimesh\.")
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else Python prints trimesh's messages
# NumPy before 2.3 only warns if it stops at a text that is not a number
warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)


class Texture(NamedTuple):
    """A texture as an image file in memory; textures are decoded one at a time."""

    path: Path  # of the mesh
    content: bytes

    def texels(self) -> Bytes:
        """Decode the texels (H, W, 4) RGBA, the first row at the top."""
        with open_image(self.path, self.content) as image:
            return np.asarray(image.convert("RGBA"))


@contextmanager
def own_limit() -> Iterator[None]:
    """Lift Pillow's limit of the size, which real textures exceed; `check_image` has a larger one."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


@contextmanager
def open_image(path: Path, content: bytes, name: str = "") -> Iterator[Image.Image]:
    """Yield an image of an allowed size. Raise InputError if it, or the block's use of it, fails."""
    with own_limit():
        try:
            with Image.open(BytesIO(content), formats=FORMATS) as image:
                check_image(path, image)
                yield image
        except (InputError, MemoryError):
            raise
        except Exception as error:  # Pillow's decoders raise errors of many kinds
            raise InputError(f"{path}: the texture{name} can't be read ({first_line(error)})") from error


def check_image(path: Path, image: Image.Image) -> None:
    """Refuse a texture that is too large, or has more than 8 bits a channel."""
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
class FileFinder:
    """A finder of the files that a mesh names, which trimesh uses as its resolver.

    trimesh goes on without a file that it can't get, so the last error is kept, to be raised later.
    """

    path: Path  # of the mesh
    is_lenient: bool = False  # a missing file is no error: only its colours are missing
    refusal: InputError | None = None  # the last error
    notes: dict[str, None] = field(default_factory=dict)  # on missing files, in order

    def get(self, name: str) -> bytes:
        """Return the content of the file that a mesh names.

        If there is none at the named place, a file of that name in the mesh's folder is taken, whatever its
        capitals.
        """
        folder = self.path.parent
        name = MAP_OPTIONS.sub("", name.strip()).strip()
        last = PureWindowsPath(name).name.lower()  # names may be written on Windows
        try:
            alike = [entry for entry in folder.iterdir() if entry.name.lower() == last]
            files = [folder / name.replace("\\", "/"), *(alike if len(alike) == 1 else [])]
            return next(file for file in files if file.is_file()).read_bytes()
        except (OSError, ValueError, StopIteration) as error:
            why = ", which is not in its folder" if isinstance(error, StopIteration) else f" ({error})"
            refusal = InputError(f"{self.path}: names the file {name[:100]!a}{why}")
            self.refusal = None if self.is_lenient else refusal
            self.notes[f"{refusal}; its colours are missing"] = None
            raise refusal from error

    __getitem__ = get

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Suppress the block's InputError if it is of a missing file and the finder is lenient."""
        num_notes = len(self.notes)
        try:
            yield
        except InputError:
            if not self.is_lenient or len(self.notes) == num_notes:
                raise


@dataclass(frozen=True)
class Loaded:
    """A file as trimesh loaded it."""

    path: Path
    parts: dict[str, Any]  # meshes and points of trimesh, by name
    nodes: list[tuple[Array, str]]  # (4, 4) by which the scene places a part, and the part's name
    materials: list[Material] | None = None  # of glTF, whose names are their indices; None for others
    textures: dict[int, Texture | None] = field(default_factory=dict)  # by the `id` of trimesh's image
    settings: CloudSettings = BY_FILE
    notes: dict[str, None] = field(default_factory=dict)  # for the user, in order

    @property
    def is_gltf(self) -> bool:
        """True for glTF, whose colours are linear light and whose y is up."""
        return self.materials is not None

    def look_of(self, visual: Any) -> tuple[Texture | None, Array | None]:
        """Return the texture and the colour (1, 3) of a surface's material; `visual` is trimesh's."""
        of_trimesh: Any = getattr(visual, "material", None)
        if self.materials is None:
            has_color = "kd" in getattr(of_trimesh, "kwargs", {})
            color: Array | None = None
            if has_color:
                color = np.array([of_trimesh.diffuse[:3]], np.float64) / 255.0
            return self._texture(getattr(of_trimesh, "image", None)), color
        material = self.materials[int(of_trimesh.name)]
        texture = self._texture(of_trimesh.baseColorTexture)
        if material.texture is not None and (texture is None or visual.uv is None):
            raise InputError(f"{self.path}: a texture can't be read or its coordinates are missing, {WANTED}")
        return texture, None if material is NO_MATERIAL else np.array([material.factor])

    def _texture(self, image: Any) -> Texture | None:
        """Return the texture of trimesh's image, the same object for all surfaces that share it."""
        if id(image) not in self.textures:
            file = getattr(image, "fp", None)  # trimesh has a placeholder for a missing image
            if file is not None:
                check_image(self.path, image)
                file.seek(0)
            self.textures[id(image)] = None if file is None else Texture(self.path, file.read())
        return self.textures[id(image)]


def load_gltf(path: Path, content: bytes) -> Loaded:
    """Load a glTF or GLB file."""
    finder = FileFinder(path)
    prepared, materials = prepare_gltf(path, content, finder.get)
    kind = "glb" if content.startswith(GLB_MAGIC) else "gltf"
    return Loaded(path, *_load(finder, prepared, kind), materials)


def load_obj(path: Path, content: bytes) -> Loaded:
    """Load an OBJ file with its materials."""
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("latin-1").encode()  # names in an older encoding
    content = b"\n" + content
    for odd_start, plain in ODD_STARTS:
        content = odd_start.sub(plain, content)
    odd = ODD_FACE.search(content)
    if odd:
        raise InputError(f"{path}: a face {odd[0][:40].decode('latin-1')!a}, wanted indices from 1 upwards")
    finder = FileFinder(path, is_lenient=True)
    names = set(LIBRARY_LINE.findall(content))
    if len(names) > 1:
        raise InputError(f"{path}: names {len(names)} files of materials, wanted one")
    for name in names:
        with finder.noting():
            text = finder.get(name.decode()).decode("utf-8", "replace")
            _check_textures(finder, TEXTURE_LINE.findall(text))
    return Loaded(path, *_load(finder, content, "obj"), notes=finder.notes)


def _check_textures(finder: FileFinder, names: list[str]) -> None:
    """Refuse textures that are not images, which trimesh would ignore."""
    for name in sorted(set(names)):
        with finder.noting(), open_image(finder.path, finder.get(name), f" {name[:100]!a}"):
            pass


def _with_raw_colors(parsed: dict[str, Any]) -> dict[str, Any]:
    """Change what trimesh has parsed so that it keeps colours as they are: it would guess ranges and clip."""
    for mesh in (parsed, *parsed.get("geometry", {}).values()):
        if "faces" in mesh:
            mesh["process"] = False
        for kind in ("vertex", "face"):
            colors = mesh.pop(f"{kind}_colors", None)
            if colors is not None:
                mesh[f"{kind}_attributes" if "faces" in mesh else "metadata"] = {"color": colors}
    return parsed


def _load(
    finder: FileFinder, content: bytes, kind: str, has_texture: bool = True
) -> tuple[dict[str, Any], list[tuple[Array, str]]]:
    """Return the parts of a file by name, and for each node of its scene a matrix and a part's name."""
    trimesh = import_optional(finder.path, "trimesh")
    try:
        with own_limit():
            # vertices are split by texture coordinates only if there is a texture: colours are by vertex
            options = {"fix_texture": has_texture} if kind == "ply" else {}
            load = trimesh.exchange.load.mesh_loaders[kind]
            parsed = load(BytesIO(content), resolver=finder, **options)
            scene = trimesh.load_scene(_with_raw_colors(parsed))
            nodes = [scene.graph.get(node) for node in scene.graph.nodes_geometry]
    except (InputError, MemoryError):
        raise
    except Exception as error:  # trimesh raises errors of many kinds
        if finder.refusal is None:
            why = f"({first_line(error)}); the file may be damaged or cut off"
            raise InputError(f"{finder.path}: trimesh can't read it {why}") from error
    if finder.refusal is not None:
        raise finder.refusal
    # not sorted by the nodes' names, some of which trimesh makes up at random
    return scene.geometry, sorted(nodes, key=lambda node: (node[1], node[0].tobytes()))


def load_ply(path: Path) -> Loaded:
    """Load a PLY file with faces."""
    content = path.read_bytes()
    finder = FileFinder(path)
    header = content.partition(b"end_header")[0].decode("utf-8", "replace")
    textures = TEXTURE_COMMENT.findall(header)
    if len(textures) > 1:
        raise InputError(f"{path}: names {len(textures)} textures, wanted one")
    _check_textures(finder, textures)
    loaded = Loaded(path, *_load(finder, content, "ply", bool(textures)))
    raw = [part.metadata["_ply_raw"] for part in loaded.parts.values() if "_ply_raw" in part.metadata]
    for elements, name in product(raw, ("vertex", "face")):
        data = elements[name].get("data")
        count = elements[name]["length"]
        columns = data.values() if isinstance(data, dict) else [data]
        num_rows = min((len(column) for column in columns if column is not None), default=0)
        if num_rows != count:
            raise InputError(f"{path}: the header promises {count} rows of '{name}', found {num_rows}")
    return loaded
