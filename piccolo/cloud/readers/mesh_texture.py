"""Textures of meshes: images held to a size, and their texels."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...errors import InputError

MAX_TEXELS = 1 << 28  # 16,384 x 16,384: 1 GiB while it is looked up, three while it is decoded
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF")
MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"})  # 8 bits a channel or less


@dataclass(frozen=True)
class Texture:
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
