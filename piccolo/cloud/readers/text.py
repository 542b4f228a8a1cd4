"""Lines of numbers, parsed by np.loadtxt a chunk at a time: text files of lines x y z r g b, PTS and PTX.

PTS files have a count of points, then lines x y z intensity r g b. PTX files (Leica) have grids of points,
one scan after another. A scan begins with ten lines: number of columns, number of rows, the scanner's
position, its three axes, and a 4 x 4 matrix for row vectors, [x y z 1]_world = [x y z 1] @ matrix. A line
x y z intensity r g b follows for each cell of the grid.
"""

import math
import os
from collections.abc import Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...geometry.pose import transform_points
from ...system.arrays import Array
from ...system.errors import InputError
from ...system.files.json_file import is_number
from ..cloud_settings import BY_FILE, Channel, CloudSettings
from . import reader, text_columns
from .reader import MissingChannelError, PointSource, find_brightest, quote_line
from .text_columns import COMMENT_MARKS, Spelling, split, text_blocks

BYTES_AT_ONCE = 1 << 20  # [byte] read at once; much longer lines are refused
NUM_WITH_INTENSITY = 4  # columns of a line without colours: x y z intensity
NUM_POSITION = 3
WANTED = "wanted lines of numbers x y z r g b (`columns` names others)"
PTS_WANTED = "wanted lines x y z intensity r g b or x y z r g b"
PTX_COLUMNS: dict[Channel, tuple[int, ...]] = {
    "colors": (0, 1, 2, 4, 5, 6),
    "intensity": (0, 1, 2, 3),
    "shape": (0, 1, 2, 3),
}
NUMBERS_A_LINE = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)  # in the lines of a scan's header in PTX
MAX_TEXT_COUNT_DIGITS = 9
AFFINE = (0.0, 0.0, 0.0, 1.0)  # last column of a scan's matrix
ROUNDED = 1e-6  # by which its elements may differ from this
PTX_WANTED = "wanted a PTX file with lines x y z intensity r g b"


class LineLayout(NamedTuple):
    """The lines of numbers in a file: where they begin, their columns, and how they are written."""

    columns: tuple[int, ...] = ()  # indices of the columns that are read
    num_columns: int | None = None  # in each line; None: there may be any number beyond those that are read
    start: int = 0  # [byte] of the first line of numbers
    delimiter: str | None = None  # None: blanks and tabs
    spelling: Spelling = Spelling()
    has_counts: bool = False  # lines with a single whole number are counts of lines, and skipped


def line_blocks(path: Path, start: int) -> Iterator[list[bytes]]:
    """Yield lists of lines from byte `start` on, without line ends (LF, CR LF or CR)."""
    rest = b""
    for block in text_blocks(path, BYTES_AT_ONCE, start):
        data = rest + block
        # A CR at the end of a block may be the first half of CR LF: it waits for the next block.
        is_split = data.endswith(b"\r")
        end = 1 + max(data.rfind(b"\n"), data.rfind(b"\r", 0, len(data) - is_split))
        rest = data[end:]
        if len(rest) > 2 * BYTES_AT_ONCE:
            found = f"a line of more than {BYTES_AT_ONCE} bytes"
            raise InputError(f"{path}: {found}, wanted lines of a few numbers")
        yield data[:end].splitlines()
    if rest:
        yield rest.splitlines()


