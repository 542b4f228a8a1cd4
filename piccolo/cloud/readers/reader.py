"""Parts that all readers use: chunks of points as in the file, and points from columns of numbers.

Columns are arrays (N,) of x, y, z and red, green, blue, or of x, y, z and a scalar. Colours of any type
become 8 bits; `find_brightest` is the only rule for their range. Intensity becomes a grey. Its unit differs
from scanner to scanner, and a few mirrors outshine everything: so the 1st percentile of a file becomes black,
its 99th white. To find these percentiles of all points, the file is read once more.
"""

import functools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...system.arrays import Array, Bytes, Floats, Mask
from ...system.errors import InputError
from ..cloud_settings import BY_FILE, RANGES, Channel, CloudSettings, UpAxis

HEAD_SIZE = 512  # [byte] of a file, by which its format is known
POINTS_A_CHUNK = 1 << 17  # points of a chunk, at most: so many stay in the processor's cache
MAX_BLOCK_SIZE = 1 << 28  # [byte] read at once, at most: POINTS_A_CHUNK records of 2 kB
MAX_CRS_LENGTH = 20_000  # characters of a coordinate system's description
CUT = "the file was cut while it was read, wanted a whole file"

# Points (N, 3) in the file's unit, float32 if stored as such; and their colours (N, 3), or a scalar (N,).
Part = tuple[NDArray[np.floating[Any]], NDArray[Any]]
PartReader = Callable[[], Iterator[Part]]  # each call begins at the start of the file
# The usual value of full brightness by the type of a field, without its byte order; for other types 255.
USUAL = {"u2": 65535.0, "f2": 1.0, "f4": 1.0, "f8": 1.0}
BYTE_RANGE = 255.0
EXCESS = 1.001  # times full brightness: values up to this are rounded to full brightness
STRAY = 4.0  # times full brightness: values up to this are wrong colours, not signs of a wider range
PACKED_NAMES = ("rgb", "rgba", "color")  # 0xAARRGGBB in one number
SPLAT_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")  # colours of Gaussian splats
FRACTION_NAMES = ("rf", "gf", "bf")  # CloudCompare's, for colours from 0 to 1
COLOR_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("scalar_r", "scalar_g", "scalar_b"),
    FRACTION_NAMES,
    *((name,) for name in PACKED_NAMES),
    SPLAT_NAMES,
)
POINT_NAMES = (("x", "y", "z"), *(("easting", "northing", up) for up in ("elevation", "height", "z")))
Columns = Sequence[NDArray[Any]]
INTENSITY_NAMES = ("intensity", "scalar_intensity", "reflectance", "scalar_reflectance")
DARK_SHARE = 0.01  # fraction of the points that are darker than the intensity that becomes black
BRIGHT_SHARE = 0.99  # and than the one that becomes white
LARGEST = float(np.finfo(np.float32).max)
NUM_LEVEL_BINS = 1 << 16
NUM_COLORED = 6  # columns x y z red green blue
SPLAT_FACTOR = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
GRAY = 128  # level of points of which only the shape is used


class MissingChannelError(InputError):
    """A file is sound but lacks the channel: it has no colours, or no intensity."""


class RawCloud(NamedTuple):
    """Points in the file's order and unit, not yet checked."""

    points_world: Floats  # (N, 3) in the file's unit, NaN if invalid; float32 if stored as such
    colors: Bytes  # (N, 3) RGB


# each call begins at the start of the file; InputError is raised where the data are broken
ChunkReader = Callable[[], Iterator[RawCloud]]


class PointSource(NamedTuple):
    """A file whose header has been checked, and a reader of its points."""

    path: Path
    read_chunks: ChunkReader
    num_points: int | None = None  # to show progress; None if it is known only after reading
    warnings: tuple[str, ...] = ()  # one line each: how the file is read, where that was to be decided
    station_axes: tuple[Array, ...] = ()  # (3,) unit, z axes of scanners with poses, in the file's axes
    up: UpAxis = "z"  # the axis that points up by the format's specification or by convention
    channel: Channel = "colors"  # what is read beside x y z
    units: tuple[float, float, float] = (1.0, 1.0, 1.0)  # [m] of x, y, z
    unit_note: str = ""  # a line for the user on the units, unless they are metres as usual


