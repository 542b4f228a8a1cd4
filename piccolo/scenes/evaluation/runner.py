"""Localize the queries of many scenes, in this process or in several."""

import multiprocessing
import queue
import signal
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

from ...cloud.settings import CloudSettings
from ...coarse_to_fine.settings import CoarseToFineSettings
from ...errors import InputError
from ...panorama import ReadOptions
from ...paper.settings import PaperSettings
from ...pipeline import CachePolicy, Inputs, localize_file, open_localizer
from ...runtime.stopwatch import Stopwatch
from ...runtime.threads import Show, Workers, unseen
from ..scene import Query, Scene
from .row import Row, is_in_box, row_of

QUERIES_PER_JOB = 32  # so that several processes can share a scene with many
PATIENCE = 1.0  # seconds between two looks at whether a process has died


@dataclass(frozen=True)
class Plan:
    """How queries are localized; goes to other processes as it is."""

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
    """The queries that are left to do, `done` holding the keys of rows; no variants stands for all."""
    jobs: list[Job] = []
    for scene in scenes:
        left = [query for query in scene.queries if (scene.name, scene.name_of(query)) not in done]
        left = [query for query in left if not variants or query.variant in variants]
        for begin in range(0, len(left), QUERIES_PER_JOB):
            jobs.append(Job(scene, tuple(left[begin : begin + QUERIES_PER_JOB])))
    return jobs


def run_job(plan: Plan, job: Job, show: Show = unseen) -> Iterator[Row | Failure]:
    """The rows of a job as they come; what can't be read is told and left out."""
    scene, watch, workers = job.scene, Stopwatch(), Workers(plan.num_threads, show)
    inputs = Inputs((scene.cloud,), plan.cloud_settings, plan.read_options)
    try:
        localizer = open_localizer(inputs, plan.settings, plan.cache, workers, watch)
    except (OSError, InputError) as error:
        yield Failure(f"{scene.name}: {error}", len(job.queries))
        return
    for query in job.queries:
        try:
            image = _image_of(scene, query, plan.read_options)
            result, _ = localize_file(localizer, inputs, image, workers, watch.seconds)
            yield row_of(scene, query, result, is_in_box(localizer, query.pose))
        except (OSError, InputError) as error:
            yield Failure(str(error), 1)


def _image_of(scene: Scene, query: Query, read_options: ReadOptions) -> Path:
    """What is localized of a query: its picture of labels if labels are to be read."""
    if not read_options.labels:
        return query.image
    if query.labels is None:
        raise InputError(f"{scene.folder}: {scene.name_of(query)} has no labels in queries.json")
    return query.labels


def run(plan: Plan, jobs: Sequence[Job], num_processes: int, show: Show = unseen) -> Iterator[Row | Failure]:
    """The rows of all jobs as they come, out of order if there are several processes."""
    if num_processes == 1:
        for job in jobs:
            yield from run_job(plan, job, show)
    else:
        yield from _run_in_processes(plan, jobs, num_processes)


def _run_in_processes(plan: Plan, jobs: Sequence[Job], num_processes: int) -> Iterator[Row | Failure]:
    context = multiprocessing.get_context("spawn")
    todo: Queue[Job | None] = context.Queue()
    found: Queue[Row | Failure | None] = context.Queue()
    for job in jobs:
        todo.put(job)
    count = min(num_processes, len(jobs))
    for _ in range(count):
        todo.put(None)  # no more
    processes = [context.Process(target=_work, args=(plan, todo, found), daemon=True) for _ in range(count)]
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


def _collect(found: "Queue[Row | Failure | None]", processes: Sequence[Any]) -> Iterator[Row | Failure]:
    """What the processes put, until each has put None."""
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


def _work(plan: Plan, todo: "Queue[Job | None]", found: "Queue[Row | Failure | None]") -> None:
    """One process: take jobs until there are none, or nobody is left to write what comes of them."""
    while _has_parent():
        try:
            job = todo.get(timeout=PATIENCE)
        except queue.Empty:
            continue
        if job is None:
            found.put(None)
            return
        for value in run_job(plan, job):
            if not _has_parent():
                return
            found.put(value)


def _has_parent() -> bool:
    parent = multiprocessing.parent_process()
    return parent is not None and parent.is_alive()
