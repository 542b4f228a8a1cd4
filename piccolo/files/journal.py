"""The steps of a job on disk until its results are whole, so that a stopped job goes on where it was."""

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from .line_file import LineFile, open_locked, whole_lines, whole_size

LINE_BEGINS = b'["'
Kept = TypeVar("Kept")
KEY = "job"  # name of the first step, which tells what job it is


class Journal:
    """The steps that a job has done, in their order, each with a text; without a file nothing is kept."""

    def __init__(self, file: LineFile | None = None, key: str = "", ways: str = "") -> None:
        self._file = file
        self._key = key  # text of the first step
        self._ways = ways  # out of a file of something else
        self._earlier: list[tuple[str, str, int]] = []  # step, text, and end of its line [byte]
        self._num_recalled = 0

    @property
    def is_kept(self) -> bool:
        """True if the steps are on disk."""
        return self._file is not None

    def read(self, file: LineFile) -> None:
        """Read the steps of an earlier run; InputError for what are none."""
        size = whole_size(file.path, LINE_BEGINS, f"steps of a job: {self._ways}")
        end = 0
        for line in whole_lines(file.path, size):
            end += len(line)
            try:
                step, text = json.loads(line)
            except ValueError as error:
                raise self._damaged(error) from error
            self._earlier.append((str(step), str(text), end))

    def recall(self, steps: Iterable[str], take: Callable[[int, str], Kept]) -> list[Kept]:
        """Return what `take` makes of numbers and texts of the next steps, up to one that is not done.

        What an earlier run did instead, and after it, is forgotten. `take` raises ValueError for a damaged
        text.
        """
        taken: list[Kept] = []
        for number, step in enumerate(steps):
            if self._num_recalled == len(self._earlier) or self._earlier[self._num_recalled][0] != step:
                self.forget_rest()
                break
            try:
                taken.append(take(number, self._earlier[self._num_recalled][1]))
            except ValueError as error:
                raise self._damaged(error) from error
            self._num_recalled += 1
        return taken

    def _damaged(self, error: ValueError) -> InputError:
        where = self._file.path if self._file else ""
        return InputError(f"{where}: found a damaged line ({type(error).__name__}); {self._ways}")

    def forget_rest(self) -> None:
        """Forget the steps that were not recalled."""
        del self._earlier[self._num_recalled :]
        if self._file is not None:
            self._file.cut(self._earlier[-1][2] if self._earlier else 0)

    def append(self, step: str, text: str) -> None:
        """Keep the text of a step that is done."""
        if self._file is None:
            return
        if not self._earlier:
            self._append(KEY, self._key)
        self._append(step, text)

    def _append(self, step: str, text: str) -> None:
        assert self._file is not None
        self._file.append(json.dumps([step, text]))
        self._earlier.append((step, "", self._file.size))
        self._num_recalled += 1


@contextmanager
def keeping_steps(path: Path | None, key: dict[str, Any], ways: str, is_new: bool) -> Iterator[Journal]:
    """Yield a journal in a file, with the steps of an earlier run of the same job, unless it begins anew.

    Raises InputError, with the `ways` out, for the file of another job.
    """
    if path is None:
        yield Journal()
        return
    with open_locked(path) as file:
        text = json.dumps(key, sort_keys=True)
        journal = Journal(file, text, ways)
        if not is_new:
            journal.read(file)
        if journal.recall([KEY], lambda _, found: found == text) == [False]:
            raise InputError(f"{path}: found a job with other settings, another scan or version; {ways}")
        yield journal
