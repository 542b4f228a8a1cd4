"""The compression of LAZ files: the chunk table, and decompression by lazrs.

lazrs reserves whatever memory the chunk table and the sizes in the chunks promise, so these are held against
the file first.
"""

import io
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...runtime.optional import library
from .las_header import Header

OFFSET_SIZE = 8  # [byte] of the chunk table's offset, in front of the first chunk
MAX_ENTRY_SIZE = 32  # [byte], more than an entry of the table can take
MAX_VLRS = 1 << 16
VLR_HEADER = struct.Struct("<2x16sHH32x")  # user, record id, length of what follows
LASZIP_USER, LASZIP_RECORD_ID = b"laszip encoded", 22204
LASZIP = struct.Struct("<H10xI16xH")  # compressor, points a chunk, number of items
ITEM = struct.Struct("<HH2x")  # type, size
POINTWISE_CHUNKED, LAYERED = 2, 3  # compressors
VARIABLE = 0xFFFFFFFF  # points a chunk, if each says its own
# The items of a record, (type, size [byte]), by point format; extra bytes may follow.
ITEMS = {
    0: ((6, 20),),
    1: ((6, 20), (7, 8)),
    2: ((6, 20), (8, 6)),
    3: ((6, 20), (7, 8), (8, 6)),
    4: ((6, 20), (7, 8), (9, 29)),
    5: ((6, 20), (7, 8), (8, 6), (9, 29)),
    6: ((10, 30),),
    7: ((10, 30), (11, 6)),
    8: ((10, 30), (12, 8)),
    9: ((10, 30), (13, 29)),
    10: ((10, 30), (12, 8), (13, 29)),
}
EXTRA_BYTES = frozenset({0, 14})  # item types
NUM_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # by item type; extra bytes have one each
MAX_CHUNK_SIZE = 1 << 29  # [byte] of a chunk's records, for it is decompressed at once; 2 MB are usual
# What is wanted of formats 6 to 10, where fields can be passed over.
SELECTED = ("XY_RETURNS_CHANNEL", "Z", "INTENSITY", "FLAGS", "CLASSIFICATION", "RGB")

BROKEN = "the file is cut off or broken"

Chunk = tuple[int, int]  # points, bytes


@dataclass(frozen=True)
class Compression:
    """Where a file's chunks are and how to read them."""

    offset: int  # [byte] of the first chunk
    chunks: tuple[Chunk, ...]
    laszip: bytes  # the record that describes the compression, as lazrs takes it
    record_size: int  # [byte]
    num_layers: int  # 0 if the points are not in layers


def read_compression(header: Header) -> Compression:
    """The compression of a LAZ file; InputError if its parts don't fit together or in the file."""
    lazrs = library(header.path, "lazrs")
    with header.path.open("rb") as file:
        laszip = _laszip_record(header, file)
        num_layers, chunk_size = _check_items(header, laszip)
        table_offset = _table_offset(header, file)
        table = _table(header, file, table_offset)
    with _refusing(header.path, lazrs):
        entries = lazrs.read_chunk_table_only(io.BytesIO(table), lazrs.LazVlr(laszip))
    if chunk_size != VARIABLE:
        entries = [(chunk_size, size) for _, size in entries]
    offset = header.points_offset + OFFSET_SIZE
    chunks = _checked_chunks(header, entries, table_offset - offset)
    return Compression(offset, chunks, laszip, header.record_size, num_layers)


def _laszip_record(header: Header, file: BinaryIO) -> bytes:
    """The content of the variable-length record that LASzip leaves behind the header."""
    position = header.header_size
    for _ in range(min(header.num_vlrs, MAX_VLRS)):
        if position + VLR_HEADER.size > header.points_offset:
            break
        file.seek(position)
        user, record_id, length = VLR_HEADER.unpack(file.read(VLR_HEADER.size))
        position += VLR_HEADER.size + length
        if user.rstrip(b"\0") == LASZIP_USER and record_id == LASZIP_RECORD_ID:
            return file.read(length)
    raise InputError(f"{header.path}: the points are compressed, but no record says how (LASzip's VLR)")


