"""Lines of points, and what to say of a broken one."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .colors import BRIGHTEST, in_words, to_bytes
from .lines import LineReader, quoted
from .reader import RawCloud
from .rows import NOT_A_NUMBER, PARSED, SPACE, TOO_FEW, TOO_MANY


class PointLines(LineReader):
    """The lines of a file from byte `start` on, behind `num_lines` others; `wanted` ends every message."""

    def __init__(
        self, path: Path, wanted: str, start: int = 0, num_lines: int = 0, separator: int = SPACE
    ) -> None:
        super().__init__(path, start, separator)
        self.wanted = wanted
        self.num_lines = num_lines

    def copy(self) -> "PointLines":
        """The same place in the same file, which is read anew from there."""
        return PointLines(self.path, self.wanted, self.offset, self.num_lines, self.separator)

    def line_number(self, row: int) -> int:
        """Number in the file of the line that holds row `row`, counted from here; the reader moves there."""
        self.skip(row + 1)
        return self.num_lines

    def take_rows(self, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]) -> int:
        """Fill `rows` as parse_rows does; the number filled.

        Fewer come at the file's end or before a broken line, which is refused when it is the first.
        """
        num_rows, status = self.read(targets, is_exact, rows)
        if status != PARSED and num_rows == 0:
            raise InputError(self._complaint(status, len(targets)))
        self.num_lines -= status != PARSED  # the broken line is still to come
        return num_rows

    def take_points(self, targets: NDArray[np.int64], is_exact: bool, rows: NDArray[np.float64]) -> RawCloud:
        """The points of the next lines, colours 0-255; `rows` (N, 6) is room for them, else as take_rows."""
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

    def _complaint(self, status: int, num_columns: int) -> str:
        what = {
            NOT_A_NUMBER: "is not all numbers",
            TOO_FEW: f"has fewer than {num_columns} columns",
            TOO_MANY: f"has more than {num_columns} columns",
        }[status]
        return f"{self.path}: line {self.num_lines} {what}: {quoted(self.line())}, {self.wanted}"
