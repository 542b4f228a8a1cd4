"""The pixels in a JPEG, PNG, TIFF or WebP file, 8 bits a channel, turned as EXIF says.

The bytes are checked before they are decoded: OpenCV makes a grey half of a JPEG that is cut off, takes
memory for whatever size a header claims, and lets libjpeg, libpng and libtiff write to stderr.
"""

import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cloud.label_colors import Labels, colors_of
from ..errors import InputError
from . import jpeg, png, tiff, webp
from .header import WANTED, Header

MIN_WIDTH, MIN_HEIGHT = 128, 64
# 2^29 pixels: half of what OpenCV decodes by default (CV_IO_MAX_IMAGE_PIXELS, 2^30)
MAX_WIDTH, MAX_HEIGHT = 32768, 16384
MAX_PADDING = 0.01  # of a JPEG; some cameras leave a few bytes behind the picture
DAMAGE = re.compile(
    r"(?:TIFF_Error |JPEGLib: )?(Corrupt JPEG data: (?:(\d+) extraneous bytes)?.*|Premature end.*)"
)
TIFF_DAMAGE = re.compile(r"TIFF_Error (.*)")

# What a viewer does to the stored picture, by EXIF's number; 1 is as stored.
TURNS: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    2: np.fliplr,
    3: lambda image: np.rot90(image, 2),
    4: np.flipud,
    5: lambda image: np.swapaxes(image, 0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.swapaxes(np.rot90(image, 2), 0, 1),
    8: np.rot90,
}

_stderr_lock = threading.Lock()


