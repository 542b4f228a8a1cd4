"""Command line: a coloured scan and 360-degree photos in, camera poses out."""

import argparse
import itertools
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from io import FileIO
from pathlib import Path
from typing import cast

from tqdm import tqdm

from ..batch.batch import Batch
from ..batch.inputs import is_from_stdin, panoramas_of
from ..batch.localizer import Answer, Localizer
from ..batch.priors import read_priors
from ..coarse_to_fine.open_map import CachePolicy, scan_sha256_of
from ..coarse_to_fine.scan_map import ScanMap
from ..coarse_to_fine.settings import CoarseToFineSettings
from ..confidence.confidence import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..panorama.cube import is_cube
from ..result import UNREADABLE
from ..runtime.atomic import STDOUT, check_output, is_stdout, is_stream, write_atomically
from ..runtime.kernel_cache import is_first_use, kernel_folder
from ..runtime.line_file import appending
from ..runtime.memory import limit_memory
from ..runtime.stopwatch import Stopwatch
from ..runtime.tasks import Executor, Pair, WorkerLostError
from ..runtime.threads import Workers, num_cores
from ..scan import Scan
from .errors import EXIT_BAD_INPUT, UsageError, checking_options, print_error, print_note, run_command
from .executing import check_execution, executing
from .interruption import SIGNALS, Interruption, Stopped, interruptible
from .localize_walk import check_plan, run_walk
from .options import build_parser, check_arguments, cloud_settings_from, read_options_from, settings_from
from .outputs import check_distinct, check_suffix
from .progress import progress_bar, warn_once
from .walking import check_walk_options, walk_inputs

EXIT_ALL_LOCALIZED, EXIT_SOME_NOT = 0, 1
STATUSES = (LOCALIZED, AMBIGUOUS, NOT_LOCALIZED, UNREADABLE)
Write = Callable[[str], object]


@dataclass
class Run:
    """A command's batch, and what it has done so far."""

    arguments: argparse.Namespace
    batch: Batch
    localizer: Localizer
    panoramas: Iterator[Path]
    total: int | None  # of the panoramas; None if they come on standard input
    counts: Counter[str]  # results by status, those of an earlier run too
    size: int | None  # of the lines that an earlier run has left [byte]; None: they are overwritten
    cloud: str | tuple[str, ...] = ""  # the scan's name and digest, when it has been opened
    cloud_sha256: str = ""

    @property
    def num_finished(self) -> int:
        """Results written, by this run or an earlier one."""
        return self.counts.total()


def is_resumable(out: Path | None) -> bool:
    """True for an output that can be read again: a file, no stream."""
    return out is not None and not is_stream(out)


def check_files(arguments: argparse.Namespace, panoramas: list[Path], total: int | None) -> None:
    """Refuse, before any work, what could not be written, or would replace an input or another output."""
    files = arguments.mask, arguments.priors, arguments.camera, arguments.rig, arguments.video
    given = filter(None, files)
    lists = [Path(word[1:]) for word in arguments.pano if word.startswith("@")]
    pictures = {"--overlay": arguments.overlay, "--occlusion-mask": arguments.occlusion_mask}
    outputs = {"--out": arguments.out or STDOUT, "--plan": arguments.plan, **pictures}
    check_distinct(outputs, [*arguments.cloud, *panoramas, *lists, *given])
    check_output(arguments.out or STDOUT)
    if arguments.plan:
        check_plan(arguments.plan)
    for option, path in pictures.items():
        if path is None or path.is_dir():
            continue
        if total != 1:
            found = "names on stdin" if total is None else f"{total} panoramas"
            raise UsageError(f"{option}: found {found}, wanted one panorama or a folder that exists")
        check_suffix(option, path, (".png",))
        check_output(path)


def cache_of(arguments: argparse.Namespace) -> CachePolicy:
    """Where prepared maps are kept."""
    return CachePolicy(not arguments.no_cache, arguments.cache)


