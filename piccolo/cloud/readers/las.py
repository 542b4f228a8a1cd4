"""LAS and LAZ files: chunk table, positions and colours, decompressed by lazrs.

lazrs reserves whatever memory the chunk table and the sizes in the chunks promise, so these are compared with
the file first. laspy would loop and reserve as a damaged header says.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...system.arrays import Bytes
from ...system.errors import InputError, import_optional
from ..settings import BY_FILE, Channel, CloudSettings
from . import reader
from .las_file import WANTED, LasHeader, find_units, read_header, record_content
from .reader import POINTS_A_CHUNK, MissingChannelError, PointSource, quote_line

OFFSET_SIZE = 8  # [byte] of the chunk table's offset, in front of the first chunk
MAX_ENTRY_SIZE = 32  # [byte], more than an entry of the table can take
LASZIP_USER = b"laszip encoded"
LASZIP_RECORD_ID = 22204
ITEMS_AT = 34  # [byte] in that record
ITEM_SIZE = 6  # [byte]; ends with its version
TYPE_AND_SIZE = 4  # [byte]
NUM_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}  # of a chunk, by point format; extra bytes have one each
MAX_CHUNK_SIZE = 1 << 29  # [byte] of a chunk's records, for it is decompressed at once; 2 MB are usual
# What is wanted of formats 6 to 10, where fields can be passed over.
SELECTED = ("XY_RETURNS_CHANNEL", "Z", "INTENSITY", "FLAGS", "CLASSIFICATION", "RGB")
# Of the flags' byte the bit of withheld points, and the bits of the class.
OLD_BITS = 0x80, 0x1F  # in the formats 0-5
BITS = 0x04, 0xFF  # in 6-10
MAX_LAS_SAMPLES = 1 << 20
NUM_SAMPLE_RUNS = 64
BROKEN = "the file is cut off or broken"

Records = NDArray[np.void]
LazChunk = tuple[int, int]  # points, bytes


class LasLayout(NamedTuple):
    """The chunks of a file and their layout."""

    offset: int  # [byte] of the first chunk
    chunks: tuple[LazChunk, ...]
    laszip: bytes = b""  # the record that describes the compression, as lazrs takes it; empty without


def read_laz_layout(header: LasHeader) -> LasLayout:
    """Return the layout of a LAZ file; InputError if its parts don't fit together or into the file."""
    lazrs = import_optional(header.path, "lazrs")
    with header.path.open("rb") as file:
        laszip = record_content(header, file, LASZIP_USER, LASZIP_RECORD_ID)
        if laszip is None:
            text = "the points are compressed, but no record says how (LASzip's VLR)"
            raise InputError(f"{header.path}: {text}")
        _check_items(header, laszip, lazrs)
        table_offset, table = _table(header, file)
    with _refusing(header.path, lazrs):
        vlr = lazrs.LazVlr(laszip)
        entries = lazrs.read_chunk_table_only(io.BytesIO(table), vlr)
        if not vlr.uses_variable_size_chunks():
            entries = [(vlr.chunk_size(), size) for _, size in entries]
    offset = header.points_offset + OFFSET_SIZE
    return LasLayout(offset, _check_chunks(header, entries, table_offset - offset), laszip)


def _check_items(header: LasHeader, laszip: bytes, lazrs: ModuleType) -> None:
    """Refuse a record that is not one that lazrs would write."""
    expected = lazrs.LazVlr.new_for_compression(header.point_format, header.num_extra, False).record_data()
    if _without_versions(laszip[: len(expected)]) != _without_versions(expected):
        what = f"point format {header.point_format} in {header.record_size} bytes"
        raise InputError(f"{header.path}: LASzip's record is not that of {what}: it is broken or too old")


def _without_versions(laszip: bytes) -> list[bytes]:
    items = [laszip[k : k + TYPE_AND_SIZE] for k in range(ITEMS_AT, len(laszip), ITEM_SIZE)]
    return [laszip[:2], laszip[ITEMS_AT - 2 : ITEMS_AT], *items]


