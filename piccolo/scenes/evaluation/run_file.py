"""A run on disk: one JSON line a query, flushed as it comes, so that a stopped run can be resumed."""

import fcntl
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from ...runtime.atomic import check_output
from ...runtime.json_file import parse_lines, read_bytes
from ...runtime.threads import Progress
from ...scan import settings_json
from ..scene import QUERIES_NAME, Query, Scene
from .query_result import FORMAT, QueryResult, query_result_of
from .runner import Failure, Job, RunConfig, jobs_of, run

WANTED = "wanted a run of tools/evaluate.py"
LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
MAX_DIFFERENCE = 1e-6  # [m], [rad] between errors of the same poses


def read_run(path: Path) -> tuple[list[QueryResult], int]:
    """The queries of a run, and the size [byte] of the file up to its last whole line.

    Raises InputError if a line is none of a run; an unfinished last line was being written, and is left out.
    """
    content = read_bytes(path, WANTED)
    size = content.rfind(b"\n") + 1
    rest = content[size : size + len(LINE_BEGINS)]
    if rest != LINE_BEGINS[: len(rest)]:
        raise InputError(f"{path}: the last line is none of a run, {WANTED}")
    rows = parse_lines(path, content[:size], QueryResult.from_json)
    return list({row.key: row for row in rows}.values()), size


@dataclass(frozen=True)
class Run:
    """A run over scenes: the queries that are done, and those that are left."""

    path: Path
    config: RunConfig
    rows: tuple[QueryResult, ...]  # of these scenes and variants, that are done
    jobs: tuple[Job, ...]  # that are left
    size: int  # of the file, up to its last whole line [byte]

    def resume(
        self, num_processes: int, show: Progress, report: Callable[[str], object]
    ) -> tuple[list[QueryResult], int]:
        """All queries, old and new, and how many failed; `report` gets a line for each failure.

        Raises InputError if another process is writing the file.
        """
        rows, num_failed = list(self.rows), 0
        if not self.jobs:
            return rows, num_failed
        num_left = sum(len(job.queries) for job in self.jobs)
        with appending(self.path, self.size) as append:
            for found in show(run(self.config, self.jobs, num_processes, show), num_left, "queries"):
                if isinstance(found, Failure):
                    report(found.text)
                    num_failed += found.num_queries
                else:
                    append(found)
                    rows.append(found)
        return rows, num_failed


def open_run(path: Path, config: RunConfig, scenes: Sequence[Scene], variants: Sequence[str]) -> Run:
    """Resume a run, or begin one; no variants stands for all.

    Raises InputError if the file can't be written, holds something else, or rows made with other settings.
    """
    rows, size = read_run(path) if path.exists() else ([], 0)
    repeated = settings_json(config.settings, config.cloud_settings, config.read_options)
    _check_settings(path, rows, json.loads(json.dumps(repeated)))
    queries = {
        (scene.name, scene.name_of(query)): (scene, query) for scene in scenes for query in scene.queries
    }
    known = {query.variant for _, query in queries.values()}
    if missing := [variant for variant in variants if variant not in known]:
        raise InputError(f"--variants: found no {missing[0]}, wanted some of {', '.join(sorted(known))}")
    for row in rows:
        if row.key in queries and not _is_of(row, *queries[row.key]):
            text = "made with another true pose or another scene of this name; choose another file"
            raise InputError(f"{path}: found a result of {row.scene}, {row.image} {text}")
    own = tuple(row for row in rows if row.key in queries and (not variants or row.variant in variants))
    jobs = jobs_of(scenes, {row.key for row in rows}, variants)
    if jobs:
        check_output(path)
    return Run(path, config, own, tuple(jobs), size)


def input_files(scenes: Sequence[Scene]) -> list[Path]:
    """The files of scenes, which no output may replace."""
    of_all = [path for scene in scenes for path in (scene.folder / QUERIES_NAME, scene.cloud)]
    queries = [query for scene in scenes for query in scene.queries]
    return of_all + [path for query in queries for path in (query.image, query.labels) if path]


def _is_of(row: QueryResult, scene: Scene, query: Query) -> bool:
    """True if a result's errors are those of its pose against this query's true pose."""
    again = query_result_of(scene, query, row.result, row.is_in_box)
    pairs = (row.position_error, again.position_error), (row.rotation_error, again.rotation_error)
    return all(a == b or abs(a - b) < MAX_DIFFERENCE for a, b in pairs)


def _check_settings(path: Path, rows: Sequence[QueryResult], settings: dict[str, object]) -> None:
    for row in rows:
        made_with = row.result.settings
        for name in sorted({*made_with, *settings}):
            found, wanted = made_with.get(name), settings.get(name)
            if found != wanted:
                text = f"its results were made with {name} {found!r}, not {wanted!r}"
                raise InputError(f"{path}: {text}; choose another file")


@contextmanager
def appending(path: Path, size: int) -> Iterator[Callable[[QueryResult], None]]:
    """A function that appends one query to a run at once; the run is first cut to `size` bytes.

    Raises InputError if another process is writing it.
    """
    with path.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{path}: another process is writing this run; wait for its end") from error
        file.truncate(size)

        def append(row: QueryResult) -> None:
            file.write(row.to_json().encode() + b"\n")
            file.flush()

        yield append
