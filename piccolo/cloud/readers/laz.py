"""The compression of LAZ files: the chunk table, and decompression by lazrs.

lazrs reserves whatever memory the chunk table and the sizes in the chunks promise, so these are compared with
the file first.
"""

import io
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...runtime.optional import import_optional
from .las_header import RECORD_SIZES, LasHeader
from .reader import quoted

OFFSET_SIZE = 8  # [byte] of the chunk table's offset, in front of the first chunk
MAX_ENTRY_SIZE = 32  # [byte], more than an entry of the table can take
MAX_VLRS = 1 << 16
VLR_HEADER = struct.Struct("<2x16sHH32x")  # user, record id, length of what follows
LASZIP_USER, LASZIP_RECORD_ID = b"laszip encoded", 22204
ITEMS_AT, ITEM_SIZE, TYPE_AND_SIZE = 34, 6, 4  # [byte] in that record; an item ends with its version
NUM_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}  # of a chunk, by point format; extra bytes have one each
MAX_CHUNK_SIZE = 1 << 29  # [byte] of a chunk's records, for it is decompressed at once; 2 MB are usual
# What is wanted of formats 6 to 10, where fields can be passed over.
SELECTED = ("XY_RETURNS_CHANNEL", "Z", "INTENSITY", "FLAGS", "CLASSIFICATION", "RGB")

BROKEN = "the file is cut off or broken"

LazChunk = tuple[int, int]  # points, bytes


class LasLayout(NamedTuple):
    """Where a file's chunks are and how to read them."""

    offset: int  # [byte] of the first chunk
    chunks: tuple[LazChunk, ...]
    laszip: bytes = b""  # the record that describes the compression, as lazrs takes it; empty without
    num_layers: int = 0  # 0 if the points are not in layers


def read_laz_layout(header: LasHeader) -> LasLayout:
    """The compression of a LAZ file; InputError if its parts don't fit together or in the file."""
    lazrs = import_optional(header.path, "lazrs")
    with header.path.open("rb") as file:
        laszip = _laszip_record(header, file)
        num_layers = _check_items(header, laszip, lazrs)
        table_offset = _table_offset(header, file)
        table = _table(header, file, table_offset)
    with _refusing(header.path, lazrs):
        vlr = lazrs.LazVlr(laszip)
        entries = lazrs.read_chunk_table_only(io.BytesIO(table), vlr)
        if not vlr.uses_variable_size_chunks():
            entries = [(vlr.chunk_size(), size) for _, size in entries]
    offset = header.points_offset + OFFSET_SIZE
    return LasLayout(offset, _checked_chunks(header, entries, table_offset - offset), laszip, num_layers)


def _laszip_record(header: LasHeader, file: BinaryIO) -> bytes:
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


def _check_items(header: LasHeader, laszip: bytes, lazrs: ModuleType) -> int:
    """The number of layers of a chunk, if the record is one that lazrs would write for these points."""
    num_extra = header.record_size - RECORD_SIZES[header.point_format]
    expected = lazrs.LazVlr.new_for_compression(header.point_format, num_extra, False).record_data()
    if _without_versions(laszip[: len(expected)]) != _without_versions(expected):
        what = f"point format {header.point_format} in {header.record_size} bytes"
        raise InputError(f"{header.path}: LASzip's record is not that of {what}: it is broken or too old")
    return NUM_LAYERS[header.point_format] + num_extra if header.point_format >= 6 else 0


def _without_versions(laszip: bytes) -> list[bytes]:
    """The compressor, the number of items, and the type and size of each."""
    items = [laszip[k : k + TYPE_AND_SIZE] for k in range(ITEMS_AT, len(laszip), ITEM_SIZE)]
    return [laszip[:2], laszip[ITEMS_AT - 2 : ITEMS_AT], *items]


def _table_offset(header: LasHeader, file: BinaryIO) -> int:
    """Where the chunk table begins. A writer that could not go back says it in the file's last bytes."""
    for position in (header.points_offset, header.size - 8):
        file.seek(position)
        offset = int.from_bytes(file.read(8), "little", signed=True)
        if header.points_offset + OFFSET_SIZE <= offset <= header.size - 8:
            return offset
        if offset > header.points_offset:
            break
    raise InputError(f"{header.path}: no chunk table within the file; it is cut off or broken")


