"""Where the photos of a command are worked on: in this process, or in several."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from ..runtime.memory import GB, memory_left, memory_taken
from ..runtime.processes import Processes
from ..runtime.tasks import Executor, Here, Opening
from ..runtime.threads import num_cores
from ..scenes.evaluation.query_result import QueryResult
from ..scenes.evaluation.runner import JobRunner, Run
from .errors import EXIT_BAD_INPUT, print_error
from .progress import progress_bar

PHOTOS_OF_A_JOB = 8  # as many are localized while a process starts and opens a map
QUERY_MEMORY = 0.5e9  # [byte] of a process beside the map


def wanted_jobs(arguments: argparse.Namespace, num_left: int | None) -> int:
    """Processes asked for, or as many as are worth their start for `num_left` photos (None: unknown)."""
    if arguments.jobs is not None:
        return int(min(arguments.jobs, num_left or arguments.jobs))
    if num_left is None or arguments.threads is not None:
        return 1
    return max(1, min(num_cores(), num_left // PHOTOS_OF_A_JOB))


def fitting_jobs(arguments: argparse.Namespace, wanted: int) -> int:
    """As many of the processes wanted as memory is left for; called where one has what each will need."""
    if arguments.jobs is not None:
        return wanted
    taken = memory_taken()
    return max(1, min(wanted, int((memory_left() + taken) // (taken + QUERY_MEMORY))))


def threads_of_a_job(arguments: argparse.Namespace, num_jobs: int) -> int:
    """Threads of each process: the cores are divided."""
    return int(arguments.threads or max(1, num_cores() // num_jobs))


def memory_of_a_job(arguments: argparse.Namespace, num_jobs: int) -> float | None:
    """The part of --max-memory [10^9 byte] that each process may take, beside this one."""
    if arguments.max_memory is None:
        return None
    return float(arguments.max_memory - memory_taken() / GB) / num_jobs


def resumed(run: Run, arguments: argparse.Namespace) -> tuple[list[QueryResult], int]:
    """All queries of an evaluation, those that are left worked on now, and how many failed."""
    show, num_jobs = progress_bar(arguments.quiet), min(arguments.jobs, len(run.jobs))
    report = partial(print_error, arguments, exit_code=EXIT_BAD_INPUT)
    if num_jobs <= 1:
        return run.resume(Here(JobRunner(run.config, show)), show, report)
    with elsewhere(run.config.opened, num_jobs, run.config.num_threads) as executor:
        return run.resume(executor, show, report)


@contextmanager
def elsewhere(opening: Opening, num_jobs: int, num_threads: int) -> Iterator[Executor]:
    """Processes that are killed at the end, whatever they are doing."""
    processes = Processes(opening, num_jobs, num_threads)
    try:
        yield processes
    finally:
        processes.close()
