"""Outputs of a batch: a stream, or a file that grows and is put in order at the end."""

import os
from collections.abc import Callable

from ..files.line_file import LineFile
from .results_file import Records
from .second_look import parse_line


class StreamOutput:
    """Lines on a stream, in the order of the photos; those behind one that may change wait for it."""

    def __init__(self, write: Callable[[str], object], may_change: bool) -> None:
        self._write = write
        self._may_change = may_change
        self._is_waiting = False
        self._num_written = 0
        self._texts: list[str] = []

    def write(self, text: str) -> None:
        """Write a photo's line, or keep it until the lines before it are final."""
        if not self._may_change:
            self._write(text)
            return
        self._texts.append(text)
        self._is_waiting = self._is_waiting or parse_line(text).may_change
        if not self._is_waiting:
            self.close()

    def texts(self) -> list[str]:
        """Return the lines so far."""
        return self._texts

    def replace(self, number: int, text: str) -> None:
        """Replace a photo's line."""
        self._texts[number] = text

    def close(self) -> None:
        """Write the lines that waited."""
        while self._num_written < len(self._texts):
            self._num_written += 1
            self._write(self._texts[self._num_written - 1])


class FileOutput:
    """Lines in a file, each at once on disk; what replaces others, and the order, follow at the end."""

    def __init__(self, file: LineFile, records: Records) -> None:
        self._file = file
        self._records = records
        self._replaced: dict[int, tuple[int, int]] = {}  # span [byte] of the newer line of a photo

    def begin(self) -> None:
        """Cut off what is no line of an earlier run, before the first is appended."""
        self._file.cut(self._records.size)

    def write(self, text: str) -> None:
        """Append a photo's line."""
        self._file.append(text)

    def _spans(self) -> list[tuple[int, int]]:
        spans = self._records.list_spans(self._file)
        return [self._replaced.get(k, span) for k, span in enumerate(spans)]

    def texts(self) -> list[str]:
        """Return the lines of the photos so far, in their order."""
        with self._file.path.open("rb") as file:
            return [os.pread(file.fileno(), end - begin, begin).decode() for begin, end in self._spans()]

    def replace(self, number: int, text: str) -> None:
        """Append a line that is to replace that of a photo, by its number in the order."""
        begin = self._file.size
        self._file.append(text)
        self._replaced[number] = begin, self._file.size

    def finish(self, keeps_others: bool) -> int:
        """Put the lines into order; returns how many were dropped (`Records.finish`)."""
        return self._records.finish(self._file, self._spans(), keeps_others)


Output = StreamOutput | FileOutput