def _table(header: LasHeader, file: BinaryIO) -> tuple[int, bytes]:
    """Return the start and bytes of the compressed chunk table; InputError if it can't fit into the file.

    A writer that can't seek back writes its start into the file's last bytes.
    """
    for position in (header.points_offset, header.size - 8):
        file.seek(position)
        offset = int.from_bytes(file.read(8), "little", signed=True)
        is_inside = header.points_offset + OFFSET_SIZE <= offset <= header.size - 8
        if is_inside or offset > header.points_offset:
            break
    if not is_inside:
        raise InputError(f"{header.path}: no chunk table within the file; it is cut off or broken")
    file.seek(offset)
    num_chunks = int.from_bytes(file.read(8)[4:], "little")
    # each chunk begins with a whole point
    max_chunks = (offset - header.points_offset - OFFSET_SIZE) // header.record_size
    if not 0 < num_chunks <= max_chunks:
        counts = f"promises {num_chunks} chunks, wanted 1 to {max_chunks}"
        raise InputError(f"{header.path}: the chunk table {counts}; {BROKEN}")
    file.seek(offset)
    return offset, file.read(MAX_ENTRY_SIZE * (num_chunks + 32))


def _check_chunks(header: LasHeader, entries: list[LazChunk], num_bytes: int) -> tuple[LazChunk, ...]:
    """Return the chunks of the promised points, the last cut to the points that are left."""
    chunks: list[LazChunk] = []
    num_left = header.num_points
    most = MAX_CHUNK_SIZE // header.record_size
    for full_count, size in entries:
        if num_left == 0:
            break
        count = min(full_count, num_left)
        if not (0 < count <= most and header.record_size <= size <= num_bytes):
            where = f"{header.path}: chunk {len(chunks) + 1} of {count} points in {size} bytes"
            raise InputError(f"{where}, wanted 1 to {most} points, in the file; the chunk table is broken")
        chunks.append((count, size))
        num_left -= count
        num_bytes -= size
    if num_left:
        counts = f"promises {header.num_points} points, the chunk table has {header.num_points - num_left}"
        raise InputError(f"{header.path}: the header {counts}")
    return tuple(chunks)


def decompress(header: LasHeader, layout: LasLayout, data: bytes, chunks: Sequence[LazChunk]) -> Bytes:
    """Decompress the bytes `data` of `chunks`; return their records, one after the other."""
    lazrs = import_optional(header.path, "lazrs")
    if header.point_format >= 6:
        _check_layers(header, data, chunks)
    records = np.empty(sum(count for count, _ in chunks) * header.record_size, dtype=np.uint8)
    fields = sum(getattr(lazrs, f"SELECTIVE_DECOMPRESS_{name}") for name in SELECTED)
    selected = lazrs.DecompressionSelection(fields)
    with _refusing(header.path, lazrs):
        lazrs.decompress_points_with_chunk_table(data, layout.laszip, records, list(chunks), selected)
    return records


def _check_layers(header: LasHeader, data: bytes, chunks: Sequence[LazChunk]) -> None:
    """Refuse layers larger than their chunk, and another number of points than was promised.

    A chunk consists of a whole point, the number of points, the bytes of each layer, the layers.
    """
    begin = 0
    num_layers = NUM_LAYERS[header.point_format] + header.num_extra
    head_size = header.record_size + 4 * (1 + num_layers)
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
    """Turn lazrs' errors on broken data into an InputError."""
    try:
        yield
    except BaseException as error:  # a panic in Rust: no Exception, and of a class that can't be imported
        if not isinstance(error, lazrs.LazrsError) and type(error).__name__ != "PanicException":
            raise
        why = quote_line(str(error).encode())
        raise InputError(f"{path}: the compressed points are broken ({why})") from error


