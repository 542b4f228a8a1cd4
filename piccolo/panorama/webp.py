"""WebP: the RIFF container's chunks, before anything is decoded."""

import struct
from pathlib import Path

from ..errors import InputError
from .header import MAX_XMP_SIZE, WANTED, Header
from .tags import exif_orientation

MAX_SIDE = 16383  # [px] of the format: no further bound, as a plain picture packs to almost nothing
ANIMATION, ALPHA = 0x02, 0x10  # flags of VP8X


def has_webp_magic(data: bytes) -> bool:
    """True for a RIFF file that says it is WebP."""
    return data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def webp_header(path: Path, data: bytes) -> Header:
    """The size in the first chunk, once all chunks are found to be there."""
    chunks = _chunks(path, data)
    kind, body = next(iter(chunks.items()), (b"", b""))
    size = _size(kind, body)
    if size is None or not {b"VP8 ", b"VP8L"} & set(chunks):
        raise InputError(f"{path}: the WebP holds no still picture, {WANTED}")
    is_extended = kind == b"VP8X"
    if is_extended and body[0] & ANIMATION:
        raise InputError(f"{path}: found an animated WebP, {WANTED}")
    exif = chunks.get(b"EXIF", b"").removeprefix(b"Exif\0\0")
    xmp = chunks.get(b"XMP ", b"")
    return Header(
        *size,
        max_num_pixels=MAX_SIDE**2,
        orientation=exif_orientation(exif),
        has_alpha=bool(body[0] & ALPHA) if is_extended else kind == b"VP8L" and bool(body[4] & 0x10),
        xmp=xmp if len(xmp) <= MAX_XMP_SIZE else b"",
    )


def _chunks(path: Path, data: bytes) -> dict[bytes, bytes]:
    """The first chunk of each kind, in the file's order."""
    (size,) = struct.unpack_from("<I", data, 4)
    end = 8 + size
    chunks: dict[bytes, bytes] = {}
    begin = 12
    while begin + 8 <= min(end, len(data)):
        kind, (length,) = data[begin : begin + 4], struct.unpack_from("<I", data, begin + 4)
        begin += 8
        if begin + length > len(data):
            break
        chunks.setdefault(kind, data[begin : begin + length])
        begin += length + length % 2
    if begin < end or end > len(data):
        raise InputError(f"{path}: the WebP ends before its last chunk does (cut off?), {WANTED}")
    return chunks


def _size(kind: bytes, body: bytes) -> tuple[int, int] | None:
    """Width and height [px] by the first chunk, None if it has none."""
    if kind == b"VP8X" and len(body) >= 10:
        return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
    if kind == b"VP8L" and len(body) >= 5:
        bits = int.from_bytes(body[1:5], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 " and len(body) >= 10:
        width, height = struct.unpack_from("<HH", body, 6)
        return width & 0x3FFF, height & 0x3FFF
    return None
