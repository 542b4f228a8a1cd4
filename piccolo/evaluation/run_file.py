"""The rows of a run on disk: one JSON line each, flushed as it comes, so that a run can be taken up again."""

import fcntl
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError
from .row import Row


def read_rows(path: Path) -> tuple[list[Row], int]:
    """The rows of a run, and the size [byte] of the file up to its last whole line.

    Raises
    ------
    InputError
        A line is not a row; a last line without its end is one that was being written, and is left out.
    """
    content = path.read_bytes()
    size = content.rfind(b"\n") + 1
    rows: dict[tuple[str, str], Row] = {}
    for number, line in enumerate(content[:size].splitlines(), 1):
        try:
            row = Row.from_json(line.decode())
        except (InputError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: line {number}: {error}") from error
        rows[row.key] = row
    return list(rows.values()), size


def check_settings(path: Path, rows: Sequence[Row], settings: dict[str, object]) -> None:
    """Refuse to take up a run that was made with other settings."""
    for row in rows:
        made_with = row.result.settings
        names = sorted({*made_with, *settings})
        differing = [name for name in names if made_with.get(name) != settings.get(name)]
        if differing:
            name = differing[0]
            found = f"rows made with {name} {made_with.get(name)!r}"
            raise InputError(f"{path}: found {found}, wanted {settings.get(name)!r}, or another --out")


@contextmanager
def appending(path: Path, size: int) -> Iterator[Callable[[Row], None]]:
    """What writes one row at the end of a run, at once; the run is cut to its first `size` bytes before.

    Raises
    ------
    InputError
        Another process is writing it.
    """
    with path.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = f"{path}: found a run that another process is writing, wanted to be alone"
            raise InputError(text) from error
        file.truncate(size)

        def append(row: Row) -> None:
            file.write(row.to_json().encode() + b"\n")
            file.flush()

        yield append
