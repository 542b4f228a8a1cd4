"""Reading equirectangular panoramas from JPEG and PNG files.

The bytes are checked before they are decoded: OpenCV makes a grey half of a JPEG that is cut off, takes
memory for whatever size a header claims, and lets libjpeg and libpng write to stderr.
"""

import os
import re
import struct
import sys
import tempfile
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import InputError

MIN_WIDTH, MIN_HEIGHT = 128, 64
MAX_WIDTH, MAX_HEIGHT = 32768, 16384
ASPECT_TOLERANCE = 0.01
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8"
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
MAX_PNG_RATIO = 1040  # zlib packs 1032 bytes into one at best
MAX_JPEG_RATIO = 512  # pixels a byte: one bit for a block of 8 x 8
MAX_PADDING = 0.01  # of a JPEG; some cameras leave a few bytes behind the picture
# The end of a JPEG's scan: a marker other than a stuffed FF 00, a restart or a filling FF.
SCAN_END = re.compile(rb"\xff[\x01-\xcf\xd8-\xfe]")
JPEG_DAMAGE = re.compile(r"(Corrupt JPEG data: (?:(\d+) extraneous bytes)?.*|Premature end.*)")
WANTED = "wanted a whole JPEG or PNG panorama"

_stderr_lock = threading.Lock()


@dataclass(frozen=True)
class Panorama:
    """A full equirectangular picture, W = 2 H."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    is_valid: NDArray[np.bool_]  # (H, W), False where the picture shows nothing


@dataclass(frozen=True)
class PictureHeader:
    """What a picture's bytes say of it, before anything is decoded."""

    width: int
    height: int
    max_num_pixels: int  # that so many bytes can hold
    exif_chunk: bytes = b""  # PNG only, with its length and checksum
    has_alpha: bool = False


def read_panorama(path: Path) -> Panorama:
    """The panorama in a JPEG or PNG file, turned as its EXIF orientation says, 8 bits a channel.

    Grey becomes RGB; pixels of alpha 0 are not valid. A picture within 1 % of W = 2 H is shrunk to that.

    Raises
    ------
    InputError
        The file is missing or damaged, no JPEG or PNG, or not 2:1, or its size is out of range.
    """
    path = Path(path)
    data = _file_bytes(path)
    if data.startswith(PNG_MAGIC):
        header = _png_header(path, data)
    elif data.startswith(JPEG_MAGIC):
        header = _jpeg_header(path, data)
    else:
        raise InputError(f"{path}: begins with {data[:8]!r}, {WANTED}")
    _check_size(path, header)
    rgb = _decoded(path, data, cv2.IMREAD_COLOR_RGB)
    is_valid = _alpha(path, data, header) > 0 if header.has_alpha else np.ones(rgb.shape[:2], dtype=np.bool_)
    return _two_to_one(path, rgb, is_valid)


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


def _png_header(path: Path, data: bytes) -> PictureHeader:
    """The size in the first chunk, once all chunks' checksums are found right and the last chunk is there."""
    chunks: dict[bytes, bytes] = {}
    begin = len(PNG_MAGIC)
    while b"IEND" not in chunks:
        if begin + 12 > len(data):
            raise InputError(f"{path}: the PNG ends without its last chunk (cut off?), {WANTED}")
        (length,) = struct.unpack_from(">I", data, begin)
        kind, end = data[begin + 4 : begin + 8], begin + 12 + length
        if data[end - 4 : end] != struct.pack(">I", zlib.crc32(data[begin + 4 : end - 4])):
            raise InputError(f"{path}: wrong checksum in the PNG's chunk {kind!r} (cut off?), {WANTED}")
        chunks[kind] = data[begin:end] if kind in (b"IHDR", b"eXIf") else b""
        begin = end
    if next(iter(chunks)) != b"IHDR" or len(chunks[b"IHDR"]) != 25:
        raise InputError(f"{path}: the PNG does not begin with its header, {WANTED}")
    width, height, depth, color_type = struct.unpack_from(">IIBB", chunks[b"IHDR"], 8)
    bits = depth * PNG_CHANNELS.get(color_type, 1)
    max_num_pixels = len(data) * MAX_PNG_RATIO * 8 // max(bits, 1)
    has_alpha = color_type in (4, 6) or b"tRNS" in chunks
    return PictureHeader(width, height, max_num_pixels, chunks.get(b"eXIf", b""), has_alpha)


