"""Lines of numbers, parsed by np.loadtxt a chunk at a time: text files of lines x y z r g b, PTS and PTX.

PTS files have lines x y z intensity r g b after a count of points. PTX files (Leica) have grids of points,
one scan after another. A scan begins with ten lines: columns, rows, the scanner's position, its three axes,
and a 4 x 4 matrix for row vectors: [x y z 1]_world = [x y z 1] @ matrix. Then a line x y z intensity r g b
for each cell.
"""

import math
import os
from collections.abc import Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ...geometry.pose import transform_points
from ..settings import IN_METRES, Channel, CloudSettings
from . import reader
from .reader import MissingChannelError, PointSource, quote_line

BLOCK = 1 << 20  # [byte] read at once; no line is longer
COMMENT_MARKS = (b"#", b"//")
NUM_WITH_INTENSITY = 4  # columns of a line without colours: x y z intensity
NUM_COLUMNS: dict[Channel, int] = {"colors": 6, "intensity": NUM_WITH_INTENSITY, "shape": 3}
HEAD_SIZE = 1 << 16  # bytes in which the header is looked for
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
WANTED = "wanted lines of numbers x y z r g b, with decimal points, colours 0-255"
# What is read of a line of PTS or PTX, by the number of its columns; those behind the seventh are left out.
COLUMNS: dict[Channel, dict[int, tuple[int, ...]]] = {
    "colors": {6: (0, 1, 2, 3, 4, 5), 7: (0, 1, 2, 4, 5, 6)},
    "intensity": dict.fromkeys((NUM_WITH_INTENSITY, 7), (0, 1, 2, 3)),
    "shape": dict.fromkeys(range(3, 8), (0, 1, 2)),
}
PTS_WANTED = "wanted lines x y z intensity r g b or x y z r g b, colours 0-255"
NUMBERS_A_LINE = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
MAX_COUNT_DIGITS = 9
AFFINE = (0.0, 0.0, 0.0, 1.0)  # the matrix' last column
PTX_WANTED = "wanted a PTX file with lines x y z intensity r g b, colours 0-255"


class LineLayout(NamedTuple):
    """The first line of numbers, and the columns of each."""

    columns: tuple[int, ...] = ()  # that are read
    num_columns: int | None = None  # of each line; None: there may be any more than those read
    start: int = 0  # [byte] of the first line
    delimiter: str | None = None  # None: blanks and tabs
    has_counts: bool = False  # a lone whole number counts the lines that follow, and is skipped


def line_blocks(path: Path, start: int) -> Iterator[list[bytes]]:
    """Yield the lines from byte `start` on, some at a time, without their ends (LF, CR LF or CR)."""
    rest = b""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(start)
        while block := file.read(BLOCK):
            data = rest + block
            # A return at the end may be half of a line end: it waits for the next block.
            is_split = data.endswith(b"\r")
            end = 1 + max(data.rfind(b"\n"), data.rfind(b"\r", 0, len(data) - is_split))
            rest = data[end:]
            if len(rest) > BLOCK:
                raise InputError(f"{path}: a line of more than {BLOCK} bytes, wanted lines of a few numbers")
            yield data[:end].splitlines()
        if file.tell() < size:
            raise InputError(f"{path}: {reader.CUT}")
    if rest:
        yield rest.splitlines()