class NumberLines:
    """The lines of numbers in a file, one after the other; blank lines and comments are skipped."""

    def __init__(self, path: Path, layout: LineLayout, wanted: str) -> None:
        self.path = path
        self.layout = layout
        self.wanted = wanted
        self.num_taken = 0
        # not a method: the object would refer to itself and keep the file open
        self._kept = partial(_strip_blanks, layout=layout)
        self._lines = chain.from_iterable(map(self._kept, line_blocks(path, layout.start)))

    def peek(self) -> bytes | None:
        """Return the next line without taking it; None at the end."""
        line = next(self._lines, None)
        if line is not None:
            self._lines = chain([line], self._lines)
        return line

    def take_line(self) -> bytes | None:
        """Take and return the next line; None at the end."""
        line = next(self._lines, None)
        self.num_taken += line is not None
        return line

    def skip(self, count: int) -> int:
        """Skip `count` lines, or all that are left, without parsing them; return their number."""
        num_skipped = sum(1 for _ in islice(self._lines, count))
        self.num_taken += num_skipped
        return num_skipped

    def read_rows(self, count: int | None = None) -> Iterator[Array]:
        """Yield the wanted columns (R, C) of `count` lines, or of all that are left, a chunk at a time."""
        num_columns = self.layout.num_columns or len(self.layout.columns)
        most = max(1, min(reader.POINTS_A_CHUNK, reader.MAX_BLOCK_SIZE // (8 * num_columns)))
        num_rows = 0
        while num_rows != count and self.peek() is not None:
            rows = self._parse(most if count is None else min(most, count - num_rows))
            num_rows += len(rows)
            yield rows
        if num_rows < (count or 0):
            raise InputError(f"{self.path}: found {num_rows} of {count} points; the file is cut off")

    def _parse(self, count: int) -> Array:
        """Return the wanted columns (R, C) of the next lines, `count` or fewer."""
        columns = list(self.layout.columns)
        num_columns = self.layout.num_columns
        usecols = columns if num_columns is None else None
        lines = islice(self._lines, count)
        try:
            rows = np.loadtxt(lines, comments=None, delimiter=self.layout.delimiter, usecols=usecols, ndmin=2)
        except InputError:  # raised by line_blocks
            raise
        except ValueError as error:
            raise InputError(self._complaint(str(error))) from error
        if num_columns is not None:
            if rows.shape[1] != num_columns:
                raise InputError(self._complaint("lines of another length"))
            rows = rows[:, columns]
        self.num_taken += len(rows)
        return rows

    def read_points(self, count: int | None = None) -> Iterator[reader.Part]:
        """Yield the points (N, 3) in the lines that `read_rows` reads, with their other columns.

        These are colours (N, 3) if six columns are read, else the last column (N,) alone.
        """
        is_colored = len(self.layout.columns) == reader.NUM_COLORED
        rows = self.read_rows(count)
        return ((some[:, :3], some[:, 3:] if is_colored else some[:, -1]) for some in rows)

    def locate(self, index: int, num_before: int = 0) -> str:
        """Name the file and the line of the row at an index, counted after `num_before` lines of numbers."""
        for number, _ in islice(self._number_lines(), index + num_before, None):
            return f"{self.path}: line {number}"
        raise InputError(f"{self.path}: {reader.CUT}")

    def _number_lines(self) -> Iterator[tuple[int, bytes]]:
        """Read the file again: yield the line number and the text of each line of numbers."""
        head = next(text_blocks(self.path, text_columns.TEXT_HEAD_SIZE), b"")
        number = len((head[: self.layout.start] + b".").splitlines()) - 1
        for lines in line_blocks(self.path, self.layout.start):
            for line in lines:
                number += 1
                yield from ((number, kept) for kept in self._kept([line]))

    def _complaint(self, otherwise: str) -> str:
        """Return a message on the first broken line after those taken, or `otherwise` if none is broken."""
        for number, line in islice(self._number_lines(), self.num_taken, None):
            if fault := self._fault(line):
                return f"{self.path}: line {number}: {fault} ({quote_line(line)}), {self.wanted}"
        return f"{self.path}: {otherwise}, {self.wanted}"

    def _fault(self, line: bytes) -> str:
        """Describe the fault of a line; empty if it has none."""
        fields = split(line, self.layout.delimiter)
        exact = self.layout.num_columns
        columns = self.layout.columns
        num_wanted = max(columns) + 1 if exact is None else exact
        if len(fields) < num_wanted or (exact and len(fields) > exact):
            return f"{len(fields)} instead of {num_wanted} columns"
        parsed = [fields[column] for column in columns] if exact is None else fields
        broken = next((field for field in parsed if not is_number(field)), None)
        return "" if broken is None else f"{quote_line(broken.encode('latin-1'))} is not a number"


def _strip_blanks(lines: list[bytes], layout: LineLayout) -> list[bytes]:
    """Return those lines that have numbers, stripped of blanks and in plain spelling."""
    return [
        layout.spelling.plain(line)
        for line in filter(None, map(bytes.strip, lines))
        if not line.startswith(COMMENT_MARKS) and not (layout.has_counts and line.isdigit())
    ]


def open_text(
    path: Path, settings: CloudSettings = BY_FILE, channel: Channel = "colors", has_counts: bool = False
) -> PointSource:
    """Return the points of a text file, with whitespace, comma or semicolon between numbers.

    The columns are those that the user names, or those of a header line with names (x y z, r g b or red green
    blue, an intensity). Else they follow from the values of all columns, with a warning unless they are x y z
    r g b. With `has_counts`, as in PTS files, a line with a single whole number may precede any other; it is
    not compared with the number of lines, as many programs write a wrong one. In such files all lines must
    have as many columns as the first one.
    """
    wanted = PTS_WANTED if has_counts else WANTED
    fields = text_columns.read_fields(path, wanted)
    num_columns = len(split(fields.spelling.plain(fields.first), fields.delimiter))
    rows = text_columns.read_samples(path, fields, num_columns)
    header = fields.names if channel == "shape" or len(fields.names) == num_columns else ()
    header = header or (fields.names if reader.find_fields(fields.names, channel) else ())
    names = text_columns.names_of_user(path, settings, num_columns) or header
    note = ""
    if not names:
        names = text_columns.name_columns(rows)
        note = text_columns.note_names(path, names, quote_line(fields.first), has_counts)
    chosen = reader.find_fields([name for name in names if names.count(name) == 1], channel)
    if not chosen or num_columns < NUM_POSITION:
        line = quote_line(fields.first)
        found = f"line {fields.num_lines + 1} has {num_columns} columns (no {channel}?): {line}"
        if fields.names:
            found = f"the columns are {quote_line(fields.header.encode())}"
        error = MissingChannelError if num_columns >= NUM_POSITION else InputError
        raise error(f"{path}: {found}, {wanted}")
    exact = num_columns if has_counts else None
    columns = tuple(names.index(name) for name in chosen)
    layout = LineLayout(columns, exact, fields.start, fields.delimiter, fields.spelling, has_counts)
    is_fraction = path.suffix.lower() == ".xyzrgb" or chosen[3:] == reader.FRACTION_NAMES
    if len(columns) == NUM_WITH_INTENSITY and channel == "colors":  # packed

        def read_columns() -> Iterator[reader.Columns]:
            return (list(some.T) for some in NumberLines(path, layout, wanted).read_rows())

        source = reader.Table(path, read_columns, chosen, ["f8", "f8", "f8", "u4"]).source(channel, settings)
    else:
        lines = NumberLines(path, layout, wanted)

        def read() -> Iterator[reader.Part]:
            return NumberLines(path, layout, wanted).read_points()

        if channel == "colors":
            known = rows[:, columns] if max(columns) < rows.shape[1] else rows[:0, :6]
            parts = chain([(known[:, :3], known[:, 3:])], read())
            usual = 1.0 if is_fraction else reader.BYTE_RANGE
            source = reader.color_source(path, read, settings, usual, parts, lines.locate)
        else:
            source = reader.make_source(path, read, channel, settings)
    return source._replace(warnings=(*filter(None, [note]), *source.warnings))


class PtxScan(NamedTuple):
    """A scan's number of points and columns, and its transform to the world."""

    num_points: int  # lines in the file, including cells without an echo
    num_columns: int  # in its first line of points
    T_world_from_scanner: Array  # (4, 4)


def open_ptx(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of all scans of a PTX file, in the world.

    A point 0 0 0 means that no beam came back; it is left out. If the last scan has fewer lines than its
    header promises, it is read as far as it goes, with a warning; its last line is left out if it has no line
    end, as it may be cut off. Scans without the channel are left out, with a warning.
    """
    lines = NumberLines(path, LineLayout(), PTX_WANTED)
    scans: list[PtxScan] = []
    warnings: list[str] = []
    while (scan := _take_header(lines)) is not None:
        last_of_header = lines.num_taken - 1
        found = lines.skip(scan.num_points)
        if found < scan.num_points:
            found -= bool(found) and not _ends_with_a_line_end(path)
            promised = f"ends a header that promises {scan.num_points} points, found {found}"
            warnings.append(f"{lines.locate(last_of_header)} {promised}; the file may be cut off")
        scans.append(scan._replace(num_points=found))
    if not scans:
        raise InputError(f"{path}: no line of numbers, {PTX_WANTED}")
    kept = [scan for scan in scans if scan.num_columns != NUM_WITH_INTENSITY or channel != "colors"]
    if not kept:
        raise MissingChannelError(f"{path}: has intensity and no colours, {PTX_WANTED}")
    if len(kept) < len(scans):
        warnings.append(f"{path}: {len(scans) - len(kept)} of {len(scans)} scans without colours left out")
    layout = LineLayout(PTX_COLUMNS[channel])
    brightest = None
    if channel == "colors":
        brightest, notes = find_brightest(path, _read_scans(path, layout, scans, None), options)
        warnings += notes
    read = partial(_read_scans, path, layout, scans, brightest)
    source = reader.make_source(path, read, channel, options, sum(scan.num_points for scan in kept))
    poses = [scan.T_world_from_scanner for scan in kept]
    axes = [T[:3, 2] for T in poses if not np.array_equal(T, np.eye(4)) and np.linalg.norm(T[:3, 2]) > 0.0]
    station_axes = tuple(z / float(np.linalg.norm(z)) for z in axes)
    return source._replace(warnings=tuple(warnings), station_axes=station_axes)


def has_ptx_magic(head: bytes) -> bool:
    """Return True if `head`, a file's first bytes, has counts of columns and rows, and a position."""
    lines = [line.strip() for line in head.splitlines()[:3]]
    return len(lines) == 3 and None not in map(_numbers, lines, NUMBERS_A_LINE)


def _take_header(lines: NumberLines) -> PtxScan | None:
    """Take the header of the next scan and return what it says; None at the end."""
    numbers: list[list[float]] = []
    for num_wanted in NUMBERS_A_LINE:
        line = lines.take_line()
        if line is None and not numbers:
            return None
        found = _numbers(line or b"", num_wanted)
        if found is None:
            wanted = "a count" if num_wanted == 1 else f"{num_wanted} numbers"
            place = f"{lines.locate(lines.num_taken - 1)} is {quote_line(line or b'')}"
            raise InputError(f"{place}, wanted {wanted} of a scan's header, {PTX_WANTED}")
        numbers.append(found)
    matrix = np.array(numbers[-4:])
    if not np.allclose(matrix[:, 3], AFFINE, rtol=0.0, atol=ROUNDED):
        column = " ".join(f"{value:g}" for value in matrix[:, 3])
        place = f"{lines.locate(lines.num_taken - 1)} ends a matrix with the last column"
        raise InputError(f"{place} {column}, wanted 0 0 0 1")
    matrix[:, 3] = AFFINE
    num_columns = len((lines.peek() or b"").split())
    return PtxScan(int(numbers[0][0]) * int(numbers[1][0]), num_columns, matrix.T)


def _numbers(line: bytes, num_wanted: int) -> list[float] | None:
    """Return the numbers of a header's line; None if they are not `num_wanted` finite ones.

    A single number must be a count.
    """
    fields = line.split()
    if num_wanted == 1 and not (line.isdigit() and len(line) <= MAX_TEXT_COUNT_DIGITS):
        return None
    try:
        values = [float(field) for field in fields]
    except ValueError:
        return None
    return values if len(values) == num_wanted and all(map(math.isfinite, values)) else None


def _ends_with_a_line_end(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() in (b"\r", b"\n")


def _read_scans(
    path: Path, layout: LineLayout, scans: list[PtxScan], brightest: float | None
) -> Iterator[reader.Part]:
    """Yield the points (N, 3) whose beam came back, in the world, with colours (N, 3) or intensity (N,).

    Colours become bytes if their full brightness is given.
    """
    lines = NumberLines(path, layout, PTX_WANTED)
    is_colored = len(layout.columns) == reader.NUM_COLORED
    for scan in scans:
        lines.skip(len(NUMBERS_A_LINE))
        if is_colored and scan.num_columns == NUM_WITH_INTENSITY:
            lines.skip(scan.num_points)
            continue
        num_before = lines.num_taken
        parts: Iterator[reader.Part] = lines.read_points(scan.num_points)
        if brightest:
            parts = reader.color_chunks(parts, brightest, partial(lines.locate, num_before=num_before))
        for points, values in parts:
            is_return = np.any(points != 0.0, axis=1)
            returned: Array = points[is_return].astype(np.float64, copy=False)
            # No yield within: errstate is a thread's, and another thread may take the next part.
            with np.errstate(invalid="ignore", over="ignore"):  # infinite points are left out later
                points_world = transform_points(returned, scan.T_world_from_scanner)
            yield points_world, values[is_return]
