"""Where the queries of an evaluation are localized: in this process, in several, or on a cluster."""

import argparse
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..batch.localizer import Localizer
from ..errors import InputError
from ..jobs.cluster import Cluster, connected
from ..jobs.processes import Processes
from ..jobs.tasks import Executor, Here
from ..scenes.evaluation.query_result import QueryResult
from ..scenes.evaluation.runner import JobRunner, Run, opened
from .errors import EXIT_BAD_INPUT, print_error
from .progress import progress_bar


def resumed(run: Run, arguments: argparse.Namespace) -> tuple[list[QueryResult], int]:
    """All queries of an evaluation, those that are left localized now, and how many failed."""
    show = progress_bar(arguments.quiet)
    report = partial(print_error, arguments, exit_code=EXIT_BAD_INPUT)
    with ExitStack() as stack:
        executor: Executor = Here(JobRunner(run.config, show))
        num_jobs = min(arguments.jobs, len(run.jobs))
        if run.jobs and (address := vars(arguments).get("dask")):
            cluster = stack.enter_context(connected(address, num_jobs, run.config.num_threads))
            executor = cluster.executor(partial(opened, config_at_the_workers(run, cluster)))
        elif num_jobs > 1:
            processes = Processes(partial(opened, run.config), num_jobs, run.config.num_threads)
            executor = stack.enter_context(closing(processes))
        return run.resume(executor, show, report)


def config_at_the_workers(run: Run, cluster: Cluster) -> Localizer:
    """The run's configuration for workers that see its scenes at their paths."""
    here = Path.cwd()
    for cloud in sorted({job.scene.cloud for job in run.jobs}):
        if not cluster.has_files([here / cloud]):
            text = f"not all workers see {cloud}; scenes must be in a folder that they share"
            raise InputError(f"--dask {cluster.address}: {text}")
    return replace(run.config, folder=here)
