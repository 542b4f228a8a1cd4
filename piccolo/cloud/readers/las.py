"""LAS and LAZ files: the points' positions and colours."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .intensity import OPTION, intensity_reader
from .labels import label_reader
from .las_header import WANTED, LasHeader, has_las_magic, read_header
from .laz import MAX_CHUNK_SIZE, Compression, decompress, read_compression
from .reader import CHUNK, CUT, PLAIN, CloudFormat, CloudReadOptions, PointSource, PointsWithScalar, RawCloud

WITHHELD_OLD, WITHHELD = 0x80, 0x04  # bits of the flags' byte, in the formats 0-5 and 6-10
CLASS_OLD, CLASS = 0x1F, 0xFF  # bits of the class, in the same
MAX_SAMPLES, NUM_SAMPLE_RUNS = 1 << 20, 64
TO_8_BIT = ((np.arange(1 << 16, dtype=np.uint32) * 255 + 32767) // 65535).astype(np.uint8)

Records = NDArray[np.void]


@dataclass(frozen=True)
class LasRun:
    """Records that follow each other in the file and are read at once."""

    num_points: int
    offset: int  # [byte]
    size: int  # [byte]
    chunks: tuple[tuple[int, int], ...] = ()  # of LAZ: the points and bytes of each


def open_las(path: Path, options: CloudReadOptions = PLAIN) -> PointSource:
    """The points of a LAS or LAZ file; withheld ones are left out.

    Colours are 16-bit, as the format says. They are taken for 8-bit if none of a million points, spread
    evenly over the file, exceeds 255; the source's warnings then say so, and a larger value met later is
    refused. If all of those points are black, the file has no colours, as in point formats without them.
    """
    header = read_header(path)
    compression = read_compression(header) if header.is_compressed else None
    if options.labels:
        read_chunks = label_reader(path, lambda: _read_scalar(header, compression, "class"), options.labels)
        return PointSource(path, read_chunks, header.num_points)
    brightest, num_samples = _largest(header, compression, "rgb") if header.has_colors else (0, 0)
    if brightest == 0:
        return _gray_source(header, compression, options, num_samples)
    warnings = []
    if is_8_bit := brightest <= 255:
        warnings.append(
            f"{path}: the colours are read as 8-bit values in 16-bit fields (largest value {brightest} in "
            f"{num_samples} points looked at)"
        )
    return PointSource(
        path,
        lambda: (_cloud(header, records, is_8_bit) for records in _chunks(header, compression)),
        header.num_points,
        tuple(warnings),
    )


def _gray_source(
    header: LasHeader, compression: Compression | None, options: CloudReadOptions, num_samples: int
) -> PointSource:
    """The points with their intensity for a gray, if that is wanted, of a file without colours."""
    if not options.intensity_as_gray:
        why = f"red green blue are 0 in all {num_samples} points looked at"
        if not header.has_colors:
            why = f"point format {header.point_format} has intensity only"
        largest, num_samples = _largest(header, compression, "intensity")
        if largest == 0:
            why += f"; its intensity is 0 in all {num_samples} points looked at"
            raise InputError(f"{header.path}: has neither colours nor intensity: {why}, {WANTED}")
        raise InputError(f"{header.path}: has intensity and no colours: {why}, {WANTED}; {OPTION}")
    read_chunks = intensity_reader(header.path, lambda: _read_scalar(header, compression, "intensity"))
    return PointSource(header.path, read_chunks, header.num_points)


def _runs(header: LasHeader, compression: Compression | None) -> Iterator[LasRun]:
    """All points in order, CHUNK or fewer at once unless one chunk of LAZ holds more."""
    most = max(1, min(CHUNK, MAX_CHUNK_SIZE // header.record_size))
    if compression is None:
        for first in range(0, header.num_points, most):
            yield _plain_run(header, first, most)
        return
    offset, size, num_points = compression.offset, 0, 0
    waiting: list[tuple[int, int]] = []
    for chunk in compression.chunks:
        if waiting and num_points + chunk[0] > most:
            yield LasRun(num_points, offset, size, tuple(waiting))
            offset, size, num_points, waiting = offset + size, 0, 0, []
        waiting.append(chunk)
        num_points += chunk[0]
        size += chunk[1]
    yield LasRun(num_points, offset, size, tuple(waiting))


def _plain_run(header: LasHeader, first: int, count: int) -> LasRun:
    count = min(count, header.num_points - first)
    return LasRun(count, header.points_offset + first * header.record_size, count * header.record_size)


def _sample_runs(header: LasHeader, compression: Compression | None) -> Iterator[LasRun]:
    """About MAX_SAMPLES points spread evenly over the file, or all if there are no more."""
    if header.num_points <= MAX_SAMPLES:
        yield from _runs(header, compression)
        return
    if compression is None:
        length = MAX_SAMPLES // NUM_SAMPLE_RUNS
        for first in np.linspace(0, header.num_points - length, NUM_SAMPLE_RUNS).astype(np.int64).tolist():
            yield _plain_run(header, first, length)
        return
    chunks = compression.chunks
    offsets = compression.offset + np.cumsum([0, *(size for _, size in chunks)])
    num_runs = min(max(2, MAX_SAMPLES // max(count for count, _ in chunks)), len(chunks))
    for k in np.linspace(0, len(chunks) - 1, num_runs).astype(np.int64).tolist():
        yield LasRun(chunks[k][0], int(offsets[k]), chunks[k][1], (chunks[k],))


def _load(file: BinaryIO, header: LasHeader, compression: Compression | None, run: LasRun) -> Records:
    """The records of a run."""
    file.seek(run.offset)
    data = file.read(run.size)
    if len(data) < run.size:
        raise InputError(f"{header.path}: {CUT}")
    if compression is not None:
        return decompress(header.path, compression, data, run.chunks).view(header.dtype)
    return np.frombuffer(data, dtype=header.dtype)


def _largest(header: LasHeader, compression: Compression | None, name: str) -> tuple[int, int]:
    """The largest `rgb` or `intensity` in a sample of the points, and the number of those."""
    largest = num_samples = 0
    with header.path.open("rb") as file:
        for run in _sample_runs(header, compression):
            records = _load(file, header, compression, run)
            largest = max(largest, int(records[name].max()))
            num_samples += len(records)
    return largest, num_samples


def _chunks(header: LasHeader, compression: Compression | None) -> Iterator[Records]:
    """Yield all records, CHUNK or fewer at once."""
    with header.path.open("rb") as file:
        for run in _runs(header, compression):
            records = _load(file, header, compression, run)
            for first in range(0, len(records), CHUNK):
                yield records[first : first + CHUNK]


def _read_scalar(header: LasHeader, compression: Compression | None, name: str) -> Iterator[PointsWithScalar]:
    """The points with their `intensity` or `class`."""
    bits = 0xFFFF if name == "intensity" else CLASS_OLD if header.point_format < 6 else CLASS
    for records in _chunks(header, compression):
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
        raise InputError(
            f"{header.path}: a colour of {rgb.max()} in a file whose other colours are 8-bit (0 to 255), "
            "wanted the full 16 bits or 8 in all points"
        )
    return RawCloud(points_world, rgb.astype(np.uint8))


LAS = CloudFormat("LAS, LAZ", frozenset({".las", ".laz"}), has_las_magic, open_las, has_labels=True)
