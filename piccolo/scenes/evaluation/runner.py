"""Localize the queries of many scenes, in this process or in several.

A run on disk is one JSON line a query, flushed as it comes, so that a stopped run can be resumed.
"""

import json
import multiprocessing
import queue
import signal
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any, NamedTuple

from ...cloud.settings import CloudSettings
from ...coarse_to_fine.open_map import CachePolicy
from ...coarse_to_fine.settings import CoarseToFineSettings
from ...errors import InputError
from ...opening import open_files
from ...panorama import ReadOptions
from ...paper.settings import PaperSettings
from ...runtime.atomic import check_output
from ...runtime.json_file import parse_lines, read_bytes
from ...runtime.line_file import appending, whole_size
from ...runtime.threads import Progress, Workers, no_progress
from ...scan import settings_json
from ..scene import QUERIES_NAME, Query, Scene
from .query_result import FORMAT, QueryResult, is_in_box, query_result_of

QUERIES_PER_JOB = 32  # so that several processes can share a scene with many
PATIENCE = 1.0  # seconds between checks that the other processes are alive
WANTED = "wanted a run of tools/evaluate.py"
LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
MAX_DIFFERENCE = 1e-6  # [m], [rad] between errors of the same poses


@dataclass(frozen=True)
class RunConfig:
    """How queries are localized; pickled for other processes."""

    settings: CoarseToFineSettings | PaperSettings
    cloud_settings: CloudSettings
    read_options: ReadOptions
    cache: CachePolicy
    num_threads: int  # of each process


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


def run_job(config: RunConfig, job: Job, show: Progress = no_progress) -> Iterator[QueryResult | Failure]:
    """The results of a job as they come; a Failure for what can't be read."""
    scene, workers = job.scene, Workers(config.num_threads, show)
    try:
        scan = open_files([scene.cloud], config.cloud_settings, config.settings, config.cache, workers)
    except (OSError, InputError) as error:
        yield Failure(f"{scene.name}: {error}", len(job.queries))
        return
    for query in job.queries:
        try:
            image = query.labels if config.read_options.labels else query.image
            if image is None:
                raise InputError(f"{scene.folder}: {scene.name_of(query)} has no labels in queries.json")
            options, camera = config.read_options, query.calibration
            result = scan.localize_query(image, options, config.settings, calibration=camera)
            yield query_result_of(scene, query, result, is_in_box(scan, query.pose))
        except (OSError, InputError) as error:
            yield Failure(str(error), 1)


def run(
    config: RunConfig, jobs: Sequence[Job], num_processes: int, show: Progress = no_progress
) -> Iterator[QueryResult | Failure]:
    """The results of all jobs as they come, out of order if there are several processes."""
    if num_processes == 1:
        for job in jobs:
            yield from run_job(config, job, show)
    else:
        yield from _run_in_processes(config, jobs, num_processes)


def _run_in_processes(
    config: RunConfig, jobs: Sequence[Job], num_processes: int
) -> Iterator[QueryResult | Failure]:
    context = multiprocessing.get_context("spawn")
    todo: Queue[Job | None] = context.Queue()
    found: Queue[QueryResult | Failure | None] = context.Queue()
    for job in jobs:
        todo.put(job)
    count = min(num_processes, len(jobs))
    for _ in range(count):
        todo.put(None)  # no more
    processes = [context.Process(target=_work, args=(config, todo, found), daemon=True) for _ in range(count)]
    # Ctrl-C reaches every process: the new ones inherit that it is ignored, and this one ends them.
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        for process in processes:
            process.start()
        signal.signal(signal.SIGINT, handler)
        yield from _collect(found, processes)
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _collect(
    found: "Queue[QueryResult | Failure | None]", processes: Sequence[Any]
) -> Iterator[QueryResult | Failure]:
    """Yield from the queue until each process has put None."""
    num_working = len(processes)
    while num_working:
        try:
            value = found.get(timeout=PATIENCE)
        except queue.Empty:
            codes = [process.exitcode for process in processes]
            if any(codes):
                raise ChildProcessError(f"a process ended with code {max(filter(None, codes))}") from None
            continue
        if value is None:
            num_working -= 1
        else:
            yield value


def _work(config: RunConfig, todo: "Queue[Job | None]", found: "Queue[QueryResult | Failure | None]") -> None:
    """Worker loop: runs until the queue is empty or the parent process has died."""
    while _has_parent():
        try:
            job = todo.get(timeout=PATIENCE)
        except queue.Empty:
            continue
        if job is None:
            found.put(None)
            return
        for value in run_job(config, job):
            if not _has_parent():
                return
            found.put(value)


def _has_parent() -> bool:
    parent = multiprocessing.parent_process()
    return parent is not None and parent.is_alive()


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
                    append(found.to_json())
                    rows.append(found)
        return rows, num_failed


def open_run(path: Path, config: RunConfig, scenes: Sequence[Scene], variants: Sequence[str]) -> Run:
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
