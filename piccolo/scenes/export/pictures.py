"""What a picture's first bytes say: a JPEG's segments, and the size of a JPEG or PNG, without decoding it."""

import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from ...errors import InputError

JPEG_MAGIC, PNG_MAGIC = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of a header with the size
SCAN = 0xDA
MAX_HEADER_SIZE = 1 << 26  # [byte] of segments looked through before the picture begins
MARKER = re.compile(rb"\xff+")
WANTED = "wanted a whole JPEG or PNG, or --size W H"


class Segment(NamedTuple):
    """One segment of a JPEG: data[begin:end], marker and length included."""

    marker: int
    begin: int
    end: int


def jpeg_segments(data: bytes | mmap.mmap) -> Iterator[Segment]:
    """The segments of a JPEG up to the header of its first scan; fewer if it is damaged."""
    begin = len(JPEG_MAGIC)
    while begin < MAX_HEADER_SIZE and (found := MARKER.match(data, begin)):
        begin = found.end() - 1  # a marker may be filled up with FF
        if begin + 4 > len(data):
            return
        marker, length = struct.unpack_from(">xBH", data, begin)
        end = begin + 2 + length
        if length < 2 or end > len(data):
            return
        yield Segment(marker, begin, end)
        if marker == SCAN:
            return
        begin = end


def jpeg_size(data: bytes | mmap.mmap) -> tuple[int, int] | None:
    """W, H of a JPEG; None if its segments do not say."""
    for segment in jpeg_segments(data):
        if segment.marker in FRAMES and segment.end - segment.begin >= 9:
            height, width = struct.unpack_from(">HH", data, segment.begin + 5)
            return width, height
    return None


def picture_size(path: Path) -> tuple[int, int]:
    """W, H of a JPEG or PNG as stored; only the file's first pages are read."""
    if not path.is_file():
        raise InputError(f"{path}: found no such file, {WANTED}")
    size = None
    with path.open("rb") as file:
        if path.stat().st_size < 24:  # what is empty can't be mapped
            raise InputError(f"{path}: found no picture, {WANTED}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[:8] == PNG_MAGIC:
                size = struct.unpack_from(">II", data, 16)
            elif data[:2] == JPEG_MAGIC:
                size = jpeg_size(data)
    if size is None:
        raise InputError(f"{path}: found no size of a picture in its header, {WANTED}")
    return size
