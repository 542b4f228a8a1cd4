"""LAS and LAZ files: the points' positions and colours."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .las_file import (
    MAGIC,
    MAX_CHUNK_SIZE,
    WANTED,
    LasHeader,
    LasLayout,
    decompress,
    read_header,
    read_laz_layout,
)
from .reader import CHUNK, CUT, PLAIN, CloudFormat, CloudReadOptions, PointSource, PointsWithScalar, RawCloud
from .scalars import OPTION, intensity_reader, label_reader

WITHHELD_OLD, WITHHELD = 0x80, 0x04  # bits of the flags' byte, in the formats 0-5 and 6-10
CLASS_OLD, CLASS = 0x1F, 0xFF  # bits of the class, in the same
MAX_SAMPLES, NUM_SAMPLE_RUNS = 1 << 20, 64
TO_8_BIT = ((np.arange(1 << 16, dtype=np.uint32) * 255 + 32767) // 65535).astype(np.uint8)

Records = NDArray[np.void]


def open_las(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The points of a LAS or LAZ file; withheld ones are left out.

    Colours are 16-bit, as the format says. They are taken for 8-bit if none of a million points, spread
    evenly over the file, exceeds 255; the source's warnings then say so, and a larger value met later is
    refused. If all of those points are black, the file has no colours, as in point formats without them.
    """
    header = read_header(path)
    layout = read_laz_layout(header) if header.is_compressed else _plain_layout(header)
    if options.labels:
        read_chunks = label_reader(path, lambda: _read_scalar(header, layout, "class"), options.labels)
        return PointSource(path, read_chunks, header.num_points)
    brightest, num_samples = _largest(header, layout, "rgb") if header.has_colors else (0, 0)
    if brightest == 0:
        return _gray_source(header, layout, options, num_samples)
    is_8_bit = brightest <= 255
    note = f"{path}: the colours are read as 8-bit values in 16-bit fields"
    return PointSource(
        path,
        lambda: (_cloud(header, records, is_8_bit) for records in _chunks(header, layout)),
        header.num_points,
        (f"{note} (largest value {brightest} in {num_samples} points looked at)",) if is_8_bit else (),
    )


def _gray_source(
    header: LasHeader, layout: LasLayout, options: CloudReadOptions, num_samples: int
) -> PointSource:
    """The points with their intensity for a gray, if that is wanted, of a file without colours."""
    if not options.intensity_as_gray:
        why = f"red green blue are 0 in all {num_samples} points looked at"
        if not header.has_colors:
            why = f"point format {header.point_format} has intensity only"
        largest, num_samples = _largest(header, layout, "intensity")
        if largest == 0:
            why += f"; its intensity is 0 in all {num_samples} points looked at"
            raise InputError(f"{header.path}: has neither colours nor intensity: {why}, {WANTED}")
        raise InputError(f"{header.path}: has intensity and no colours: {why}, {WANTED}; {OPTION}")
    read_chunks = intensity_reader(header.path, lambda: _read_scalar(header, layout, "intensity"))
    return PointSource(header.path, read_chunks, header.num_points)


def _plain_layout(header: LasHeader) -> LasLayout:
    """Records that are not compressed, in chunks of which NUM_SAMPLE_RUNS are a sample."""
    most = max(1, min(CHUNK, MAX_SAMPLES // NUM_SAMPLE_RUNS, MAX_CHUNK_SIZE // header.record_size))
    counts = [most] * (header.num_points // most) + [header.num_points % most]
    chunks = tuple((count, count * header.record_size) for count in counts if count)
    return LasLayout(header.points_offset, chunks)


def _chunks(header: LasHeader, layout: LasLayout, is_sample: bool = False) -> Iterator[Records]:
    """Yield all records, CHUNK or fewer at once; as a sample about MAX_SAMPLES, evenly over the file."""
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
                raise InputError(f"{header.path}: {CUT}")
            content: bytes | NDArray[np.uint8] = data
            if layout.laszip:
                content = decompress(header, layout, data, layout.chunks[first:end])
            records = np.frombuffer(content, dtype=header.dtype)
            for begin in range(0, len(records), CHUNK):
                yield records[begin : begin + CHUNK]


def _largest(header: LasHeader, layout: LasLayout, name: str) -> tuple[int, int]:
    """The largest `rgb` or `intensity` in a sample of the points, and the number of those."""
    found = [(int(records[name].max()), len(records)) for records in _chunks(header, layout, is_sample=True)]
    return max(largest for largest, _ in found), sum(count for _, count in found)


def _read_scalar(header: LasHeader, layout: LasLayout, name: str) -> Iterator[PointsWithScalar]:
    """The points with their `intensity` or `class`."""
    bits = 0xFFFF if name == "intensity" else CLASS_OLD if header.point_format < 6 else CLASS
    for records in _chunks(header, layout):
        points_world, kept = _points(header, records)
        yield points_world, (kept[name] & bits).astype(np.float64)


def _points(header: LasHeader, records: Records) -> tuple[NDArray[np.float64], Records]:
    """Positions (N, 3) of the records that are not withheld, and these."""
    withheld = WITHHELD_OLD if header.point_format < 6 else WITHHELD
    is_withheld = (records["flags"] & withheld) != 0
    if is_withheld.any():
        records = records[~is_withheld]
    with np.errstate(over="ignore"):  # to infinity, and such points are dropped
        return records["xyz"] * header.scales + header.offsets, records


def _cloud(header: LasHeader, records: Records, is_8_bit: bool) -> RawCloud:
    points_world, records = _points(header, records)
    rgb = records["rgb"]
    if not is_8_bit:
        return RawCloud(points_world, TO_8_BIT[rgb])
    if (rgb > 255).any():
        raise InputError(f"{header.path}: a colour of {rgb.max()} in a file whose other colours are 8-bit")
    return RawCloud(points_world, rgb.astype(np.uint8))


LAS = CloudFormat(
    "LAS, LAZ", frozenset({".las", ".laz"}), lambda head: head.startswith(MAGIC), open_las, has_labels=True
)
