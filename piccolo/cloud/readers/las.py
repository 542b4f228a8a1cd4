"""LAS and LAZ files: positions with colours or intensities; laspy with lazrs decompresses LAZ."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...system.errors import InputError, import_optional
from ..cloud_settings import BY_FILE, Channel, CloudSettings
from . import reader
from .las_file import VLR_HEADER, WANTED, LasHeader, find_units, read_las_header
from .reader import MAX_BLOCK_SIZE, POINTS_A_CHUNK, MissingChannelError, PointSource, quote_line

# The fields that are decompressed in point formats 6 to 10, where others can be skipped.
SELECTED = ("XY_RETURNS_CHANNEL", "Z", "INTENSITY", "FLAGS", "RGB")
# The bit of withheld points in the byte of flags.
WITHHELD_OLD = 0x80  # in point formats 0 to 5
WITHHELD = 0x04  # in point formats 6 to 10
OFFSET_SIZE = 8  # [byte] of the number, before the first chunk, that says where the chunk table is
BROKEN = "the file is cut off or broken"
MAX_LAS_SAMPLES = 1 << 20  # points by which the range of colours is found
POINTS_A_SAMPLE = 1 << 14  # of these, consecutive ones
POINTS_A_LAZ_CHUNK = 50_000  # that are usually compressed together: samples begin at such chunks

Records = NDArray[np.void]
Run = tuple[int, int]  # first point, number of points

logging.getLogger("laspy").addHandler(logging.NullHandler())  # else Python prints laspy's messages


def open_las(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of a LAS or LAZ file without those that are withheld.

    Colours are 16-bit, as the format says, unless a million points, spread evenly over the file, have a
    smaller range. If all of these points are black, the file counts as one without colours.
    """
    header = read_las_header(path)
    source = _open(header, options, channel)
    if options.scale is not None:
        return source
    units, note = find_units(header)
    return source._replace(units=units, unit_note=note)


def _open(header: LasHeader, options: CloudSettings, channel: Channel) -> PointSource:
    """Return the points of a file in the file's unit."""
    path = header.path
    field = "rgb" if channel == "colors" else "intensity"
    read = partial(_read, header, field)
    if channel == "shape":
        next(read(), None)  # refuses a file that can't be read
        source = reader.make_source(path, read, channel, options, header.num_points)
        return source._replace(warnings=header.warnings)
    if field == "rgb" and not header.has_colors:
        raise MissingChannelError(f"{path}: point format {header.point_format} has no colours, {WANTED}")
    samples = [part for part in _read(header, field, is_sample=True) if len(part[1])]
    if not any(values.any() for _, values in samples):
        is_zero = f"0 in all {sum(len(values) for _, values in samples)} points checked"
        what = f"has no colours: red green blue are {is_zero}, {WANTED}"
        raise MissingChannelError(f"{path}: {what if field == 'rgb' else f'the intensity is {is_zero}'}")
    if field == "intensity":
        source = reader.make_source(path, read, channel, options, header.num_points)
        return source._replace(warnings=header.warnings)
    source = reader.color_source(path, read, options, reader.USUAL["u2"], samples)
    return source._replace(num_points=header.num_points, warnings=(*header.warnings, *source.warnings))