def open_las(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of a LAS or LAZ file; withheld ones are left out.

    Colours are 16-bit, as the format says, unless a million points, spread evenly over the file, tell of
    another range. If all of these points are black, the file counts as one without colours.
    """
    header = read_header(path)
    source = _open(header, options, channel)
    if options.scale is not None:
        return source
    units, note = find_units(header)
    return source._replace(units=units, unit_note=note)


def _open(header: LasHeader, options: CloudSettings, channel: Channel) -> PointSource:
    """Return the points of a file in its unit."""
    path = header.path
    layout = read_laz_layout(header) if header.is_compressed else _plain_layout(header)
    field = "class" if channel == "shape" else {"colors": "rgb"}.get(channel, "intensity")
    read = partial(_read, header, layout, field)
    if field == "class":
        return reader.make_source(path, read, channel, options, header.num_points)
    if field == "rgb" and not header.has_colors:
        raise MissingChannelError(f"{path}: point format {header.point_format} has no colours, {WANTED}")
    samples = [part for part in _read(header, layout, field, is_sample=True) if len(part[1])]
    if not any(values.any() for _, values in samples):
        is_zero = f"0 in all {sum(len(values) for _, values in samples)} points checked"
        what = f"has no colours: red green blue are {is_zero}, {WANTED}"
        raise MissingChannelError(f"{path}: {what if field == 'rgb' else f'the intensity is {is_zero}'}")
    if field == "intensity":
        source = reader.make_source(path, read, channel, options, header.num_points)
        return source._replace(warnings=header.warnings)
    source = reader.color_source(path, read, options, reader.USUAL["u2"], samples)
    return source._replace(num_points=header.num_points, warnings=(*header.warnings, *source.warnings))


def _plain_layout(header: LasHeader) -> LasLayout:
    """Return the layout of records that are not compressed, in chunks small enough to be sampled."""
    most = max(
        1, min(POINTS_A_CHUNK, MAX_LAS_SAMPLES // NUM_SAMPLE_RUNS, MAX_CHUNK_SIZE // header.record_size)
    )
    counts = [most] * (header.num_points // most) + [header.num_points % most]
    chunks = tuple((count, count * header.record_size) for count in counts if count)
    return LasLayout(header.points_offset, chunks)


def _chunks(header: LasHeader, layout: LasLayout, is_sample: bool = False) -> Iterator[Records]:
    """Yield all records, a chunk at once; for a sample about MAX_LAS_SAMPLES, spread over the file."""
    counts, sizes = np.array(layout.chunks, dtype=np.int64).T
    offsets = layout.offset + np.cumsum(sizes) - sizes
    if is_sample and header.num_points > MAX_LAS_SAMPLES:
        num_runs = min(max(2, MAX_LAS_SAMPLES // int(counts.max())), len(counts))
        firsts = np.linspace(0, len(counts) - 1, num_runs).astype(np.int64)
        ends = firsts + 1
    else:  # chunks read at once
        most = max(1, min(POINTS_A_CHUNK, MAX_CHUNK_SIZE // header.record_size))
        firsts = np.flatnonzero(np.diff((np.cumsum(counts) - counts) // most, prepend=-1))
        ends = np.append(firsts[1:], len(counts))
    with header.path.open("rb") as file:
        for first, end in zip(firsts.tolist(), ends.tolist(), strict=True):
            file.seek(int(offsets[first]))
            size = int(sizes[first:end].sum())
            data = file.read(size)
            if len(data) < size:
                raise InputError(f"{header.path}: {reader.CUT}")
            content: bytes | Bytes = data
            if layout.laszip:
                content = decompress(header, layout, data, layout.chunks[first:end])
            records = np.frombuffer(content, dtype=header.dtype)
            for begin in range(0, len(records), POINTS_A_CHUNK):
                yield records[begin : begin + POINTS_A_CHUNK]


def _read(header: LasHeader, layout: LasLayout, field: str, is_sample: bool = False) -> Iterator[reader.Part]:
    """Yield the points that are not withheld, and their colours, intensity or class."""
    withheld, class_bits = OLD_BITS if header.point_format < 6 else BITS
    for chunk in _chunks(header, layout, is_sample):
        records = chunk[chunk["flags"] & withheld == 0]
        with np.errstate(over="ignore"):  # to infinity, and such points are dropped
            points_world = records["xyz"] * header.scales + header.offsets
        values = records[field]
        if field != "rgb":
            values = (values & class_bits if field == "class" else values).astype(np.float64)
        yield points_world, values
