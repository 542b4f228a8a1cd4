"""LAS and LAZ files: header, chunk table, positions and colours, decompressed by lazrs.

lazrs reserves whatever memory the chunk table and the sizes in the chunks promise, so these are compared with
the file first. laspy would loop and reserve as a damaged header says.
"""

import io
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array, Bytes
from ...errors import InputError, import_optional
from ..settings import IN_METRES, Channel, CloudSettings
from . import reader
from .reader import CHUNK, MissingChannelError, PointSource, quote_line

MAGIC = b"LASF"
WORTH = 0.5  # of the promised points: a file that is cut off is read if it has as many
MIN_HEADER_SIZE = 227  # [byte]
MIN_HEADER_SIZE_1_4 = 375  # [byte]
COMPRESSED_BIT = 0x80  # of the point format
# The least length of a record by point format, and where red green blue begin in those that have them [byte].
RECORD_SIZES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
COLORS_BYTE = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
INTENSITY_BYTE = 12
FLAGS_BYTE = 15
CLASS_BYTE_OLD = 15  # in the formats 0-5, whose upper three bits are flags
CLASS_BYTE = 16  # in 6-10
WANTED = "wanted LAS or LAZ with red green blue (point format 2, 3, 5, 7, 8 or 10)"
OFFSET_SIZE = 8  # [byte] of the chunk table's offset, in front of the first chunk
MAX_ENTRY_SIZE = 32  # [byte], more than an entry of the table can take
MAX_VLRS = 1 << 16
VLR_HEADER = struct.Struct("<2x16sHH32x")  # user, record id, length of what follows
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
PROJECTION_USER = b"LASF_Projection"
WKT_ID = 2112
GEO_KEYS_ID = 34735
PROJECTED_KEY = 3072  # GeoTIFF keys whose value is a code of EPSG
GEOGRAPHIC_KEY = 2048
USER_DEFINED = 32767
MAX_SAMPLES = 1 << 20
NUM_SAMPLE_RUNS = 64
BROKEN = "the file is cut off or broken"

Records = NDArray[np.void]
LazChunk = tuple[int, int]  # points, bytes