@dataclass(frozen=True)
class Picture:
    """The pixels of a file, of any shape."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    is_valid: NDArray[np.bool_]  # (H, W), False where alpha is 0
    xmp: bytes = b""
    warnings: tuple[str, ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.rgb.shape[1], self.rgb.shape[0]


def read_picture(path: Path, min_size: tuple[int, int] = (MIN_WIDTH, MIN_HEIGHT)) -> Picture:
    """The picture in a file; grey becomes RGB, of 16 bits the upper 8 are kept (v >> 8).

    Raises
    ------
    InputError
        The file is missing or damaged, of no format read here, or its size is out of range.
    """
    data = _file_bytes(path)
    header = _header(path, data)
    _check_size(path, header, min_size)
    pixels = _decoded(path, data, header)
    rgb, is_valid = _split(pixels) if _keeps_all(header) else (pixels, np.ones(pixels.shape[:2], np.bool_))
    if header.orientation in TURNS:
        turn = TURNS[header.orientation]
        rgb, is_valid = np.ascontiguousarray(turn(rgb)), np.ascontiguousarray(turn(is_valid))
    return Picture(rgb, is_valid, header.xmp, header.warnings)


def read_labels(path: Path, labels: Labels) -> Picture:
    """The picture in a PNG file of labels, in their colours; of RGB, a label is R 65536 + G 256 + B.

    Raises
    ------
    InputError
        The file is missing or damaged, its size is out of range, or it is of no kind that keeps labels.
    """
    data = _file_bytes(path)
    header = _header(path, data)
    _check_size(path, header, (MIN_WIDTH, MIN_HEIGHT))
    if not (data.startswith(png.MAGIC) and png.keeps_labels(data)) or header.has_alpha:
        raise InputError(
            f"{path}: found another kind of picture, wanted labels in a PNG, grey of 8 or 16 bits or RGB of "
            "8, without alpha"
        )
    pixels = _decoded(path, data, replace(header, is_deep=True)).astype(np.int32)
    if pixels.ndim == 3:
        pixels = pixels[..., 2] << 16 | pixels[..., 1] << 8 | pixels[..., 0]
    if header.orientation in TURNS:
        pixels = np.ascontiguousarray(TURNS[header.orientation](pixels))
    return Picture(colors_of(pixels), labels.are_kept(pixels), header.xmp, header.warnings)


def _file_bytes(path: Path) -> bytes:
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file but a folder or a device, {WANTED}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}), {WANTED}") from error
    if not data:
        raise InputError(f"{path}: the file is empty, {WANTED}")
    return data


def _header(path: Path, data: bytes) -> Header:
    """What the bytes say of the picture, by the reader of the format that they begin with."""
    if data.startswith(png.MAGIC):
        return png.png_header(path, data)
    if data.startswith(jpeg.MAGIC):
        return jpeg.jpeg_header(path, data)
    if data.startswith(tiff.MAGICS):
        return tiff.tiff_header(path, data)
    if webp.has_webp_magic(data):
        return webp.webp_header(path, data)
    raise InputError(f"{path}: begins with {data[:8]!r}, {WANTED}")


def _check_size(path: Path, header: Header, min_size: tuple[int, int]) -> None:
    """Refuse sizes out of range, before memory is taken for them; the picture may yet be turned by 90 deg."""
    longer, shorter = max(header.width, header.height), min(header.width, header.height)
    found = f"{path}: found {header.width} x {header.height}"
    if longer < min_size[0] or shorter < min_size[1]:
        raise InputError(f"{found}, wanted at least {min_size[0]} x {min_size[1]}")
    if longer > MAX_WIDTH or shorter > MAX_HEIGHT:
        raise InputError(f"{found}, wanted at most {MAX_WIDTH} x {MAX_HEIGHT}")
    if longer * shorter > header.max_num_pixels:
        raise InputError(f"{found} in a file too small for it, {WANTED}")


@contextmanager
def _caught_stderr(messages: list[str]) -> Iterator[None]:
    """Append what C code writes to stderr meanwhile to `messages` instead.

    libjpeg and libpng write to the file descriptor, libtiff through OpenCV's log; there is no other way to
    hear that a picture was cut short.
    """
    with _stderr_lock, tempfile.TemporaryFile() as file:
        sys.stderr.flush()
        saved, level = os.dup(2), cv2.utils.logging.getLogLevel()
        try:
            os.dup2(file.fileno(), 2)
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_WARNING)
            yield
        finally:
            cv2.utils.logging.setLogLevel(level)
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            messages.append(file.read().decode("latin-1"))


def _decoded(path: Path, data: bytes, header: Header) -> NDArray[Any]:
    """The pixels as RGB (H, W, 3), uint8, or if `_keeps_all` as OpenCV leaves them, uint8 or uint16."""
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    flags = cv2.IMREAD_UNCHANGED if _keeps_all(header) else flags
    encoded = np.frombuffer(data, dtype=np.uint8)
    encoded = encoded.copy() if header.patches else encoded
    for place, patch in header.patches:
        encoded[place : place + len(patch)] = np.frombuffer(patch, dtype=np.uint8)
    messages: list[str] = []
    pixels = None
    with _caught_stderr(messages):
        try:
            pixels = cv2.imdecode(encoded, flags)
        except cv2.error as error:
            messages.append(str(error))
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: the picture can't be decoded, {WANTED}")
    for damage in DAMAGE.finditer(messages[0]):
        if not damage.group(2) or int(damage.group(2)) > MAX_PADDING * len(data):
            raise InputError(f"{path}: the picture is damaged ({damage.group(1).strip()}), {WANTED}")
    for damage in TIFF_DAMAGE.finditer(messages[0]):
        raise InputError(f"{path}: the picture is damaged ({damage.group(1).strip()}), {WANTED}")
    return np.asarray(pixels)


def _keeps_all(header: Header) -> bool:
    """True if alpha or the lower of 16 bits are to be decoded too."""
    return header.has_alpha or header.is_deep


def _split(pixels: NDArray[Any]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """RGB (H, W, 3), 8 bits, and where alpha is above 0 (H, W), of grey (H, W), BGR or BGRA."""
    has_alpha = pixels.ndim == 3 and pixels.shape[2] == 4
    is_valid = pixels[..., 3] > 0 if has_alpha else np.ones(pixels.shape[:2], dtype=np.bool_)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)), is_valid
    code = cv2.COLOR_BGRA2RGB if has_alpha else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(pixels, code)), is_valid
