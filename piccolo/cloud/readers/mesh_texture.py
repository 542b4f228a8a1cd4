"""Textures of meshes: images held to a size, and their texels."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...runtime.optional import import_optional

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
        images = import_optional(self.path, "PIL.Image")
        with own_limit(self.path):
            try:
                with images.open(BytesIO(self.content), formats=FORMATS) as image:
                    _check(self.path, image)
                    return np.asarray(image.convert("RGBA"))
            except InputError:
                raise
            except Exception as error:  # Pillow's decoders raise whatever their formats bring
                raise InputError(f"{self.path}: a texture can't be read ({first_line(error)})") from error


def texture_of(path: Path, image: Any) -> Texture | None:
    """The texture in an image that trimesh opened; None if it only stands for a missing one."""
    file = getattr(image, "fp", None)
    if file is None:
        return None
    _check(path, image)
    file.seek(0)
    return Texture(path, file.read())


@contextmanager
def own_limit(path: Path) -> Iterator[None]:
    """Lift Pillow's limit, which real textures exceed: MAX_TEXELS is held here before they are decoded."""
    images: Any = import_optional(path, "PIL.Image")
    limit = images.MAX_IMAGE_PIXELS
    images.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        images.MAX_IMAGE_PIXELS = limit


def check_image(path: Path, name: str, content: bytes) -> None:
    """Refuse what is no image, before trimesh passes over it."""
    images: Any = import_optional(path, "PIL.Image")
    with own_limit(path):
        try:
            with images.open(BytesIO(content), formats=FORMATS) as image:
                _check(path, image)
        except InputError:
            raise
        except Exception as error:  # as above
            raise InputError(f"{path}: the texture {name} can't be read ({first_line(error)})") from error


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