def _check_items(header: Header, laszip: bytes) -> tuple[int, int]:
    """The number of layers and the points a chunk, if the record describes this file's points."""
    if len(laszip) < LASZIP.size:
        raise InputError(f"{header.path}: LASzip's record has {len(laszip)} bytes, wanted {LASZIP.size}")
    compressor, chunk_size, num_items = LASZIP.unpack_from(laszip)
    expected = LAYERED if header.point_format >= 6 else POINTWISE_CHUNKED
    if compressor != expected:
        raise InputError(
            f"{header.path}: LASzip's compressor {compressor} in point format {header.point_format}, wanted "
            f"{expected}, the chunked one that LASzip 2 and later write"
        )
    num_whole = min(num_items, (len(laszip) - LASZIP.size) // ITEM.size)
    items = list(ITEM.iter_unpack(laszip[LASZIP.size : LASZIP.size + num_whole * ITEM.size]))
    known = ITEMS[header.point_format]
    extra = items[len(known) :]
    is_known = tuple(items[: len(known)]) == known and all(type_ in EXTRA_BYTES for type_, _ in extra)
    if not is_known or len(items) != num_items or sum(size for _, size in items) != header.record_size:
        raise InputError(
            f"{header.path}: LASzip's record lists items (type, size) {items[:6]}, wanted those of point "
            f"format {header.point_format} in {header.record_size} bytes"
        )
    if compressor != LAYERED:
        return 0, chunk_size
    return sum(NUM_LAYERS.get(type_, size) for type_, size in items), chunk_size


def _table_offset(header: Header, file: BinaryIO) -> int:
    """Where the chunk table begins. A writer that could not go back says it in the file's last bytes."""
    for position in (header.points_offset, header.size - 8):
        file.seek(position)
        number = file.read(8)
        offset = int.from_bytes(number, "little", signed=True)
        if len(number) == 8 and header.points_offset + OFFSET_SIZE <= offset <= header.size - 8:
            return offset
        if len(number) == 8 and offset > header.points_offset:
            break
    raise InputError(f"{header.path}: no chunk table within the file; it is cut off or broken")


def _table(header: Header, file: BinaryIO, offset: int) -> bytes:
    """The compressed chunk table, if the file has room for as many chunks as it promises."""
    file.seek(offset)
    num_chunks = int.from_bytes(file.read(8)[4:], "little")
    # each chunk begins with a whole point
    max_chunks = (offset - header.points_offset - OFFSET_SIZE) // header.record_size
    if not 0 < num_chunks <= max_chunks:
        raise InputError(
            f"{header.path}: the chunk table promises {num_chunks} chunks, wanted 1 to {max_chunks}; {BROKEN}"
        )
    file.seek(offset)
    return file.read(MAX_ENTRY_SIZE * (num_chunks + 32))


def _checked_chunks(header: Header, entries: list[Chunk], num_bytes: int) -> tuple[Chunk, ...]:
    """The chunks that hold the promised points, the last no more than is left."""
    chunks: list[Chunk] = []
    num_left = header.num_points
    max_count = MAX_CHUNK_SIZE // header.record_size
    for full_count, size in entries:
        if num_left == 0:
            break
        count = min(full_count, num_left)
        if not (0 < count <= max_count and header.record_size <= size <= num_bytes):
            raise InputError(
                f"{header.path}: chunk {len(chunks) + 1} of {count} points in {size} bytes, wanted 1 to "
                f"{max_count} points and within the file; the chunk table is broken"
            )
        chunks.append((count, size))
        num_left -= count
        num_bytes -= size
    if num_left:
        raise InputError(
            f"{header.path}: the header promises {header.num_points} points, the chunk table has "
            f"{header.num_points - num_left}"
        )
    return tuple(chunks)


def decompress(
    path: Path, compression: Compression, data: bytes, chunks: Iterable[Chunk]
) -> NDArray[np.uint8]:
    """The records, one after the other, of the `chunks` whose compressed bytes are `data`."""
    lazrs = library(path, "lazrs")
    chunks = list(chunks)
    if compression.num_layers:
        _check_layers(path, compression, data, chunks)
    records = np.empty(sum(count for count, _ in chunks) * compression.record_size, dtype=np.uint8)
    selected = 0
    for name in SELECTED:
        selected |= getattr(lazrs, f"SELECTIVE_DECOMPRESS_{name}")
    with _refusing(path, lazrs):
        lazrs.decompress_points_with_chunk_table(
            data, compression.laszip, records, chunks, lazrs.DecompressionSelection(selected)
        )
    return records


def _check_layers(path: Path, compression: Compression, data: bytes, chunks: Iterable[Chunk]) -> None:
    """Refuse layers larger than the chunk they lie in, and another number of points than was promised.

    A chunk is a whole point, the number of points, the bytes of each layer, the layers.
    """
    begin = 0
    head_size = compression.record_size + 4 * (1 + compression.num_layers)
    for num_points, size in chunks:
        if size < head_size:
            raise InputError(f"{path}: a chunk of {size} bytes, wanted {head_size} or more; {BROKEN}")
        head = data[begin + compression.record_size : begin + head_size]
        found, *layers = np.frombuffer(head, dtype="<u4").tolist()
        if sum(layers) > size - head_size or found != num_points:
            raise InputError(
                f"{path}: a chunk of {found} points with layers of {sum(layers)} bytes, wanted "
                f"{num_points} points and {size - head_size} bytes at most; {BROKEN}"
            )
        begin += size


@contextmanager
def _refusing(path: Path, lazrs: ModuleType) -> Iterator[None]:
    """Turn what lazrs says of broken data into an InputError."""
    try:
        yield
    except lazrs.LazrsError as error:
        raise InputError(f"{path}: the compressed points are broken ({error})") from error
    except BaseException as error:  # a panic in Rust: no Exception, and of a class that can't be imported
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path}: the compressed points are broken") from error