class LasHeader(NamedTuple):
    """The header of a LAS file."""

    path: Path
    size: int  # [byte]
    header_size: int  # [byte]
    points_offset: int  # [byte]
    num_vlrs: int
    point_format: int
    record_size: int  # [byte]
    num_points: int
    scales: Array  # (3,) x y z
    offsets: Array  # (3,)
    is_compressed: bool
    warnings: tuple[str, ...] = ()

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The fields that are read of a record."""
        fields = {"xyz": ("3<i4", 0), "intensity": ("<u2", INTENSITY_BYTE), "flags": ("u1", FLAGS_BYTE)}
        fields["class"] = ("u1", CLASS_BYTE_OLD if self.point_format < 6 else CLASS_BYTE)
        if self.has_colors:
            fields["rgb"] = ("3<u2", COLORS_BYTE[self.point_format])
        kinds, at = zip(*fields.values(), strict=True)
        return np.dtype({"names": [*fields], "formats": kinds, "offsets": at, "itemsize": self.record_size})

    @property
    def num_extra(self) -> int:
        """Extra bytes of a record."""
        return self.record_size - RECORD_SIZES[self.point_format]

    @property
    def has_colors(self) -> bool:
        """True if the records have fields for colours, even if these are empty."""
        return self.point_format in COLORS_BYTE


def read_header(path: Path) -> LasHeader:
    """Return the header of a LAS or LAZ file; InputError if it is broken or promises too much."""
    with path.open("rb") as file:
        head = file.read(MIN_HEADER_SIZE_1_4)
    if not head.startswith(MAGIC) or len(head) < MIN_HEADER_SIZE:
        wanted = f"wanted 'LASF' and a header of {MIN_HEADER_SIZE} bytes or more"
        raise InputError(f"{path}: begins with {head[:4]!r} and {len(head)} bytes, {wanted}")
    major, minor = head[24:26]
    sizes = struct.unpack_from("<HIIBHI", head, 94)
    header_size, points_offset, num_vlrs, format_id, record_size, num_points = sizes
    if minor >= 4:
        num_points = int.from_bytes(head[247:255], "little") or num_points
    scales, offsets = np.frombuffer(head, "<f8", 6, 131).reshape(2, 3)
    size = path.stat().st_size
    point_format = format_id & ~COMPRESSED_BIT
    is_compressed = format_id >= 0x80
    if major != 1 or minor > 5:
        raise InputError(f"{path}: found LAS {major}.{minor}, wanted LAS 1.0 to 1.5")
    least = MIN_HEADER_SIZE_1_4 if minor >= 4 else MIN_HEADER_SIZE
    if not least <= header_size <= points_offset <= size:
        found = f"a header of {header_size} bytes and points from byte {points_offset} on"
        raise InputError(f"{path}: {found}, wanted {least} or more and points within the file's {size} bytes")
    least = RECORD_SIZES.get(point_format, 0)
    if least == 0 or record_size < least:
        wrong = f"records of {record_size} bytes, wanted {least} or more in point format {point_format}"
        raise InputError(f"{path}: {wrong if least else f'unknown point format {point_format}, {WANTED}'}")
    if not (np.isfinite([scales, offsets]).all() and scales.all()):
        raise InputError(f"{path}: scales {scales} and offsets {offsets}, wanted finite ones and no scale 0")
    room = (size - points_offset) // record_size
    found = f"promises {num_points} points of {record_size} bytes, found room for {room}"
    is_cut = num_points > room and not is_compressed
    if num_points == 0 or (is_cut and room < WORTH * num_points):
        raise InputError(f"{path}: the header {found}; the file is cut off or broken")
    return LasHeader(
        path, size, header_size, points_offset, num_vlrs, point_format, record_size,
        room if is_cut else num_points, scales, offsets, is_compressed,
        (f"{path}: the header {found}; read up to there",) if is_cut else (),
    )  # fmt: skip


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


def record_content(header: LasHeader, file: BinaryIO, wanted_user: bytes, wanted_id: int) -> bytes | None:
    """Return the content of the variable-length record with a user and id; None if there is none."""
    position = header.header_size
    for _ in range(min(header.num_vlrs, MAX_VLRS)):
        if position + VLR_HEADER.size > header.points_offset:
            break
        file.seek(position)
        user, record_id, length = VLR_HEADER.unpack(file.read(VLR_HEADER.size))
        position += VLR_HEADER.size + length
        if user.rstrip(b"\0") == wanted_user and record_id == wanted_id:
            return file.read(length)
    return None


def read_crs(path: Path) -> str:
    """Return the coordinate system that a file names, as WKT or EPSG:code; empty if it names none."""
    header = read_header(path)
    with path.open("rb") as file:
        wkt = record_content(header, file, PROJECTION_USER, WKT_ID)
        keys = record_content(header, file, PROJECTION_USER, GEO_KEYS_ID) or b""
    if wkt:
        return wkt.rstrip(b"\0").decode(errors="replace")
    entries = list(struct.iter_unpack("<4H", keys[: len(keys) // 8 * 8]))[1:]
    codes = {key: value for key, place, _, value in entries if place == 0}
    code = codes.get(PROJECTED_KEY, codes.get(GEOGRAPHIC_KEY, 0))
    return f"EPSG:{code}" if 0 < code < USER_DEFINED else ""


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


def open_las(path: Path, options: CloudSettings = IN_METRES, channel: Channel = "colors") -> PointSource:
    """Return the points of a LAS or LAZ file; withheld ones are left out.

    Colours are 16-bit, as the format says, unless a million points, spread evenly over the file, tell of
    another range. If all of these points are black, the file counts as one without colours.
    """
    header = read_header(path)
    layout = read_laz_layout(header) if header.is_compressed else _plain_layout(header)
    field = "class" if options.labels or channel == "shape" else {"colors": "rgb"}.get(channel, "intensity")
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
    most = max(1, min(CHUNK, MAX_SAMPLES // NUM_SAMPLE_RUNS, MAX_CHUNK_SIZE // header.record_size))
    counts = [most] * (header.num_points // most) + [header.num_points % most]
    chunks = tuple((count, count * header.record_size) for count in counts if count)
    return LasLayout(header.points_offset, chunks)


def _chunks(header: LasHeader, layout: LasLayout, is_sample: bool = False) -> Iterator[Records]:
    """Yield all records, CHUNK or fewer at once; for a sample about MAX_SAMPLES, spread over the file."""
    counts, sizes = np.array(layout.chunks, dtype=np.int64).T
    offsets = layout.offset + np.cumsum(sizes) - sizes
    if is_sample and header.num_points > MAX_SAMPLES:
        num_runs = min(max(2, MAX_SAMPLES // int(counts.max())), len(counts))
        firsts = np.linspace(0, len(counts) - 1, num_runs).astype(np.int64)
        ends = firsts + 1
    else:  # chunks read at once
        most = max(1, min(CHUNK, MAX_CHUNK_SIZE // header.record_size))
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
            for begin in range(0, len(records), CHUNK):
                yield records[begin : begin + CHUNK]


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