def prepare_run(arguments: argparse.Namespace) -> Run:
    """What is to be done: the options, the panoramas, and how many of them are finished."""
    with checking_options():
        check_arguments(arguments)
        check_walk_options(arguments)
        check_execution(arguments)
        limit_memory(arguments.max_memory)
        settings, read_options = settings_from(arguments), read_options_from(arguments)
        cloud_settings = cloud_settings_from(arguments)
    priors = None
    if arguments.priors:
        if not isinstance(settings, CoarseToFineSettings):
            raise UsageError("--priors: not an option of the preset paper")
        priors = read_priors(arguments.priors, settings.prior)
    batch = Batch(settings, cloud_settings, read_options, priors)
    is_one = read_options.rig.is_instant if read_options.rig else is_cube
    panoramas, total = panoramas_of(arguments.pano, sys.stdin, is_one), None
    known: list[Path] = []
    if not is_from_stdin(arguments.pano):
        known = list(panoramas)
        panoramas, total = iter(known), len(known)
    check_files(arguments, known, total)
    counts, size = Counter[str](), None if arguments.overwrite else 0
    is_walk = arguments.walk or arguments.video
    if is_resumable(arguments.out) and arguments.out.exists() and not (arguments.overwrite or is_walk):
        show = progress_bar(arguments.quiet)
        paths = arguments.cloud
        name = str(paths[0]) if len(paths) == 1 else tuple(map(str, paths))
        checked = show(panoramas, total, "check what is finished")
        digest = scan_sha256_of(paths, cache_of(arguments))
        counts, size = batch.pass_finished(arguments.out, checked, name, digest)
    return Run(arguments, batch, localizer_of(arguments, batch), panoramas, total, counts, size)


def localizer_of(arguments: argparse.Namespace, batch: Batch) -> Localizer:
    """What answers the photos in one process."""
    return Localizer(
        tuple(arguments.cloud),
        batch.settings,
        batch.cloud_settings,
        batch.read_options,
        cache_of(arguments),
        makes_overlays=arguments.overlay is not None,
        makes_occlusion_masks=arguments.occlusion_mask is not None,
    )


def open_scan(run: Run, localizer: Localizer, num_threads: int) -> Scan:
    """Read and prepare the scan."""
    arguments = run.arguments
    if is_first_use():
        print_note(arguments, f"first use: compiling kernels, once (about a minute), into {kernel_folder()}")
    workers = Workers(num_threads, progress_bar(arguments.quiet), warn_once(arguments.quiet))
    scan = localizer.open_scan(workers)
    for warning in scan.warnings:  # those of a map prepared earlier; others have been written
        workers.warn(warning)
    run.cloud, run.cloud_sha256 = scan.name, scan.prepared.scan_sha256
    if run.batch.priors and isinstance(scan.prepared, ScanMap):
        run.batch.priors.check_scans(scan.prepared)
    return scan


@contextmanager
def output(run: Run) -> Iterator[Write]:
    """A function that writes one line: to stdout, a FIFO, or behind the finished lines of a file."""
    out = run.arguments.out or STDOUT
    if is_resumable(out):
        with appending(out, run.size) as append:
            yield append
    elif is_stdout(out):
        yield lambda line: print(line, flush=True)
    else:
        with out.open("wb", buffering=0) as stream:
            yield lambda line: write_to(stream, line, out)


def write_to(stream: FileIO, line: str, out: Path) -> None:
    """Write one line to a FIFO or a device; an OSError names it."""
    rest = memoryview(line.encode() + b"\n")
    try:
        while rest:
            rest = rest[stream.write(rest) or 0 :]
    except OSError as error:
        raise OSError(error.errno, os.strerror(error.errno or 0), str(out)) from error


def write_picture(path: Path, pano: Path, png: bytes) -> None:
    """Write a PNG of a panorama to a file, or into a folder under the panorama's name."""
    write_atomically(path / f"{pano.stem}.png" if path.is_dir() else path, png)


def answer_of(run: Run, pair: Pair) -> Answer:
    """What has come of a task."""
    task, pending = pair
    try:
        return cast(Answer, pending.result())
    except WorkerLostError as error:
        text = f"{task.pano}: {error}"
        return run.localizer.failed(task, text, run.cloud, run.cloud_sha256, task.pano)