class NumberLines:
    """The lines of numbers in a file, one after the other; blank lines and comments are skipped."""

    def __init__(self, path: Path, layout: LineLayout, wanted: str) -> None:
        self.path = path
        self.layout = layout
        self.wanted = wanted
        self.num_taken = 0
        # not a method, by which lines would hold each other, and the file open
        self._kept = partial(_strip_blanks, has_counts=layout.has_counts)
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
        """Skip `count` lines, or as many as are left, unparsed; return their number."""
        num_skipped = sum(1 for _ in islice(self._lines, count))
        self.num_taken += num_skipped
        return num_skipped

    def read_rows(self, count: int | None = None) -> Iterator[Array]:
        """Yield the wanted columns (R, C) of `count` lines, or of all that are left, CHUNK at once."""
        num_columns = self.layout.num_columns or len(self.layout.columns)
        most = max(1, min(reader.CHUNK, reader.MAX_BLOCK_SIZE // (8 * num_columns)))
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
        except InputError:  # of line_blocks
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
        """Yield the points (N, 3) of the lines that `read_rows` would read, with the other columns.

        These are colours (N, 3), checked to be 0-255, if six columns are read, else the last column (N,).
        """
        first = self.num_taken
        is_colored = len(self.layout.columns) == NUM_COLUMNS["colors"]
        rows = self.read_rows(count)
        parts = ((some[:, :3], some[:, 3:] if is_colored else some[:, -1]) for some in rows)
        if not is_colored:
            return parts
        return reader.color_chunks(parts, reader.BRIGHTEST["u1"], lambda index: self.locate(first + index))

    def locate(self, index: int) -> str:
        """Return the file, and the number in it of the line that follows `index` lines of numbers."""
        for number, _ in islice(self._number_lines(), index, None):
            return f"{self.path}: line {number}"
        raise InputError(f"{self.path}: {reader.CUT}")

    def _number_lines(self) -> Iterator[tuple[int, bytes]]:
        """Read the file again: yield the number in the file and the text of each line of numbers."""
        with self.path.open("rb") as file:
            number = len((file.read(self.layout.start) + b".").splitlines()) - 1
        for lines in line_blocks(self.path, self.layout.start):
            for line in lines:
                number += 1
                yield from ((number, kept) for kept in self._kept([line]))

    def _complaint(self, otherwise: str) -> str:
        """Describe the first broken line after those taken; with `otherwise` if all seem right."""
        for number, line in islice(self._number_lines(), self.num_taken, None):
            if fault := self._fault(line):
                return f"{self.path}: line {number}: {fault} ({quote_line(line)}), {self.wanted}"
        return f"{self.path}: {otherwise}, {self.wanted}"

    def _fault(self, line: bytes) -> str:
        """Describe the fault of a line; empty if it has none."""
        fields = line.decode("latin-1").split(self.layout.delimiter)
        exact = self.layout.num_columns
        columns = self.layout.columns
        num_wanted = max(columns) + 1 if exact is None else exact
        if len(fields) < num_wanted or (exact and len(fields) > exact):
            return f"{len(fields)} instead of {num_wanted} columns"
        parsed = [fields[column] for column in columns] if exact is None else fields
        broken = next((field for field in parsed if not is_number(field)), None)
        return "" if broken is None else f"{quote_line(broken.encode('latin-1'))} is not a number"


def _strip_blanks(lines: list[bytes], has_counts: bool) -> list[bytes]:
    """Strip lines of blanks; return the lines of numbers."""
    return [
        line
        for line in filter(None, map(bytes.strip, lines))
        if not line.startswith(COMMENT_MARKS) and not (has_counts and line.isdigit())
    ]


def is_number(field: str) -> bool:
    """Return True if np.loadtxt reads a field as a number."""
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field  # which Python takes and np.loadtxt does not


def line_source(path: Path, layout: LineLayout, channel: Channel, wanted: str) -> PointSource:
    """Return points of lines x y z r g b, colours 0-255, or of x y z intensity, or of x y z."""
    return reader.make_source(path, lambda: NumberLines(path, layout, wanted).read_points(), channel)


def open_text(path: Path, options: CloudSettings = IN_METRES, channel: Channel = "colors") -> PointSource:
    """Return the points of a text file: whitespace, comma or semicolon between numbers, colours 0-255.

    A header line is skipped. It determines the columns if it names x y z and r g b (or red green blue), or an
    intensity; it names all columns or none. Without one the first six columns are read; four are x y z and
    intensity.
    """
    with path.open("rb") as file:
        layout = _layout(path, file.read(HEAD_SIZE), channel)
    return line_source(path, layout, channel, WANTED)


def _layout(path: Path, head: bytes, channel: Channel) -> LineLayout:
    """Return the layout of a file, from its first lines."""
    if b"\0" in head:
        raise InputError(f"{path}: holds bytes that are no text, {WANTED}")
    start = len(BYTE_ORDER_MARK) if head.startswith(BYTE_ORDER_MARK) else 0
    named: tuple[int, ...] = ()
    header = ""
    num_names = 0
    num_lines = 0
    for line in head[start:].splitlines(keepends=True):
        text = line.decode("latin-1").strip()
        delimiter = next((mark for mark in ";," if mark in text), None)
        fields = text.split(delimiter)
        is_count = len(fields) == 1 and line.strip().isdigit()
        if not line.strip().startswith(COMMENT_MARKS) and not is_count and any(map(is_number, fields)):
            break
        names = [name.strip(' "').lower() for name in text.lstrip("#/ ").split(delimiter)]
        once = [name for name in names if names.count(name) == 1]
        named = tuple(map(names.index, reader.find_fields(once, channel))) or named
        if {*"xyz"} <= {*names}:
            header = text
            num_names = len(names)
        start += len(line)
        num_lines += 1
    else:
        raise InputError(f"{path}: no line of numbers at its beginning, {WANTED}")
    if not named and num_names == len(fields):
        raise MissingChannelError(f"{path}: the columns are {quote_line(header.encode())}, {WANTED}")
    has_intensity = len(fields) == NUM_WITH_INTENSITY and all(map(is_number, fields))
    if not named and channel == "intensity" and not has_intensity:
        raise MissingChannelError(f"{path}: line {num_lines + 1} has {len(fields)} columns and no intensity")
    columns = named or tuple(range(NUM_COLUMNS[channel]))
    if len(fields) <= max(columns):
        found = f"line {num_lines + 1} has {len(fields)} columns (no colours?): {quote_line(line)}"
        error = MissingChannelError if len(fields) >= NUM_COLUMNS["shape"] else InputError
        raise error(f"{path}: {found}, {WANTED}")
    return LineLayout(columns, start=start, delimiter=delimiter)


def open_pts(path: Path, options: CloudSettings = IN_METRES, channel: Channel = "colors") -> PointSource:
    """Return the points of all scans of a PTS file.

    All lines must have as many columns as the first one: six are x y z r g b, more are x y z intensity r g b
    and others. The intensity may have any range. A lone count may precede any line; it is not compared with
    the number of lines, as many programs write a wrong one.
    """
    lines = NumberLines(path, LineLayout(has_counts=True), PTS_WANTED)
    line = lines.peek()
    if line is None:
        raise InputError(f"{path}: no line of numbers, {PTS_WANTED}")
    num_columns = len(line.split())
    columns = COLUMNS[channel].get(min(num_columns, 7))
    if columns is None:
        lacking = "colours" if channel == "colors" else channel
        found = f"{num_columns} columns, no {lacking}: {quote_line(line)}"
        error = MissingChannelError if min(num_columns, 7) in COLUMNS["shape"] else InputError
        raise error(f"{lines.locate(0)} has {found}, {PTS_WANTED}")
    return line_source(path, LineLayout(columns, num_columns, has_counts=True), channel, PTS_WANTED)


class PtxScan(NamedTuple):
    """A scan's number of points and its transform to the world."""

    num_points: int  # lines in the file, with or without a return
    T_world_from_scanner: Array  # (4, 4)


def open_ptx(path: Path, options: CloudSettings = IN_METRES, channel: Channel = "colors") -> PointSource:
    """Return the points of all scans of a PTX file, in the world.

    0 0 0 means that no beam came back, and is left out. A last scan with fewer lines than its header promises
    is read up to its end, with a warning; a last line without a line end is then left out as cut off.
    """
    lines = NumberLines(path, LineLayout(), PTX_WANTED)
    scans: list[PtxScan] = []
    warnings: list[str] = []
    while (scan := _take_header(lines)) is not None:
        last_of_header = lines.num_taken - 1
        if not scans and len((lines.peek() or b"").split()) == NUM_WITH_INTENSITY and channel == "colors":
            raise MissingChannelError(f"{path}: has intensity and no colours, {PTX_WANTED}")
        found = lines.skip(scan.num_points)
        if found < scan.num_points:
            found -= bool(found) and not _ends_with_a_line_end(path)
            promised = f"ends a header that promises {scan.num_points} points, found {found}"
            warnings.append(f"{lines.locate(last_of_header)} {promised}; the file may be cut off")
        scans.append(scan._replace(num_points=found))
    if not scans:
        raise InputError(f"{path}: no line of numbers, {PTX_WANTED}")
    layout = LineLayout(COLUMNS["colors" if channel == "colors" else "intensity"][7])
    read = partial(_read_scans, path, layout, scans)
    source = reader.make_source(path, read, channel, num_points=sum(scan.num_points for scan in scans))
    poses = [scan.T_world_from_scanner for scan in scans]
    axes = [T[:3, 2] for T in poses if not np.array_equal(T, np.eye(4)) and np.linalg.norm(T[:3, 2]) > 0.0]
    station_axes = tuple(z / float(np.linalg.norm(z)) for z in axes)
    return source._replace(warnings=tuple(warnings), station_axes=station_axes)


def has_ptx_magic(head: bytes) -> bool:
    """Return True if the bytes `head` begin with counts of columns and rows and a position."""
    lines = [line.strip() for line in head.splitlines()[:3]]
    return len(lines) == 3 and None not in map(_numbers, lines, NUMBERS_A_LINE)


def _take_header(lines: NumberLines) -> PtxScan | None:
    """Return the next scan by its header; None at the end."""
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
    if tuple(matrix[:, 3]) != AFFINE:
        column = " ".join(f"{value:g}" for value in matrix[:, 3])
        place = f"{lines.locate(lines.num_taken - 1)} ends a matrix with the last column"
        raise InputError(f"{place} {column}, wanted 0 0 0 1")
    return PtxScan(int(numbers[0][0]) * int(numbers[1][0]), matrix.T)


def _numbers(line: bytes, num_wanted: int) -> list[float] | None:
    """Return the finite numbers of a header's line; None if it has others. A single one is a count."""
    fields = line.split()
    if num_wanted == 1 and not (line.isdigit() and len(line) <= MAX_COUNT_DIGITS):
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


def _read_scans(path: Path, layout: LineLayout, scans: list[PtxScan]) -> Iterator[reader.Part]:
    """Yield points (N, 3) whose beam came back, in the world, and their colours (N, 3) or intensity (N,)."""
    lines = NumberLines(path, layout, PTX_WANTED)
    for scan in scans:
        lines.skip(len(NUMBERS_A_LINE))
        for points, values in lines.read_points(scan.num_points):
            is_return = np.any(points != 0.0, axis=1)
            returned: Array = points[is_return].astype(np.float64, copy=False)
            with np.errstate(invalid="ignore", over="ignore"):  # infinite points are left out later
                yield transform_points(returned, scan.T_world_from_scanner), values[is_return]
