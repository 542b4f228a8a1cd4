"""Files of lines of numbers, a block at a time, whatever their size."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .rows import PARSED, parse_rows

BLOCK = 1 << 23  # bytes that are read at once; no line is longer


def line_blocks(path: Path, start: int) -> Iterator[NDArray[np.uint8]]:
    """Yield the lines from byte `start` on, some whole lines at a time; the last may have no end."""
    rest = b""
    with path.open("rb") as file:
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
    if rest:
        yield np.frombuffer(rest, np.uint8)


class LineReader:
    """Rows of numbers from the lines of a file, from byte `start` on."""

    def __init__(self, path: Path, start: int) -> None:
        self.blocks = line_blocks(path, start)
        self.data = np.empty(0, np.uint8)
        self.begin = start  # [byte] of `data` in the file
        self.position = 0  # [byte] in `data`: what comes next
        self.num_lines = 0  # read so far

    def read(
        self, separator: int, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]
    ) -> tuple[int, int]:
        """Fill `rows` (R, C) as parse_rows does; how many were filled, fewer at the file's end, and a status.

        With C = 0 lines are passed over, and `rows` takes no memory.
        """
        num_rows, status = 0, PARSED
        while num_rows < len(rows) and status == PARSED and self._has_more():
            filled, num_lines, self.position, status = parse_rows(
                self.data, self.position, separator, targets, is_exact, rows[num_rows:]
            )
            num_rows += filled
            self.num_lines += num_lines
        return num_rows, status

    def _has_more(self) -> bool:
        if self.position >= len(self.data):
            self.begin += len(self.data)
            self.data, self.position = next(self.blocks, self.data[:0]), 0
        return len(self.data) > 0

    @property
    def offset(self) -> int:
        """Of what comes next, in the file [byte]."""
        return self.begin + self.position

    def line(self) -> bytes:
        """The line that comes next, or much of it: the broken one, after a status below 0."""
        return bytes(self.data[self.position : self.position + 400])
