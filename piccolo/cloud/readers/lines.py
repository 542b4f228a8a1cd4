"""Files of lines of numbers, a block at a time, whatever their size.

Not by a map of the file, which a cut would turn deadly.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .reader import CUT
from .rows import PARSED, SPACE, parse_rows

BLOCK = 1 << 20  # bytes that are read at once, few enough to stay in the cache; no line is longer
MAX_LINE_SIZE = 1000  # [byte] of a header's line
NO_COLUMNS = np.empty(0, dtype=np.int64)


def line_blocks(path: Path, start: int) -> Iterator[NDArray[np.uint8]]:
    """Yield the lines from byte `start` on, some whole lines at a time; the last may have no end."""
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
            if end:
                yield np.frombuffer(data, np.uint8, end)
        if file.tell() < size:
            raise InputError(f"{path}: {CUT}")
    if rest:
        yield np.frombuffer(rest, np.uint8)


class LineReader:
    """Rows of numbers from the lines of a file, from byte `start` on.

    Lines that are blank or begin with # or // are counted, but hold no row.
    """

    def __init__(self, path: Path, start: int = 0, separator: int = SPACE) -> None:
        self.path = path
        self.separator = separator  # byte between fields
        self.blocks = line_blocks(path, start)
        self.data = np.empty(0, np.uint8)
        self.begin = start  # [byte] of `data` in the file
        self.position = 0  # [byte] in `data`: what comes next
        self.num_lines = 0  # read so far

    def read(self, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]) -> tuple[int, int]:
        """Fill `rows` (R, C) as parse_rows does; how many were filled, fewer at the file's end, and a status.

        With C = 0 lines are passed over, and `rows` takes no memory.
        """
        num_rows, status = 0, PARSED
        while num_rows < len(rows) and status == PARSED and self._has_more():
            filled, num_lines, self.position, status = parse_rows(
                self.data, self.position, self.separator, targets, is_exact, rows[num_rows:]
            )
            num_rows += filled
            self.num_lines += num_lines
        return num_rows, status

    def skip(self, count: int) -> int:
        """Pass over lines that hold rows; how many: `count`, or as many as are left."""
        return self.read(NO_COLUMNS, False, np.empty((count, 0)))[0]

    def next_line(self) -> bytes | None:
        """The line that holds the next row, or MAX_LINE_SIZE of it; None at the end."""
        while self._has_more():
            is_found, num_lines, end, _ = parse_rows(
                self.data, self.position, self.separator, NO_COLUMNS, False, np.empty((1, 0))
            )
            if is_found:
                begin = max(self.position, end - MAX_LINE_SIZE)
                return bytes(self.data[begin:end]).splitlines()[-1].strip()
            self.position = end
            self.num_lines += num_lines
        return None

    def take_line(self) -> bytes | None:
        """The same line, which is then behind the reader."""
        line = self.next_line()
        self.skip(1)
        return line

    def _has_more(self) -> bool:
        if self.position >= len(self.data):
            block = next(self.blocks, None)
            if block is None:
                return False
            self.begin += len(self.data)
            self.data, self.position = block, 0
        return True

    @property
    def offset(self) -> int:
        """Of what comes next, in the file [byte]."""
        return self.begin + self.position

    @property
    def has_line_end(self) -> bool:
        """True if the line read last has an end; a file's last line may have none."""
        return bytes(self.data[: self.position][-1:]) in (b"\r", b"\n")

    def line(self) -> bytes:
        """The line that comes next, or much of it: the broken one, after a status below 0."""
        return bytes(self.data[self.position : self.position + 400])


def quoted(line: bytes) -> str:
    """The first line of `line`, short and printable, control characters as escapes."""
    text = line.splitlines()[0] if line else b""
    return ascii(text[:60].decode("latin-1")) + ("..." if len(text) > 60 else "")
