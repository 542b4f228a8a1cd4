"""Localize the queries of many scenes, in this process or in several."""

import multiprocessing
import queue
import signal
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.queues import Queue
from typing import Any

from ...cloud.settings import CloudSettings
from ...coarse_to_fine.open_map import CachePolicy
from ...coarse_to_fine.settings import CoarseToFineSettings
from ...errors import InputError
from ...panorama import ReadOptions
from ...paper.settings import PaperSettings
from ...runtime.threads import Progress, Workers, no_progress
from ...scan import open_files
from ..scene import Query, Scene
from .query_result import QueryResult, is_in_box, query_result_of

QUERIES_PER_JOB = 32  # so that several processes can share a scene with many
PATIENCE = 1.0  # seconds between checks that the other processes are alive


@dataclass(frozen=True)
class RunConfig:
    """How queries are localized; pickled for other processes."""

    settings: CoarseToFineSettings | PaperSettings
    cloud_settings: CloudSettings
    read_options: ReadOptions
    cache: CachePolicy
    num_threads: int  # of each process


@dataclass(frozen=True)
class Job:
    """Queries of one scene, whose cloud is prepared once for them."""

    scene: Scene
    queries: tuple[Query, ...]


@dataclass(frozen=True)
class Failure:
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
            result = scan.localize_query(image, config.read_options, config.settings)
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
