"""TIFF and BigTIFF: the first picture's tags and strips, before anything is decoded.

Decoded by OpenCV, which brings libtiff and is here anyway: Pillow reads no 16-bit RGB, tifffile no LZW or
JPEG without a large further library. What libtiff passes over in silence is checked here.
"""

import zlib
from pathlib import Path

import numpy as np

from ..errors import InputError
from .header import MAX_XMP_SIZE, WANTED, Header
from .tags import Directory, TagError, are_spans_inside, read_directory

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, SAMPLES = 256, 257, 258, 259, 262, 277
STRIPS, ROWS_PER_STRIP, STRIP_SIZES, TILES, TILE_SIZES = 273, 278, 279, 324, 325
TILE_WIDTH, TILE_HEIGHT, EXTRA_SAMPLES, SAMPLE_FORMAT, XMP = 322, 323, 338, 339, 700
COLORS = {0: "grey", 1: "grey", 2: "RGB", 3: "palette", 6: "YCbCr"}
WHITE_IS_ZERO_16 = (0, 16)  # which OpenCV would leave inverted
OTHER_COLORS = {
    0: "16-bit grey with 0 for white",
    4: "a mask",
    5: "CMYK",
    8: "CIELab",
    9: "ICCLab",
    32803: "raw sensor values",
    34892: "raw",
}
FORMATS = {2: "signed", 3: "float", 5: "complex integer", 6: "complex"}
NONE, DEFLATE = 1, (8, 32946)
MAX_RATIO = 3840  # bytes that one byte unpacks to, LZW's longest code; Deflate has 1032, JPEG 512
MAX_TILE_MARGIN = 4096  # [px] that a tile may reach beyond the picture
MAX_SIDE = 1 << 20  # [px]
MAX_OVERHANG, MIN_OVERHANG = 2, 1 << 24  # times the picture, and bytes: tiles reach beyond the picture
ASSOCIATED, UNASSOCIATED = 1, 2


def tiff_header(path: Path, data: bytes) -> Header:
    """The first picture's size, once its tags are found readable and its strips or tiles to be there."""
    try:
        tags = read_directory(data)
    except TagError as error:
        raise InputError(f"{path}: the TIFF has {error} (cut off?), {WANTED}") from error
    width, height = tags.number(WIDTH, 0), tags.number(HEIGHT, 0)
    samples, bits = tags.number(SAMPLES, 1), tags.number(BITS, 1)
    _check_kind(path, tags, samples, bits)
    _check_layout(path, tags, width, height)
    _check_strips(path, data, tags, num_bytes=width * height * samples * bits // 8)
    has_alpha = samples > 3
    xmp = tags.values.get(XMP, np.empty(0, np.uint8))
    return Header(
        width,
        height,
        max_num_pixels=len(data) * MAX_RATIO * 8 // (bits * samples),
        has_alpha=has_alpha,
        is_deep=True,
        xmp=xmp.astype(np.uint8).tobytes() if len(xmp) <= MAX_XMP_SIZE else b"",
        patches=_patches(data, tags),
        warnings=("found more than one picture in the TIFF, the first was read",) if tags.has_next else (),
    )


def _check_kind(path: Path, tags: Directory, samples: int, bits: int) -> None:
    """Refuse by name what the pixels can't be read from."""
    sample_format = tags.number(SAMPLE_FORMAT, 1)
    photometric = tags.number(PHOTOMETRIC, 1)
    if sample_format in FORMATS or bits not in (8, 16) or (tags.numbers(BITS) != bits).any():
        kind = FORMATS.get(sample_format, "unsigned")
        raise InputError(f"{path}: found a TIFF of {bits}-bit {kind} samples, wanted 8 or 16 bits, unsigned")
    if photometric not in COLORS or (photometric, bits) == WHITE_IS_ZERO_16:
        kind = OTHER_COLORS.get(photometric, f"photometric {photometric}")
        raise InputError(f"{path}: found a TIFF of {kind}, wanted RGB or grey")
    wanted = (1,) if photometric in (0, 1, 3) else (3, 4)
    if samples not in wanted:
        raise InputError(
            f"{path}: found a {COLORS[photometric]} TIFF of {samples} samples a pixel, "
            "wanted grey, RGB or RGB with alpha"
        )


def _check_layout(path: Path, tags: Directory, width: int, height: int) -> None:
    """Refuse sizes for which libtiff would take memory beyond the picture's."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise InputError(f"{path}: found a TIFF of {width} x {height}, {WANTED}")
    tile_width, tile_height = tags.number(TILE_WIDTH, 1), tags.number(TILE_HEIGHT, 1)
    is_small = 0 < tile_width <= width + MAX_TILE_MARGIN and 0 < tile_height <= height + MAX_TILE_MARGIN
    if not is_small or tags.number(ROWS_PER_STRIP, 1) < 1:
        raise InputError(f"{path}: the TIFF's tiles or strips do not fit its picture, {WANTED}")


def _check_strips(path: Path, data: bytes, tags: Directory, num_bytes: int) -> None:
    """Refuse a picture of `num_bytes` whose strips or tiles are not all there or fail Deflate's checksum."""
    is_tiled = TILES in tags.values
    begins = tags.numbers(TILES if is_tiled else STRIPS)
    sizes = tags.numbers(TILE_SIZES if is_tiled else STRIP_SIZES)
    if len(begins) != len(sizes) or not len(begins) or not are_spans_inside(begins, sizes, len(data)):
        raise InputError(f"{path}: the TIFF's strips are not all in the file (cut off?), {WANTED}")
    if int(sizes.sum()) > 2 * len(data):
        raise InputError(f"{path}: the TIFF's strips lie over each other, {WANTED}")
    compression = tags.number(COMPRESSION, NONE)
    if compression == NONE and int(sizes.sum()) < num_bytes:
        raise InputError(f"{path}: the TIFF's strips hold less than the picture (cut off?), {WANTED}")
    if compression in DEFLATE:
        left = MAX_OVERHANG * num_bytes + MIN_OVERHANG
        for begin, size in zip(begins.tolist(), sizes.tolist(), strict=True):
            left -= _unpacked_size(data[begin : begin + size], left)
        if left <= 0:
            raise InputError(f"{path}: a strip of the TIFF is damaged or too long, {WANTED}")


def _unpacked_size(packed: bytes, limit: int) -> int:
    """What a zlib stream unpacks to, `limit` or more if it is longer or damaged; unpacked in pieces."""
    unpacker = zlib.decompressobj()
    size = 0
    try:
        while packed and not unpacker.eof and size < limit:
            size += len(unpacker.decompress(packed, 1 << 20))
            packed = unpacker.unconsumed_tail
    except zlib.error:
        return limit
    return size if unpacker.eof else limit


def _patches(data: bytes, tags: Directory) -> tuple[tuple[int, bytes], ...]:
    """What libtiff is not to see: further pictures, and that alpha is unassociated.

    It would look at the former, and multiply 8-bit colours by the latter.
    """
    place, size = tags.next_place
    patches = [(place, bytes(size))] if tags.has_next else []
    if tags.number(EXTRA_SAMPLES, 0) == UNASSOCIATED:
        associated = ASSOCIATED.to_bytes(2, "little" if data[:2] == b"II" else "big")
        patches.append((tags.places[EXTRA_SAMPLES], associated))
    return tuple(patches)
