"""JPEG: segments walked through to the end of the picture, before anything is decoded."""

import re
import struct
from pathlib import Path

from ..errors import InputError
from .header import WANTED, Header
from .tags import exif_orientation

MAGIC = b"\xff\xd8"
EXIF_MARK, XMP_MARK = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"
MAX_RATIO = 512  # pixels a byte: one bit for a block of 8 x 8
# The end of a scan: a marker other than a stuffed FF 00, a restart or a filling FF.
SCAN_END = re.compile(rb"\xff[\x01-\xcf\xd8-\xfe]")
FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
APP1, SCAN = 0xE1, 0xDA


def jpeg_header(path: Path, data: bytes) -> Header:
    """The size in the frame's header, and what the segments before the picture say.

    CMYK is left to the decoder, which takes it as inverted: so Adobe's programs and libjpeg write it.
    """
    size: tuple[int, int] | None = None
    orientation, xmp = 1, b""
    begin = len(MAGIC)
    while begin + 4 <= len(data) and data[begin] == 0xFF:
        marker = data[begin + 1]
        (length,) = struct.unpack_from(">H", data, begin + 2)
        if marker == 0xFF:
            begin += 1
            continue
        body = data[begin + 4 : begin + 2 + length]
        if marker in FRAME_MARKERS and len(body) >= 5:
            size = struct.unpack_from(">HH", body, 1)
        if marker == APP1 and body.startswith(EXIF_MARK):
            orientation = exif_orientation(body[len(EXIF_MARK) :])
        if marker == APP1 and body.startswith(XMP_MARK):
            xmp = body[len(XMP_MARK) :]
        begin = _segment_end(data, begin + 2 + length, marker)
        if data[begin : begin + 2] == b"\xff\xd9" and size:
            return Header(size[1], size[0], len(data) * MAX_RATIO, orientation, xmp=xmp)
    raise InputError(f"{path}: the JPEG ends without its end mark (cut off?), {WANTED}")


def _segment_end(data: bytes, end: int, marker: int) -> int:
    """Where the next marker is; a scan's header is followed by the scan."""
    if marker != SCAN:
        return end
    found = SCAN_END.search(data, end)
    return found.start() if found else len(data)