def quote_line(line: bytes) -> str:
    """Return the first line of `line`, shortened and printable, with control characters escaped."""
    text = line.splitlines()[0] if line else b""
    return ascii(text[:60].decode("latin-1")) + ("..." if len(text) > 60 else "")


def point_label(path: Path, index: int) -> str:
    """Return the name of a point of a file for messages."""
    return f"{path}: point {index + 1}"


def find_fields(names: Collection[str], channel: Channel) -> tuple[str, ...]:
    """Return, of the names of a file's fields, those of x y z and the channel; empty if one is missing.

    Upper and lower case are the same.
    """
    by_lower = {name.lower(): name for name in reversed([*names])}
    wanted: dict[Channel, Sequence[tuple[str, ...]]] = {
        "colors": COLOR_NAMES,
        "intensity": [(name,) for name in INTENSITY_NAMES],
        "shape": [()],
    }
    places, more = (
        next((some for some in choices if by_lower.keys() >= set(some)), None)
        for choices in (POINT_NAMES, wanted[channel])
    )
    return () if places is None or more is None else tuple(by_lower[name] for name in (*places, *more))


def find_brightest(
    path: Path, parts: Iterable[Part], settings: CloudSettings, usual: float = BYTE_RANGE
) -> tuple[float, tuple[str, ...]]:
    """Return the value of full brightness of colours, and a warning if it is not the usual one.

    It is that of the settings, or else the least of 1, 255 and 65535 that no value exceeds by far. Parts are
    read only until one decides: if 65535 is usual by a value above 255, else by one above 1 or a fraction.
    """
    if settings.color_range is not None:
        return settings.color_range, ()
    largest = 0.0
    has_fractions = False
    for points, values in parts:
        of_valid = values[np.isfinite(points).all(axis=1)]
        largest = max(largest, float(np.nanmax(of_valid, initial=0.0)))
        has_fractions = has_fractions or bool(of_valid.dtype.kind == "f" and (of_valid % 1.0 > 0.0).any())
        if largest > BYTE_RANGE or (usual != RANGES[-1] and (largest > 1.0 or has_fractions)):
            break
    limits = [STRAY if has_fractions else EXCESS, STRAY * BYTE_RANGE, np.inf]
    brightest = next(full for full, limit in zip(RANGES, limits, strict=True) if largest <= limit)
    if brightest == usual or largest == 0.0:
        return usual, ()
    found = f"colours are read as 0 to {brightest:g} instead of 0 to {usual:g} (largest value {largest:g})"
    return brightest, (f"{path}: {found}; `color_range` overrules it",)


def color_chunks(parts: Iterable[Part], brightest: float, locate: Callable[[int], str]) -> Iterator[RawCloud]:
    """Yield points with their colours (N, 3), given in any type from 0 to `brightest`, in 8 bits.

    Raise InputError if a colour is out of range; `locate` turns the index of its point into words.
    """
    num_before = 0
    for points_world, values in parts:
        if values.dtype == np.uint8 and brightest == BYTE_RANGE:
            colors = np.array(values, dtype=np.uint8)
        else:  # a point without a finite position, which is dropped later, may have any colour
            is_finite: Mask = np.all(np.isfinite(points_world), axis=1)
            numbers = np.where(is_finite[:, None], values, 0).astype(np.float64) * (BYTE_RANGE / brightest)
            least = BYTE_RANGE * (1.0 - EXCESS)
            is_wrong = ~((numbers >= least) & (numbers <= BYTE_RANGE * EXCESS)).all(axis=1)
            if is_wrong.any():
                wrong = int(np.argmax(is_wrong))
                color = " ".join(f"{value:g}" for value in values[wrong].tolist())
                place = locate(num_before + wrong)
                raise InputError(
                    f"{place} has the colour {color}, wanted 0 to {brightest:g}, or `color_range`"
                )
            colors = np.rint(np.clip(numbers, 0.0, BYTE_RANGE)).astype(np.uint8)
        num_before += len(colors)
        yield RawCloud(points_world, colors)