def _jpeg_header(path: Path, data: bytes) -> PictureHeader:
    """The size in the frame's header, once all segments are walked through to the end of the picture."""
    size: tuple[int, int] | None = None
    begin = len(JPEG_MAGIC)
    while begin + 4 <= len(data) and data[begin] == 0xFF:
        marker = data[begin + 1]
        (length,) = struct.unpack_from(">H", data, begin + 2)
        if marker == 0xFF:
            begin += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and begin + 9 <= len(data):
            size = struct.unpack_from(">HH", data, begin + 5)
        begin += 2 + length
        if marker == 0xDA:
            scan_end = SCAN_END.search(data, begin)
            begin = scan_end.start() if scan_end else len(data)
        if data[begin : begin + 2] == b"\xff\xd9" and size:
            return PictureHeader(size[1], size[0], len(data) * MAX_JPEG_RATIO)
    raise InputError(f"{path}: the JPEG ends without its end mark (cut off?), {WANTED}")


def _check_size(path: Path, header: PictureHeader) -> None:
    """Refuse sizes out of range, before memory is taken for them; the picture may yet be turned by 90 deg."""
    longer, shorter = max(header.width, header.height), min(header.width, header.height)
    found = f"{path}: found {header.width} x {header.height}"
    if longer < MIN_WIDTH or shorter < MIN_HEIGHT:
        raise InputError(f"{found}, wanted at least {MIN_WIDTH} x {MIN_HEIGHT}")
    if longer > MAX_WIDTH or shorter > MAX_HEIGHT:
        raise InputError(f"{found}, wanted at most {MAX_WIDTH} x {MAX_HEIGHT}")
    if longer * shorter > header.max_num_pixels:
        raise InputError(f"{found} in a file too small for it, {WANTED}")


@contextmanager
def _caught_stderr(messages: list[str]) -> Iterator[None]:
    """Append what C code writes to stderr meanwhile to `messages` instead.

    libjpeg and libpng write to the file descriptor; there is no other way to hear that a scan was cut short.
    """
    with _stderr_lock, tempfile.TemporaryFile() as file:
        sys.stderr.flush()
        saved = os.dup(2)
        try:
            os.dup2(file.fileno(), 2)
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            messages.append(file.read().decode("latin-1"))


def _decoded(path: Path, data: bytes, flags: int) -> NDArray[np.uint8]:
    """The pixels as OpenCV decodes them; IMREAD_UNCHANGED alone leaves the EXIF orientation aside."""
    messages: list[str] = []
    pixels = None
    with _caught_stderr(messages):
        try:
            pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
        except cv2.error as error:
            messages.append(str(error))
    if pixels is None:
        raise InputError(f"{path}: the picture can't be decoded, {WANTED}")
    for damage in JPEG_DAMAGE.finditer(messages[0]):
        if not damage.group(2) or int(damage.group(2)) > MAX_PADDING * len(data):
            raise InputError(f"{path}: the picture is damaged ({damage.group(1).strip()}), {WANTED}")
    return np.asarray(pixels)


def _alpha(path: Path, data: bytes, header: PictureHeader) -> NDArray[np.uint8]:
    """Alpha (H, W) of a PNG, turned as the colours are.

    OpenCV gives alpha only unturned, so where there is EXIF it travels through OpenCV again, as a grey PNG
    with the same EXIF chunk.
    """
    pixels = _decoded(path, data, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        return np.full(pixels.shape[:2], 255, dtype=np.uint8)
    alpha = np.where(pixels[:, :, 3] > 0, 255, 0).astype(np.uint8)
    if not header.exif_chunk:
        return alpha
    png = cv2.imencode(".png", alpha)[1].tobytes()
    after_header = len(PNG_MAGIC) + 25
    return _decoded(path, png[:after_header] + header.exif_chunk + png[after_header:], cv2.IMREAD_GRAYSCALE)


def _two_to_one(path: Path, rgb: NDArray[np.uint8], is_valid: NDArray[np.bool_]) -> Panorama:
    """The picture with W = 2 H exactly, shrunk where it is within 1 % of it."""
    height, width = rgb.shape[:2]
    found = f"{path}: found {width} x {height}"
    if abs(width - 2 * height) > ASPECT_TOLERANCE * 2 * height:
        raise InputError(f"{found}, wanted width = 2 x height (a full equirectangular panorama)")
    if width == 2 * height:
        return Panorama(rgb, is_valid)
    height = min(height, width // 2)
    small = cv2.resize(rgb, (2 * height, height), interpolation=cv2.INTER_AREA)
    # a pixel is valid if all that went into it is
    mask = cv2.resize(is_valid.astype(np.float32), (2 * height, height), interpolation=cv2.INTER_AREA)
    return Panorama(np.asarray(small, dtype=np.uint8), np.asarray(mask > 0.999))
