"""Where photos are localized: in this process, in several, or on a cluster."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ..batch.localizer import Localizer
from ..errors import InputError
from ..jobs.cluster import LOCAL, Cluster, connected
from ..jobs.memory import GB, memory_left, memory_taken
from ..jobs.processes import Processes
from ..jobs.tasks import Executor, Here
from ..jobs.threads import num_cores
from ..scan import Scan
from ..scan_map.map_file import save_map
from ..scan_map.open_map import CachePolicy
from ..scan_map.scan_map import ScanMap
from .command import option
from .errors import UsageError

PHOTOS_OF_A_JOB = 8  # as many are localized while a process starts and opens a map
DASK = "work on a Dask cluster: its scheduler's address or file, or local, of --jobs processes here"
QUERY_MEMORY = 0.5e9  # [byte] of a process beside the map
Place = tuple[Executor, Localizer]


def add_execution_options(parser: argparse.ArgumentParser) -> None:
    """Where the photos are localized, and what may be taken there."""
    group = parser.add_argument_group("execution")
    text = "processes over one prepared map (default one a core, where memory is enough and each has "
    text += f"{PHOTOS_OF_A_JOB} photos or more; 1 with names on stdin or --threads)"
    option(group, "--jobs N", text)
    option(group, "--dask ADDRESS", DASK)
    option(group, "--threads N", "of each process (default the cores, divided among --jobs)")
    text = "that may be taken in all; with --dask ADDRESS by each worker (default 80 %% of what is free)"
    option(group, "--max-memory GB", text, type=float)


def check_execution(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    if is_remote(arguments) and arguments.jobs not in (None, 1):
        raise UsageError(f"--jobs: not with --dask {arguments.dask}, whose scheduler knows its workers")
    if is_remote(arguments) and arguments.mask and not arguments.mask.is_absolute():
        raise UsageError(f"--mask {arguments.mask}: wanted an absolute path with --dask {arguments.dask}")


def is_remote(arguments: argparse.Namespace) -> bool:
    """True if a cluster that others have begun does the work."""
    return arguments.dask not in (None, LOCAL)


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


def share_of_a_job(arguments: argparse.Namespace, localizer: Localizer, num_jobs: int) -> Localizer:
    """A localizer for each of some processes: cores and --max-memory, less what this one has, are divided."""
    if is_remote(arguments):
        return replace(localizer, num_threads=arguments.threads or 1, max_memory=arguments.max_memory)
    num_threads = arguments.threads or max(1, num_cores() // num_jobs)
    if arguments.max_memory is None:
        return replace(localizer, num_threads=num_threads)
    memory = (arguments.max_memory - memory_taken() / GB) / num_jobs
    return replace(localizer, num_threads=num_threads, max_memory=memory)


@contextmanager
def executing(
    arguments: argparse.Namespace,
    localizer: Localizer,
    num_left: int | None,
    opened: Callable[[Localizer, int], Scan],
) -> Iterator[Place]:
    """Where photos are localized, and by what, when `opened` has prepared the scan with so many threads."""
    num_jobs = wanted_jobs(arguments, num_left)
    with ExitStack() as stack:
        cluster: Cluster | None = None
        if arguments.dask:
            num_threads = share_of_a_job(arguments, localizer, num_jobs).num_threads
            cluster = stack.enter_context(connected(arguments.dask, num_jobs, num_threads))
        if arguments.no_cache and (cluster or num_jobs > 1):  # others will open what is prepared here
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="piccolo-")))
            localizer = replace(localizer, cache=CachePolicy(folder=folder))
        scan = opened(localizer, arguments.threads or num_cores())
        if cluster is None and (num_jobs := fitting_jobs(arguments, num_jobs)) == 1:
            yield Here(partial(localizer.answer, scan)), localizer
            return
        if cluster and is_remote(arguments):
            localizer = at_the_workers(arguments, cluster, localizer, scan)
        del scan
        localizer = share_of_a_job(arguments, localizer, num_jobs)
        if cluster:
            yield cluster.executor(localizer.opened), localizer
            return
        processes = Processes(localizer.opened, num_jobs, localizer.num_threads)
        yield stack.enter_context(closing(processes)), localizer


def at_the_workers(
    arguments: argparse.Namespace, cluster: Cluster, localizer: Localizer, scan: Scan
) -> Localizer:
    """A localizer whose scan a cluster's workers can open: at its path, or sent to them."""
    here = Path.cwd()
    is_shared = cluster.has_files([here / path for path in localizer.paths])
    if is_shared and not arguments.no_cache:
        return replace(localizer, folder=here)
    where = f"--dask {arguments.dask}: not all workers see {scan.name}"
    if not isinstance(scan.prepared, ScanMap):
        raise InputError(f"{where}; the preset paper needs it in a folder that they share")
    if arguments.mask and not is_shared:
        raise InputError(f"{where}; --mask needs a folder that they share")
    with TemporaryDirectory(prefix="piccolo-") as folder:
        path = Path(folder) / f"{Path(folder).name}.piccolo-map"
        save_map(scan.prepared, path)
        cluster.send_file(path)
    return replace(localizer, folder=here, map_name=path.name, sends_photos=not is_shared)