def read_records(path: Path, offset: int, count: int, dtype: np.dtype[Any]) -> Iterator[NDArray[Any]]:
    """Yield `count` records from byte `offset` on, POINTS_A_CHUNK or fewer at once."""
    most = max(1, min(POINTS_A_CHUNK, MAX_BLOCK_SIZE // dtype.itemsize))
    with path.open("rb") as file:
        file.seek(offset)
        for begin in range(0, count, most):
            yield take_records(file, path, min(most, count - begin), dtype)


def take_records(file: BufferedReader, path: Path, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the next `count` records of a file. Raise InputError if there are fewer."""
    records = np.empty(count, dtype)
    if file.readinto(records.view(np.uint8).data) < records.nbytes:
        raise InputError(f"{path}: {CUT}")
    return records


def in_chunks(columns: Columns) -> Iterator[Columns]:
    """Yield arrays of the same length, POINTS_A_CHUNK or fewer rows at once."""
    for begin in range(0, len(columns[0]), POINTS_A_CHUNK):
        yield [column[begin : begin + POINTS_A_CHUNK] for column in columns]


def points_of(columns: Columns) -> NDArray[np.floating[Any]]:
    """Return the points (N, 3) in the first three columns: float32 if stored as such, else float64."""
    with np.errstate(invalid="ignore"):  # a signalling NaN
        points = np.stack(columns[:3], axis=1)
        return points.astype(np.float32 if points.dtype == np.float32 else np.float64, copy=False)


def color_source(
    path: Path,
    read: PartReader,
    settings: CloudSettings,
    usual: float,
    samples: Iterable[Part] | None = None,
    locate: Callable[[int], str] | None = None,
) -> PointSource:
    """Return points with colours whose range is found by `find_brightest`, from samples or all points."""
    brightest, notes = find_brightest(path, read() if samples is None else samples, settings, usual)
    place = locate or partial(point_label, path)
    return PointSource(path, lambda: color_chunks(read(), brightest, place), warnings=notes)


def make_source(
    path: Path,
    read: PartReader,
    channel: Channel,
    settings: CloudSettings = BY_FILE,
    num_points: int | None = None,
    types: Sequence[str] = (),
) -> PointSource:
    """Return the points that `read` yields with the channel: colours, intensity, or one grey for all.

    Colours are bytes unless `types` names other types, whose range is then found.
    """
    if types and channel == "colors":
        usual = USUAL.get(types[0], BYTE_RANGE) if len({*types}) == 1 else BYTE_RANGE
        samples: list[Part] | None = [] if {*types} == {"u1"} else None
        return color_source(path, read, settings, usual, samples)._replace(num_points=num_points)
    limits = functools.cache(lambda: _limits(read()))
    readers: dict[Channel, ChunkReader] = {
        "colors": lambda: (RawCloud(*part) for part in read()),
        "intensity": lambda: (RawCloud(points, as_gray(values, *limits())) for points, values in read()),
        "shape": lambda: (RawCloud(points, np.full(points.shape, GRAY, np.uint8)) for points, _ in read()),
    }
    return PointSource(path, readers[channel], num_points)


class Table(NamedTuple):
    """Columns of numbers in a file: x y z and those of the channel."""

    path: Path
    read_columns: Callable[[], Iterator[Columns]]  # each call begins at the start of the file
    names: Sequence[str]
    types: Sequence[str]  # as the file declares, without byte order
    num_points: int | None = None

    def source(self, channel: Channel, settings: CloudSettings) -> PointSource:
        """Return the points with the channel; colours may be packed into one number, or those of splats."""
        colors = tuple(name.lower() for name in self.names[3:6])
        types = self.types[3:]
        read = self._read_parts
        if colors == SPLAT_NAMES:
            types = ()
            read = self._read_splats
        elif len(colors) == 1 and colors[0] in PACKED_NAMES:
            if types[0] not in ("f4", "u4", "i4"):
                wrong = f"'{self.names[3]}' is of type {types[0]}"
                raise InputError(f"{self.path}: {wrong}, wanted uint32, int32 or float32")
            types = ()
            read = self._read_packed
        return make_source(self.path, read, channel, settings, self.num_points, types)

    def _read_parts(self) -> Iterator[Part]:
        for columns in self.read_columns():
            is_colored = len(columns) == NUM_COLORED
            more = np.stack(columns[3:], axis=1) if is_colored else columns[-1].astype(np.float64)
            yield points_of(columns), more

    def _read_splats(self) -> Iterator[Part]:
        """Yield the opaque splats: those of opacity 1/2 or more, whose logit is not negative."""
        for columns in self.read_columns():
            is_opaque = (
                columns[6] >= 0.0 if len(columns) > NUM_COLORED else np.ones(len(columns[0]), np.bool_)
            )
            levels = 0.5 + SPLAT_FACTOR * np.stack([column[is_opaque] for column in columns[3:6]], axis=1)
            colors = np.rint(255.0 * np.clip(np.nan_to_num(levels), 0.0, 1.0)).astype(np.uint8)
            yield points_of([column[is_opaque] for column in columns[:3]]), colors

    def _read_packed(self) -> Iterator[Part]:
        """Yield points with colours 0xAARRGGBB in numbers of the declared type, in binary or as text."""
        num_before = 0
        for columns in self.read_columns():
            points = points_of(columns)
            values = columns[3]
            is_text = values.dtype.itemsize != np.dtype(self.types[3]).itemsize
            values = np.where(np.isfinite(points).all(axis=1), values, 0) if is_text else values
            bits, is_right = _find_bits(values, self.types[3], is_text)
            if not is_right.all():
                wrong = int(np.argmin(is_right))
                place = point_label(self.path, num_before + wrong)
                raise InputError(
                    f"{place} has the colour {values[wrong]:g}, wanted 32 bits of type {self.types[3]}"
                )
            num_before += len(bits)
            yield points, np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)


def _find_bits(values: NDArray[Any], type_: str, is_text: bool) -> tuple[NDArray[np.uint32], Mask]:
    """Return the 32 bits (N,) of each number, and a mask (N,) of the numbers that have 32 bits.

    A whole number is taken as the bits even in a field that is declared a float, as some scripts write it: in
    the bits of such a float alpha would be neither 0 nor 255.
    """
    with np.errstate(invalid="ignore"):
        is_whole = (values >= 1 if type_ == "f4" else values >= -(2.0**31)) & (values < 2.0**32)
        is_whole &= values == np.floor(values)
    whole = np.where(is_whole, values, 0).astype(np.int64).astype(np.uint32)
    if type_ != "f4":
        return whole, is_whole
    # alpha 255 and red above 127 make a NaN, whose bits are lost in text
    is_right = (np.abs(values) <= LARGEST) if is_text else np.ones(len(values), np.bool_)
    floats = (
        np.where(is_right, values, 0).astype(np.float32) if is_text else np.ascontiguousarray(values, "=f4")
    )
    return np.where(is_whole, whole, floats.view(np.uint32)), is_right


def as_gray(intensity: Array, low: float, high: float) -> Bytes:
    """Convert intensity (N,) to grey (N, 3): black up to `low` and for NaN, white from `high` on.

    If `low` is not below `high`, all are the same grey as without an intensity.
    """
    if not low < high:
        return np.full((len(intensity), 3), GRAY, np.uint8)
    share = (np.nan_to_num(intensity, nan=low) - low) / (high - low)
    gray = np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    return np.repeat(gray[:, None], 3, axis=1)


def _limits(chunks: Iterator[Part]) -> tuple[float, float]:
    """Return 1st and 99th percentile of the intensity of valid points, within 1 % or exact up to 255."""
    histogram = np.zeros(NUM_LEVEL_BINS, np.int64)  # by the upper half of a float32's bits
    for points, intensity in chunks:
        is_measured = np.isfinite(points).all(axis=1) & np.isfinite(intensity)
        # + 0.0 turns -0.0 into 0.0
        values = (np.clip(intensity[is_measured], -LARGEST, LARGEST) + 0.0).astype(np.float32)
        histogram += np.bincount(values.view(np.uint32) >> 16, minlength=NUM_LEVEL_BINS)
    bits = np.arange(NUM_LEVEL_BINS, dtype=np.uint32) << 16
    levels = bits.view(np.float32)  # in each bin the number nearest to 0
    order = np.argsort(levels)
    total = np.cumsum(histogram[order])
    if total[-1] == 0:  # no valid point: the validator refuses the file
        return 0.0, 1.0
    places = np.searchsorted(total, np.array([DARK_SHARE, BRIGHT_SHARE]) * total[-1])
    low, high = levels[order[places]].tolist()
    return low, high
