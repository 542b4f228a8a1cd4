"""PNG: chunks and their checksums, before anything is decoded."""

import struct
import zlib
from pathlib import Path

from ..errors import InputError
from .header import MAX_XMP_SIZE, WANTED, Header
from .tags import exif_orientation

MAGIC = b"\x89PNG\r\n\x1a\n"
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
MAX_RATIO = 1040  # zlib packs 1032 bytes into one at best
XMP_KEYWORD = b"XML:com.adobe.xmp\0"
KEPT = (b"IHDR", b"eXIf", b"iTXt")
DEPTH_AT = 24  # [byte] and behind it the colour type
LABEL_KINDS = (b"\x08\x00", b"\x10\x00", b"\x08\x02")  # grey of 8 and 16 bits, RGB of 8


def png_header(path: Path, data: bytes) -> Header:
    """The size in the first chunk, once all chunks' checksums are found right and the last chunk is there."""
    chunks: dict[bytes, bytes] = {}
    text = b""
    begin = len(MAGIC)
    while b"IEND" not in chunks:
        if begin + 12 > len(data):
            raise InputError(f"{path}: the PNG ends without its last chunk (cut off?), {WANTED}")
        (length,) = struct.unpack_from(">I", data, begin)
        kind, end = data[begin + 4 : begin + 8], begin + 12 + length
        if data[end - 4 : end] != struct.pack(">I", zlib.crc32(data[begin + 4 : end - 4])):
            raise InputError(f"{path}: wrong checksum in the PNG's chunk {kind!r} (cut off?), {WANTED}")
        chunks[kind] = data[begin + 8 : end - 4] if kind in KEPT else b""
        text = text or (chunks[kind] if chunks[kind].startswith(XMP_KEYWORD) else b"")
        begin = end
    if next(iter(chunks)) != b"IHDR" or len(chunks[b"IHDR"]) != 13:
        raise InputError(f"{path}: the PNG does not begin with its header, {WANTED}")
    width, height, depth, color_type = struct.unpack_from(">IIBB", chunks[b"IHDR"])
    bits = depth * CHANNELS.get(color_type, 1)
    return Header(
        width,
        height,
        max_num_pixels=len(data) * MAX_RATIO * 8 // max(bits, 1),
        orientation=exif_orientation(chunks.get(b"eXIf", b"")),
        has_alpha=color_type in (4, 6) or b"tRNS" in chunks,
        xmp=_xmp(text),
    )


def keeps_labels(data: bytes) -> bool:
    """True for a PNG whose numbers are decoded as they were written; a palette would change them."""
    return data[DEPTH_AT : DEPTH_AT + 2] in LABEL_KINDS


def _xmp(text: bytes) -> bytes:
    """XMP in an iTXt chunk's `text`, unpacked where it is packed; empty if it is missing, damaged or long."""
    if len(text) < len(XMP_KEYWORD) + 2:
        return b""
    is_packed = text[len(XMP_KEYWORD)] == 1
    body = text[len(XMP_KEYWORD) + 2 :].split(b"\0", 2)[-1]  # after the language and its keyword
    if is_packed:
        try:
            body = zlib.decompressobj().decompress(body, MAX_XMP_SIZE + 1)
        except zlib.error:
            return b""
    return body if len(body) <= MAX_XMP_SIZE else b""