def _all_runs(header: LasHeader) -> Iterator[Run]:
    """Yield runs that together are all points; each is read at once."""
    most = max(1, min(POINTS_A_CHUNK, MAX_BLOCK_SIZE // header.record_size))
    for first in range(0, header.num_points, most):
        yield first, min(most, header.num_points - first)


def _sample_runs(header: LasHeader) -> Iterator[Run]:
    """Yield runs, spread over the file, of about MAX_LAS_SAMPLES points in all."""
    size = POINTS_A_LAZ_CHUNK if header.is_compressed else POINTS_A_SAMPLE
    last = (header.num_points - 1) // size
    for number in np.unique(np.linspace(0, last, max(2, MAX_LAS_SAMPLES // size)).astype(np.int64)).tolist():
        yield number * size, min(size, header.num_points - number * size)


def _plain_records(header: LasHeader, runs: Iterator[Run]) -> Iterator[Records]:
    """Yield the records of runs in a file that is not compressed."""
    with header.path.open("rb") as file:
        for first, count in runs:
            file.seek(header.points_offset + first * header.record_size)
            data = file.read(count * header.record_size)
            if len(data) < count * header.record_size:
                raise InputError(f"{header.path}: {reader.CUT}")
            yield np.frombuffer(data, header.dtype)


def _decompress(header: LasHeader, runs: Iterator[Run]) -> Iterator[Records]:
    """Yield the records of runs in a compressed file."""
    laspy = import_optional(header.path, "laspy")
    import_optional(header.path, "lazrs")
    selected = laspy.DecompressionSelection.base()
    for name in SELECTED:
        selected |= laspy.DecompressionSelection[name]
    _check_sizes(header)
    with _refusing(header.path):
        file = laspy.open(header.path, read_evlrs=False, decompression_selection=selected)
    with file:
        for first, count in runs:
            with _refusing(header.path):
                if file.points_read != first:
                    file.seek(first)
                records = file.read_points(count).array
            yield records.view(header.dtype)


def _check_sizes(header: LasHeader) -> None:
    """Refuse impossible sizes, for which laspy and lazrs would read or allocate without end.

    A writer that can't seek back writes the position of the chunk table into the last bytes of the file.
    """
    most = (header.points_offset - header.header_size) // VLR_HEADER.size
    if header.num_vlrs > most:
        wrong = f"promises {header.num_vlrs} records before the points, found room for {most}"
        raise InputError(f"{header.path}: the header {wrong}; {BROKEN}")
    first = header.points_offset + OFFSET_SIZE
    last = header.size - OFFSET_SIZE
    with header.path.open("rb") as file:
        for place in (header.points_offset, last):
            file.seek(place)
            table = int.from_bytes(file.read(OFFSET_SIZE), "little", signed=True)
            if table >= first:
                break
        if not first <= table <= last:
            raise InputError(f"{header.path}: no chunk table within the file; {BROKEN}")
        file.seek(table)
        num_chunks = int.from_bytes(file.read(OFFSET_SIZE)[4:], "little")
    most = (table - first) // header.record_size  # each chunk begins with a whole point
    if not 0 < num_chunks <= most:
        counts = f"promises {num_chunks} chunks, wanted 1 to {most}"
        raise InputError(f"{header.path}: the chunk table {counts}; {BROKEN}")


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn the errors of laspy and lazrs on broken data into an InputError."""
    try:
        yield
    except (OSError, MemoryError):
        raise
    except BaseException as error:  # Rust panics: not an Exception, and its class can't be imported
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        why = quote_line(str(error).encode())
        raise InputError(f"{path}: the compressed points are broken or cut off ({why})") from error


def _read(header: LasHeader, field: str, is_sample: bool = False) -> Iterator[reader.Part]:
    """Yield the points that are not withheld, in the file's unit, and their colours or intensity."""
    withheld = WITHHELD_OLD if header.point_format < 6 else WITHHELD
    runs = _sample_runs(header) if is_sample else _all_runs(header)
    for run in _decompress(header, runs) if header.is_compressed else _plain_records(header, runs):
        for begin in range(0, len(run), POINTS_A_CHUNK):
            records = run[begin : begin + POINTS_A_CHUNK]
            is_withheld = records["flags"] & withheld > 0
            records = records[~is_withheld] if is_withheld.any() else records
            yield _points_of(records, header), _values_of(records, field)


def _points_of(records: Records, header: LasHeader) -> NDArray[np.float64]:
    """Return the points (N, 3) in the file's unit."""
    points = np.empty((len(records), 3))
    for k in range(3):  # column by column, which is faster
        points[:, k] = records["xyz"][:, k]
    with np.errstate(over="ignore"):  # infinite points are dropped later
        points *= header.scales
    points += header.offsets
    return points


def _values_of(records: Records, field: str) -> NDArray[Any]:
    """Return the colours (N, 3) or the intensity (N,)."""
    if field != "rgb":
        return records[field].astype(np.float64)
    colors = np.empty((len(records), 3), np.uint16)
    for k in range(3):
        colors[:, k] = records[field][:, k]
    return colors
