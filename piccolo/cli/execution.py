"""The work of a batch: in this process, several, or a cluster, until a signal ends it."""

import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tqdm import tqdm

from ..api.scan import Scan
from ..api.values import AMBIGUOUS, FAILED, LOCALIZED, UNREADABLE, WORTH_A_LOOK, Result
from ..batch.answering import Executor
from ..batch.localizer import Localizer
from ..scan_map.map_file import save_map
from ..scan_map.open_map import CachePolicy
from ..scan_map.scan_map import ScanMap
from ..system.errors import InputError, printable
from ..system.jobs.cluster import Cluster, connect
from ..system.jobs.interruption import SIGNALS, Interruption
from ..system.jobs.memory import GB, memory_left, memory_taken
from ..system.jobs.processes import Here, Processes
from ..system.jobs.threads import num_cores
from .command import EXIT_BAD_INPUT, Arguments, UsageError
from .options import PHOTOS_OF_A_JOB
from .start import for_terminal

EXIT_SOME_NOT = 1
QUERY_MEMORY = 0.5e9  # [byte] of a process beside the map


def choose_exit_code(statuses: Collection[str]) -> int:
    """Return 0 if all photos are localized, 3 if one can't be read or has failed, else 1."""
    if UNREADABLE in statuses or FAILED in statuses:
        return EXIT_BAD_INPUT
    return 0 if set(statuses) <= {LOCALIZED} else EXIT_SOME_NOT


def advise(result: Result) -> list[str]:
    """Return a line on what to do about a doubtful result; none if a warning says why nothing is certain."""
    is_ruled_out = result.best_pose is None or result.belief.ruled_out
    if result.status == LOCALIZED or is_ruled_out or result.settings.get("preset") == "paper":
        return []
    if result.hint:
        return [f"  {for_terminal(result.hint)}"]
    focal = result.focal_length
    if result.place_probability >= WORTH_A_LOOK and focal is not None and focal.is_guess:
        return ["  if other photos of this camera are localized, repeat with --focal, the mean of theirs"]
    if result.status == AMBIGUOUS:
        return ["  to decide, give --near or --heading, or localize several photos of a walk (--walk)"]
    if result.place_probability >= WORTH_A_LOOK:
        others = "add photos taken beside it" if result.cameras else "localize photos of a walk (--walk)"
        return [f"  to be sure, look at the --overlay, give --near, or {others}"]
    lens = ", a wrong focal length" if result.cameras else ""
    return [f"  it fits nowhere well: another scan{lens}, or bare walls?"]


def print_result(arguments: Arguments, result: Result, warnings: Sequence[str]) -> None:
    """Print an error; or, unless --quiet, what was found, the warnings, and what to do if it is doubtful."""
    if result.error is not None:
        arguments.error(result.error)
        return
    if arguments.quiet:
        return
    lines = [f"  warning: {for_terminal(printable(warning))}" for warning in warnings]
    for line in (result.summary(), *lines, *advise(result)):
        tqdm.write(line, file=sys.stderr)


def check_execution(arguments: Arguments) -> None:
    """Refuse options that do not go together."""
    if arguments.dask and arguments.jobs not in (None, 1):
        raise UsageError(f"--jobs: not with --dask {arguments.dask}, whose scheduler starts the workers")
    if arguments.dask and arguments.mask and not arguments.mask.is_absolute():
        raise UsageError(f"--mask {arguments.mask}: wanted an absolute path with --dask {arguments.dask}")


