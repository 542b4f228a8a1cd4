"""The files that a mesh names: materials, buffers, and textures, which are images held to a size."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...errors import InputError

MAX_TEXELS = 1 << 28  # 16,384 x 16,384: 1 GiB while it is looked up, three while it is decoded
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF")
MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"})  # 8 bits a channel or less


class Texture(NamedTuple):
    """An image as it stands in its file: textures are decoded one at a time."""

    path: Path  # of the mesh
    content: bytes

    def texels(self) -> NDArray[np.uint8]:
        """Texels (H, W, 4) RGBA, the first row at the top."""
        with _image(self.path, "", self.content) as image:
            return np.asarray(image.convert("RGBA"))


def texture_of(path: Path, image: Any) -> Texture | None:
    """The texture in an image that trimesh opened; None if it only stands for a missing one."""
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


def check_image(path: Path, name: str, content: bytes) -> None:
    """Refuse what is no image, before trimesh passes over it."""
    with _image(path, f" {name}", content):
        pass


@contextmanager
def _image(path: Path, name: str, content: bytes) -> Iterator[Image.Image]:
    """An image of a size that is allowed; InputError if it can't be opened, or decoded by who uses it."""
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
    """The kind of an error and the beginning of what it says."""
    text = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {text[:100]!a}" if text else type(error).__name__


@dataclass
class FolderResolver:
    """The files in a mesh's own folder and below, and nothing else; a resolver for trimesh.

    trimesh goes on without a file that it can't get, so the first refusal is kept for later.
    """

    path: Path  # the mesh
    refusal: InputError | None = None
    _contents: dict[Path, bytes] = field(default_factory=dict)

    @property
    def num_bytes(self) -> int:
        """Bytes of all files read so far."""
        return sum(map(len, self._contents.values()))

    def get(self, name: str) -> bytes:
        """The content of a file, by the name that the mesh gives it."""
        folder, problem = self.path.parent.resolve(), ""
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
            self.refusal = self.refusal or refusal
            raise refusal
        return self._contents[file]

    __getitem__ = get
