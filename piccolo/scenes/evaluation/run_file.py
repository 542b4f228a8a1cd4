"""A run on disk: one JSON line a query, flushed as it comes, so that a run can be taken up again."""

import fcntl
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from ...pipeline import Inputs, settings_json
from ...runtime.atomic import check_output
from ...runtime.threads import Show, unseen
from ..scene import QUERIES_NAME, Query, Scene
from .row import FORMAT, Row, row_of
from .runner import Failure, Job, Plan, jobs_of, run


def read_rows(path: Path) -> tuple[list[Row], int]:
    """The rows of a run, and the size [byte] of the file up to its last whole line.

    Raises
    ------
    InputError
        A line is not a row; a last line without its end is one that was being written, and is left out.
    """
    content = path.read_bytes()
    size = content.rfind(b"\n") + 1
    rest = content[size : size + len(ROW_BEGINS)]
    if rest != ROW_BEGINS[: len(rest)]:
        raise InputError(f"{path}: found a last line that is no row, wanted a run of tools/evaluate.py")
    rows: dict[tuple[str, str], Row] = {}
    for number, line in enumerate(content[:size].splitlines(), 1):
        try:
            row = Row.from_json(line.decode())
        except (InputError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: line {number}: {error}") from error
        rows[row.key] = row
    return list(rows.values()), size


ROW_BEGINS = f'{{"format": "{FORMAT}"'.encode()
MAX_DIFFERENCE = 1e-6  # [m], [rad] between errors of the same poses


@dataclass(frozen=True)
class Run:
    """A run over scenes: what a file has of it, and what is left to do."""

    path: Path
    plan: Plan
    rows: tuple[Row, ...]  # of these scenes and variants, that are done
    jobs: tuple[Job, ...]  # that are left
    size: int  # of the file, up to its last whole line [byte]

    @property
    def num_left(self) -> int:
        """Queries that are left."""
        return sum(len(job.queries) for job in self.jobs)

    def go_on(self, num_processes: int, show: Show = unseen) -> Iterator[Row | Failure]:
        """The rows that were left, each written before it is handed on.

        Raises
        ------
        InputError
            Another process is writing the file.
        """
        if not self.jobs:
            return
        with appending(self.path, self.size) as append:
            for found in run(self.plan, self.jobs, num_processes, show):
                if isinstance(found, Row):
                    append(found)
                yield found

    def finish(self, num_processes: int, show: Show, tell: Callable[[str], None]) -> tuple[list[Row], int]:
        """All rows, old and new, and how many queries could not be tried; `tell` gets a line for each."""
        rows, num_failed = list(self.rows), 0
        for found in show(self.go_on(num_processes, show), self.num_left, "queries"):
            if isinstance(found, Failure):
                tell(found.text)
                num_failed += found.num_queries
            else:
                rows.append(found)
        return rows, num_failed


def open_run(path: Path, plan: Plan, scenes: Sequence[Scene], variants: Sequence[str]) -> Run:
    """Take up a run, or begin one; no variants stands for all.

    Raises
    ------
    InputError
        The file can't be written, holds something else, or rows made with other settings.
    """
    rows, size = read_rows(path) if path.exists() else ([], 0)
    inputs = Inputs((), plan.cloud_settings, plan.read_options)
    _check_settings(path, rows, json.loads(json.dumps(settings_json(inputs, plan.settings))))
    queries = {
        (scene.name, scene.name_of(query)): (scene, query) for scene in scenes for query in scene.queries
    }
    known = {query.variant for _, query in queries.values()}
    if missing := [variant for variant in variants if variant not in known]:
        raise InputError(f"--variants: found no {missing[0]}, wanted some of {', '.join(sorted(known))}")
    for row in rows:
        if row.key in queries and not _is_of(row, *queries[row.key]):
            text = "made with another true pose or another scene of this name, wanted another file"
            raise InputError(f"{path}: found a row of {row.scene}, {row.image} {text}")
    own = tuple(row for row in rows if row.key in queries and (not variants or row.variant in variants))
    jobs = jobs_of(scenes, {row.key for row in rows}, variants)
    if jobs:
        check_output(path, inputs_of(scenes))
    return Run(path, plan, own, tuple(jobs), size)


def inputs_of(scenes: Sequence[Scene]) -> list[Path]:
    """The files of scenes, which no output may replace."""
    of_all = [path for scene in scenes for path in (scene.folder / QUERIES_NAME, scene.cloud)]
    return of_all + [query.image for scene in scenes for query in scene.queries]


def _is_of(row: Row, scene: Scene, query: Query) -> bool:
    """True if a row's errors are those of its pose against a query's."""
    again = row_of(scene, query, row.result, row.is_in_box)
    pairs = (row.position_error, again.position_error), (row.rotation_error, again.rotation_error)
    return all(a == b or abs(a - b) < MAX_DIFFERENCE for a, b in pairs)


def _check_settings(path: Path, rows: Sequence[Row], settings: dict[str, object]) -> None:
    for row in rows:
        made_with = row.result.settings
        names = sorted({*made_with, *settings})
        differing = [name for name in names if made_with.get(name) != settings.get(name)]
        if differing:
            name = differing[0]
            found = f"rows made with {name} {made_with.get(name)!r}"
            raise InputError(f"{path}: found {found}, wanted {settings.get(name)!r}, or another file")


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