def record(run: Run, answer: Answer, write: Write) -> None:
    """Write the pictures that are asked for and the result, and say what was found."""
    arguments, result = run.arguments, answer.result
    pictures = (arguments.overlay, answer.overlay), (arguments.occlusion_mask, answer.occlusion_mask)
    for path, png in pictures:
        if path and png is not None:
            write_picture(path, Path(result.pano), png)
    if result.error is not None:
        print_error(arguments, result.error, EXIT_BAD_INPUT)
    elif not arguments.quiet:
        for line in (*(f"warning: {warning}" for warning in answer.warnings), result.summary()):
            tqdm.write(line, file=sys.stderr)
    write(result.to_json())
    run.counts[result.status] += 1


def localize_all(run: Run, executor: Executor, write: Write) -> Interruption:
    """Localize the panoramas that are left, write each result as it comes, until a signal ends it."""
    hidden = run.arguments.quiet or run.total == 1
    bar = {"total": run.total, "initial": run.num_finished, "disable": hidden, "file": sys.stderr}
    values = executor.values(run.localizer.task(pano, run.batch.settings_of(pano)) for pano in run.panoramas)
    with interruptible() as interruption, suppress(Stopped):
        for pair in tqdm(values, "panoramas", unit="", **bar):
            with interruption.postponed() if run.total != 1 else nullcontext():
                record(run, answer_of(run, pair), write)
            if interruption.number:
                break
        for pair in values.finished():  # behind the one after which a signal has ended it
            with interruption.postponed():
                record(run, answer_of(run, pair), write)
    return interruption


def finish(run: Run, interruption: Interruption, seconds: float) -> int:
    """Say what was done, and how to go on; the exit code."""
    arguments, counts = run.arguments, run.counts
    if run.total != 1:
        words = ", ".join(f"{counts[status]} {status.replace('_', ' ')}" for status in STATUSES)
        print_note(arguments, f"{run.num_finished} panoramas in {seconds:.0f} s: {words}")
    if run.batch.priors and (unused := run.batch.priors.unused) and not interruption.number:
        note = f"{run.batch.priors.path}: {len(unused)} names of no panorama here, such as {unused[0]}"
        print_note(arguments, f"warning: {note}")
    if interruption.number:
        is_kept = is_resumable(arguments.out)
        how = "the same command goes on from here" if is_kept else "with --out FILE the same command goes on"
        text = f"ended by {SIGNALS[interruption.number]} after {run.num_finished} results; {how}"
        return print_error(arguments, text, interruption.exit_code)
    if counts[UNREADABLE]:
        return EXIT_BAD_INPUT
    return EXIT_ALL_LOCALIZED if counts[LOCALIZED] == run.num_finished else EXIT_SOME_NOT


def run_frames(arguments: argparse.Namespace) -> int:
    """The same of the frames of one walk."""
    run = prepare_run(arguments)
    settings = run.batch.settings
    if not isinstance(settings, CoarseToFineSettings):
        raise UsageError("--walk, --video: not options of the preset paper")
    with walk_inputs(arguments, list(run.panoramas)) as inputs:
        opening = partial(open_scan, run, run.localizer, arguments.threads or num_cores())
        return run_walk(arguments, inputs, settings, run.batch.read_options, opening)


def run(arguments: argparse.Namespace) -> int:
    """Localize every panorama, write the results, return the exit code."""
    if arguments.walk or arguments.video:
        return run_frames(arguments)
    watch = Stopwatch()
    run = prepare_run(arguments)
    first = next(run.panoramas, None)
    if first is None:
        print_note(arguments, f"{arguments.out or 'nothing'}: nothing is left to do")
        return finish(run, Interruption(), 0.0)
    run.panoramas = itertools.chain([first], run.panoramas)
    left = None if run.total is None else run.total - run.num_finished
    place = executing(arguments, run.localizer, left, partial(open_scan, run))
    with place as (executor, run.localizer), watch.stage("all"), output(run) as write:
        interruption = localize_all(run, executor, write)
    return finish(run, interruption, watch.seconds["all"])


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
