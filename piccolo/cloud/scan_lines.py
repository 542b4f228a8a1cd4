"""The lines of a text file taken one after another, for formats whose headers stand between the points."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .colors import BRIGHTEST, in_words, to_bytes
from .raw import RawCloud
from .rows import NOT_A_NUMBER, PARSED, SPACE, TOO_FEW, TOO_MANY, parse_rows
from .text import quoted

MAX_LINE_SIZE = 1000  # [byte] of a header's line
NO_COLUMNS = np.empty(0, dtype=np.int64)


@dataclass
class TextLines:
    """Where a reader is in a file; lines that are blank or begin with # or // never count as points."""

    path: Path
    data: NDArray[np.uint8]  # the whole file
    wanted: str  # the end of every message
    position: int = 0  # [byte] where the next line begins
    num_lines: int = 0  # before it

    def take_line(self) -> bytes | None:
        """The next line that is neither blank nor a comment, at most MAX_LINE_SIZE of it; None at the end."""
        num_rows, num_lines, end, _ = self._parse(NO_COLUMNS, False, np.empty((1, 0)))
        begin = max(self.position, end - MAX_LINE_SIZE)
        self.position, self.num_lines = end, self.num_lines + num_lines
        return bytes(self.data[begin:end]).splitlines()[-1].strip() if num_rows else None

    def copy(self) -> "TextLines":
        """The same place in the same file."""
        return replace(self)

    def skip_points(self, count: int) -> int:
        """The number of lines passed over: `count`, or as many as are left."""
        count = min(count, len(self.data))
        num_rows, num_lines, self.position, _ = self._parse(NO_COLUMNS, False, np.empty((count, 0)))
        self.num_lines += num_lines
        return num_rows

    def line_number(self, row: int) -> int:
        """Number in the file of the line from which row `row` will be taken, counted from here."""
        _, num_lines, _, _ = self._parse(NO_COLUMNS, False, np.empty((row + 1, 0)))
        return self.num_lines + num_lines

    def take_points(self, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]) -> RawCloud:
        """The points of the next lines, colours 0-255, at most as many as `rows` (N, 6) holds.

        `targets` and `is_exact` are those of parse_rows. Fewer come at the file's end or before a broken
        line, which is refused when it is the first.
        """
        before = self.copy()
        num_rows = self.take_rows(targets, is_exact, rows)
        points_world = rows[:num_rows, :3].copy()
        colors, wrong = to_bytes(rows[:num_rows, 3:], points_world, BRIGHTEST["u1"])
        if wrong >= 0:
            raise InputError(
                f"{self.path}: line {before.line_number(wrong)} has the colour {in_words(rows[wrong, 3:])}, "
                f"{self.wanted}"
            )
        return RawCloud(points_world, colors)

    def take_rows(self, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]) -> int:
        """Fill `rows` as parse_rows does and step behind the last line filled; the number filled."""
        num_rows, num_lines, self.position, status = self._parse(targets, is_exact, rows)
        self.num_lines += num_lines
        if status != PARSED and num_rows == 0:
            raise InputError(self._complaint(status, len(targets)))
        self.num_lines -= status != PARSED  # the broken line is still to come
        return num_rows

    def _parse(
        self, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]
    ) -> tuple[int, int, int, int]:
        num_rows, num_lines, position, status = parse_rows(
            self.data, self.position, SPACE, targets, is_exact, rows
        )
        return int(num_rows), int(num_lines), int(position), int(status)

    def _complaint(self, status: int, num_columns: int) -> str:
        what = {
            NOT_A_NUMBER: "is not all numbers",
            TOO_FEW: f"has fewer than {num_columns} columns",
            TOO_MANY: f"has more than {num_columns} columns",
        }[status]
        line = quoted(bytes(self.data[self.position : self.position + 400]))
        return f"{self.path}: line {self.num_lines} {what}: {line}, {self.wanted}"


def mapped(path: Path) -> NDArray[np.uint8]:
    """The bytes of a file, read when they are looked at; no file of size 0 can be mapped."""
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty, wanted lines of numbers")
    return np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
