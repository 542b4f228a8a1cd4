"""Localize the queries of many scenes, in this process or elsewhere.

A run on disk is one JSON line a query, flushed as it comes, so that a stopped run can be resumed.
"""

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ...batch.localizer import Localizer, Task
from ...errors import InputError
from ...files.atomic import check_output
from ...files.json_file import parse_lines, read_bytes
from ...files.line_file import appending, whole_size
from ...jobs.tasks import Executor, WorkerLostError
from ...jobs.threads import Progress, Workers, no_progress
from ...result import UNREADABLE, failure_of
from ...scan import Scan, settings_json
from ..scene import QUERIES_NAME, Query, Scene
from .query_result import FORMAT, QueryResult, is_in_box, query_result_of

QUERIES_PER_JOB = 8  # so that several processes can share a scene, and little is lost with one of them
WANTED = "wanted a run of tools/evaluate.py"
LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
MAX_DIFFERENCE = 1e-6  # [m], [rad] between errors of the same poses


class Job(NamedTuple):
    """Queries of one scene, whose cloud is prepared once for them."""

    scene: Scene
    queries: tuple[Query, ...]


class Failure(NamedTuple):
    """Queries that could not be tried."""

    text: str  # one line, which file and why
    num_queries: int


def jobs_of(scenes: Sequence[Scene], done: Collection[tuple[str, str]], variants: Sequence[str]) -> list[Job]:
    """The queries that are left, without the keys in `done`; no variants stands for all."""
    jobs: list[Job] = []
    for scene in scenes:
        left = [query for query in scene.queries if (scene.name, scene.name_of(query)) not in done]
        left = [query for query in left if not variants or query.variant in variants]
        for begin in range(0, len(left), QUERIES_PER_JOB):
            jobs.append(Job(scene, tuple(left[begin : begin + QUERIES_PER_JOB])))
    return jobs


class JobRunner:
    """Runs jobs in one process; the scan of the last one stays open for the next."""

    def __init__(self, config: Localizer, show: Progress = no_progress) -> None:
        self.config, self.workers = config, Workers(config.num_threads, show)
        self._opened: tuple[Localizer, Scan] | None = None

    def __call__(self, job: Job) -> Iterator[QueryResult | Failure]:
        """The results of a job as they come; a Failure for what can't be read."""
        try:
            localizer, scan = self._open(job.scene.cloud)
        except Exception as error:
            yield Failure(f"{job.scene.name}: {failure_of(error).text}", len(job.queries))
            return
        for query in job.queries:
            yield self._result_of(localizer, scan, job.scene, query)

    def _open(self, cloud: Path) -> tuple[Localizer, Scan]:
        if self._opened is None or self._opened[0].paths != (cloud,):
            self._opened = None  # before the next is opened: two may not fit
            localizer = replace(self.config, paths=(cloud,))
            self._opened = localizer, localizer.open_scan(self.workers)
        return self._opened

    def _result_of(
        self, localizer: Localizer, scan: Scan, scene: Scene, query: Query
    ) -> QueryResult | Failure:
        image = query.labels if localizer.read_options.labels else query.image
        if image is None:
            return Failure(f"{scene.folder}: {scene.name_of(query)} has no labels in queries.json", 1)
        task = Task(image, localizer.settings, calibration=query.calibration)
        result = localizer.answer(scan, task).result
        if result.error is None:
            return query_result_of(scene, query, result, is_in_box(scan, query.pose))
        is_refused = result.status == UNREADABLE and not query.is_answerable
        return query_result_of(scene, query, result, None) if is_refused else Failure(result.error, 1)


def opened(config: Localizer) -> Callable[[Job], tuple[QueryResult | Failure, ...]]:
    """Return a function that runs a job as a whole in this process."""
    runner = JobRunner(config)
    return lambda job: tuple(runner(job))


def run(executor: Executor, jobs: Sequence[Job]) -> Iterator[QueryResult | Failure]:
    """The results of all jobs as they come.

    Of a job whose processes were killed, each query is tried by itself, after all others.
    """
    alone: list[Job] = []
    for job, wait in executor.values(iter(jobs)):
        try:
            yield from wait()
        except WorkerLostError as error:
            if len(job.queries) == 1:
                yield Failure(f"{job.queries[0].image}: {error}", 1)
            else:
                alone += [Job(job.scene, (query,)) for query in job.queries]
    if alone:
        yield from run(executor, alone)


def read_run(path: Path) -> tuple[list[QueryResult], int]:
    """The queries of a run, and the size [byte] of the file up to its last whole line.

    Raises InputError if a line is none of a run; an unfinished last line was being written, and is left out.
    """
    content = read_bytes(path, WANTED)
    size = whole_size(path, LINE_BEGINS, "a run of tools/evaluate.py")
    rows = parse_lines(path, content[:size], QueryResult.from_json)
    return list({row.key: row for row in rows}.values()), size


class Run(NamedTuple):
    """A run over scenes: the queries that are done, and those that are left."""

    path: Path
    config: Localizer  # of any scan
    rows: tuple[QueryResult, ...]  # of these scenes and variants, that are done
    jobs: tuple[Job, ...]  # that are left
    size: int  # of the file, up to its last whole line [byte]

    def resume(
        self, executor: Executor, show: Progress, report: Callable[[str], object]
    ) -> tuple[list[QueryResult], int]:
        """All queries, old and new, and how many failed; `report` gets a line for each failure.

        Raises InputError if another process is writing the file.
        """
        rows, num_failed = list(self.rows), 0
        if not self.jobs:
            return rows, num_failed
        num_left = sum(len(job.queries) for job in self.jobs)
        with appending(self.path, self.size) as append:
            for found in show(run(executor, self.jobs), num_left, "queries"):
                if isinstance(found, Failure):
                    report(found.text)
                    num_failed += found.num_queries
                else:
                    line = found.to_json()
                    append(line)
                    rows.append(QueryResult.from_json(line))  # as whoever reads the file has it
        return rows, num_failed


def open_run(path: Path, config: Localizer, scenes: Sequence[Scene], variants: Sequence[str]) -> Run:
    """Resume a run, or begin one; no variants stands for all.

    Raises InputError if the file can't be written, holds something else, or rows made with other settings.
    """
    rows, size = read_run(path) if path.exists() else ([], 0)
    repeated = settings_json(config.settings, config.cloud_settings, config.read_options)
    _check_settings(path, rows, json.loads(json.dumps(repeated)))
    pairs = [(scene, query) for scene in scenes for query in scene.queries]
    queries = {(scene.name, scene.name_of(query)): (scene, query) for scene, query in pairs}
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