def _table(header: LasHeader, file: BinaryIO, offset: int) -> bytes:
    """The compressed chunk table, if the file has room for as many chunks as it promises."""
    file.seek(offset)
    num_chunks = int.from_bytes(file.read(8)[4:], "little")
    # each chunk begins with a whole point
    max_chunks = (offset - header.points_offset - OFFSET_SIZE) // header.record_size
    if not 0 < num_chunks <= max_chunks:
        counts = f"promises {num_chunks} chunks, wanted 1 to {max_chunks}"
        raise InputError(f"{header.path}: the chunk table {counts}; {BROKEN}")
    file.seek(offset)
    return file.read(MAX_ENTRY_SIZE * (num_chunks + 32))


def _checked_chunks(header: LasHeader, entries: list[LazChunk], num_bytes: int) -> tuple[LazChunk, ...]:
    """The chunks that hold the promised points, the last no more than is left."""
    chunks: list[LazChunk] = []
    num_left, most = header.num_points, MAX_CHUNK_SIZE // header.record_size
    for full_count, size in entries:
        if num_left == 0:
            break
        count = min(full_count, num_left)
        if not (0 < count <= most and header.record_size <= size <= num_bytes):
            where = f"{header.path}: chunk {len(chunks) + 1} of {count} points in {size} bytes"
            raise InputError(f"{where}, wanted 1 to {most} points, in the file; the chunk table is broken")
        chunks.append((count, size))
        num_left, num_bytes = num_left - count, num_bytes - size
    if num_left:
        counts = f"promises {header.num_points} points, the chunk table has {header.num_points - num_left}"
        raise InputError(f"{header.path}: the header {counts}")
    return tuple(chunks)


def decompress(
    header: LasHeader, layout: LasLayout, data: bytes, chunks: Sequence[LazChunk]
) -> NDArray[np.uint8]:
    """The records, one after the other, of the `chunks` whose compressed bytes are `data`."""
    lazrs = import_optional(header.path, "lazrs")
    if layout.num_layers:
        _check_layers(header, layout.num_layers, data, chunks)
    records = np.empty(sum(count for count, _ in chunks) * header.record_size, dtype=np.uint8)
    selected = sum(getattr(lazrs, f"SELECTIVE_DECOMPRESS_{name}") for name in SELECTED)
    with _refusing(header.path, lazrs):
        lazrs.decompress_points_with_chunk_table(
            data, layout.laszip, records, list(chunks), lazrs.DecompressionSelection(selected)
        )
    return records


def _check_layers(header: LasHeader, num_layers: int, data: bytes, chunks: Sequence[LazChunk]) -> None:
    """Refuse layers larger than the chunk they lie in, and another number of points than was promised.

    A chunk is a whole point, the number of points, the bytes of each layer, the layers.
    """
    begin, head_size = 0, header.record_size + 4 * (1 + num_layers)
    for num_points, size in chunks:
        if size < head_size:
            raise InputError(f"{header.path}: a chunk of {size} bytes, wanted {head_size} or more; {BROKEN}")
        found, *layers = np.frombuffer(data, "<u4", 1 + num_layers, begin + header.record_size).tolist()
        if sum(layers) > size - head_size or found != num_points:
            what = f"a chunk of {found} points with layers of {sum(layers)} bytes"
            most = f"wanted {num_points} points and {size - head_size} bytes at most"
            raise InputError(f"{header.path}: {what}, {most}; {BROKEN}")
        begin += size


@contextmanager
def _refusing(path: Path, lazrs: ModuleType) -> Iterator[None]:
    """Turn what lazrs says of broken data into an InputError."""
    try:
        yield
    except BaseException as error:  # a panic in Rust: no Exception, and of a class that can't be imported
        if not isinstance(error, lazrs.LazrsError) and type(error).__name__ != "PanicException":
            raise
        why = quoted(str(error).encode())
        raise InputError(f"{path}: the compressed points are broken ({why})") from error