def count_jobs(arguments: Arguments, num_left: int | None) -> int:
    """Return the processes asked for, or as many as are worth their start for `num_left` photos, if known."""
    if arguments.jobs is not None:
        return int(min(arguments.jobs, num_left or arguments.jobs))
    if num_left is None or arguments.threads is not None:
        return 1
    return max(1, min(num_cores(), num_left // PHOTOS_OF_A_JOB))


def count_fitting(arguments: Arguments, num_jobs: int) -> int:
    """Return how many of the processes memory is left for; called where one has what each will need."""
    if arguments.jobs is not None:
        return num_jobs
    return min(num_jobs, count_in_memory(memory_taken(), memory_left()))


def count_in_memory(taken: float, left: float) -> int:
    """Return for how many processes memory is left, of which one has taken its part [byte]."""
    return max(1, int((left + taken) // (taken + QUERY_MEMORY)))


def share_of_a_job(arguments: Arguments, localizer: Localizer, num_jobs: int) -> Localizer:
    """Return the localizer of one of some processes, which divide cores and --max-memory."""
    if arguments.dask:
        return replace(localizer, num_threads=arguments.threads or 1, max_memory=arguments.max_memory)
    num_threads = arguments.threads or max(1, num_cores() // num_jobs)
    memory = arguments.max_memory
    if memory is not None:
        memory = (memory - memory_taken() / GB) / num_jobs
    return replace(localizer, num_threads=num_threads, max_memory=memory)


def connecting(arguments: Arguments) -> AbstractContextManager[Cluster | None]:
    """Return the cluster of --dask; None without."""
    return connect(arguments.dask) if arguments.dask else nullcontext()


@contextmanager
def executing(
    arguments: Arguments,
    localizer: Localizer,
    num_jobs: int,
    cluster: Cluster | None,
    open_scan: Callable[[Localizer, int], Scan],
) -> Iterator[tuple[Executor, Localizer]]:
    """Yield an executor, and the localizer for it; `open_scan` prepares the scan, with so many threads."""
    is_kept = localizer.cache.is_used
    with ExitStack() as stack:
        if not is_kept and (cluster or num_jobs > 1):  # others will open what is prepared here
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="piccolo-")))
            localizer = replace(localizer, cache=CachePolicy(folder=folder))
        scan = open_scan(localizer, arguments.threads or num_cores())
        if cluster is None and (num_jobs := count_fitting(arguments, num_jobs)) == 1:
            yield Here(localizer.answer_in(scan)), localizer
            return
        if cluster:
            localizer = at_the_workers(arguments, cluster, localizer, scan, is_kept)
        del scan
        localizer = share_of_a_job(arguments, localizer, num_jobs)
        if cluster:
            yield cluster.executor(localizer.open), localizer
            return
        processes = Processes(localizer.open, num_jobs, localizer.num_threads)
        yield stack.enter_context(closing(processes)), localizer


def at_the_workers(
    arguments: Arguments, cluster: Cluster, localizer: Localizer, scan: Scan, is_kept: bool
) -> Localizer:
    """Return a localizer whose scan a cluster's workers can open: at its path, or sent to them."""
    here = Path.cwd()
    is_shared = cluster.has_files([here / path for path in localizer.paths])
    if is_shared and is_kept:
        return replace(localizer, folder=here)
    where = f"--dask {arguments.dask}: not all workers can read {scan.name}"
    if not isinstance(scan.prepared, ScanMap):
        raise InputError(f"{where}; the preset paper needs it in a shared folder")
    if (arguments.mask or isinstance(localizer.photo.calibration, Path)) and not is_shared:
        raise InputError(f"{where}; --mask and --camera by photos need a shared folder")
    with TemporaryDirectory(prefix="piccolo-") as folder:
        path = Path(folder) / f"{Path(folder).name}.piccolo-map"
        save_map(scan.prepared, path)
        cluster.send_file(path)
    return replace(localizer, folder=here, map_name=path.name, sends_photos=not is_shared)


def stop(interruption: Interruption, arguments: Arguments, done: str, is_kept: bool) -> int:
    """Say what a signal has ended and how to go on; returns the code that a shell expects of that."""
    same = "the same command"
    how = f"{same} continues from here" if is_kept else f"with --out FILE {same} would continue"
    text = f"ended by {SIGNALS[interruption.number]} after {done}; {how}"
    return arguments.error(text, 128 + interruption.number)
