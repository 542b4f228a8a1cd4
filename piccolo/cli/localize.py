"""Command line: a coloured scan and 360-degree photos in, camera poses out."""

import argparse
import itertools
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tqdm import tqdm

from ..batch.inputs import described, is_from_stdin, panoramas_of
from ..batch.localizer import Answer, Localizer
from ..batch.priors import PriorTable, read_priors
from ..batch.results_file import Records
from ..confidence.confidence import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..errors import printable
from ..files.atomic import STDOUT, check_output, is_stdout, is_stream, write_atomically
from ..files.line_file import LineFile, locked, write_line
from ..jobs.memory import limit_memory
from ..jobs.stopwatch import Stopwatch
from ..jobs.tasks import Executor, Pair, WorkerLostError
from ..jobs.threads import Workers, num_cores
from ..localization.settings import CoarseToFineSettings
from ..panorama.cube import is_cube
from ..result import FAILED, UNREADABLE, Failure, Source
from ..scan import Scan
from ..scan_map.open_map import CachePolicy, scan_sha256_of
from ..scan_map.scan_map import ScanMap
from .errors import EXIT_BAD_INPUT, UsageError, checking_options, print_error, print_note, run_command
from .executing import check_execution, executing
from .interruption import SIGNALS, Interruption, Stopped, interruptible
from .localize_walk import check_plan, exit_code_of, run_walk
from .options import build_parser, check_arguments, cloud_settings_from, read_options_from, settings_from
from .outputs import check_distinct, check_suffix
from .progress import progress_bar, shown, warn_once
from .walking import check_walk_options, walk_inputs

MAX_STEM = 255 - len(".png")  # [byte] of a file name
STATUSES = (LOCALIZED, AMBIGUOUS, NOT_LOCALIZED, UNREADABLE, FAILED)
Write = Callable[[str], object]


@dataclass
class Run:
    """A command's batch, and what it has done so far."""

    arguments: argparse.Namespace
    localizer: Localizer
    panoramas: Iterable[Path]
    total: int | None  # of the panoramas; None if they come on standard input
    left_out: Counter[str]  # files in the folders named that are no panoramas, by suffix
    counts: Counter[str]  # results written, by status
    cloud_sha256: str | None = None  # of the scan, when it has been opened


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
    localizer = Localizer(
        tuple(arguments.cloud),
        settings,
        cloud_settings,
        read_options,
        cache_of(arguments),
        priors,
        makes_overlays=arguments.overlay is not None,
        makes_occlusion_masks=arguments.occlusion_mask is not None,
    )
    is_one = read_options.rig.is_instant if read_options.rig else is_cube
    left_out = Counter[str]()
    named = panoramas_of(arguments.pano, sys.stdin, left_out, is_one)
    if is_from_stdin(arguments.pano):
        check_files(arguments, [], None)
        return Run(arguments, localizer, named, None, left_out, Counter())
    known = list(named)
    check_files(arguments, known, len(known))
    for pano in known:
        localizer.settings_of(pano)
    note_unused(arguments, priors)
    return Run(arguments, localizer, known, len(known), left_out, Counter())


def note_unused(arguments: argparse.Namespace, priors: PriorTable | None) -> None:
    """Warn of names in the table of priors that no panorama has had."""
    if priors and priors.unused:
        note = f"{len(priors.unused)} names of no panorama here, such as {priors.unused[0]}"
        print_note(arguments, f"warning: {priors.path}: {note}")


def take_up(run: Run, file: LineFile | None) -> Records:
    """The results of earlier runs in the output, which are to be as those of this run would be."""
    arguments = run.arguments
    records = Records(file)
    if file and file.size and not arguments.overwrite:
        expected = run.localizer.expected(scan_sha256_of(arguments.cloud, cache_of(arguments)))
        records.read(expected, None if run.total is None else run.panoramas)
    return records


def open_scan(run: Run, localizer: Localizer, num_threads: int) -> Scan:
    """Read and prepare the scan."""
    arguments = run.arguments
    workers = Workers(num_threads, progress_bar(arguments.quiet), warn_once(arguments.quiet))
    scan = localizer.open_scan(workers)
    for warning in scan.warnings:  # those of a map prepared earlier; others have been written
        workers.warn(warning)
    run.cloud_sha256 = scan.prepared.scan_sha256 or None
    if localizer.priors and isinstance(scan.prepared, ScanMap):
        localizer.priors.check_scans(scan.prepared)
    return scan


@contextmanager
def output(out: Path) -> Iterator[tuple[LineFile | None, Write]]:
    """A function that writes one line: to stdout, a FIFO, or to the end of a file, which comes with it."""
    if is_resumable(out):
        with locked(out) as file:
            yield file, file.append
    elif is_stdout(out):
        yield None, lambda line: print(line, flush=True)
    else:
        with out.open("wb", buffering=0) as stream:
            yield None, lambda line: write_line(stream.fileno(), out, line)


def write_picture(path: Path, pano: Path, png: bytes) -> None:
    """Write a PNG of a panorama to a file, or into a folder under the panorama's name."""
    name = os.fsdecode(os.fsencode(pano.stem)[:MAX_STEM])
    write_atomically(path / f"{name}.png" if path.is_dir() else path, png)


def record(run: Run, pair: Pair, write: Write) -> None:
    """Wait for the answer to a task; write the pictures asked for and the result, and say what was found."""
    task, wait = pair
    try:
        answer: Answer = wait()
    except WorkerLostError as error:
        failure = Failure(f"{task.pano}: {error}", is_passing=True)
        answer = run.localizer.failed(task, failure, Source(run.cloud_sha256))
    arguments, result = run.arguments, answer.result
    pictures = (arguments.overlay, answer.overlay), (arguments.occlusion_mask, answer.occlusion_mask)
    for path, png in pictures:
        if path and png is not None:
            write_picture(path, Path(result.pano), png)
    if result.error is not None:
        print_error(arguments, result.error, EXIT_BAD_INPUT)
    elif not arguments.quiet:
        warnings = (f"warning: {printable(warning)}" for warning in answer.warnings)
        for line in (*warnings, result.summary()):
            tqdm.write(line, file=sys.stderr)
    write(result.to_json())
    run.counts[result.status] += 1


def localize_all(
    run: Run, records: Records, left: Iterable[Path], executor: Executor, write: Write
) -> Interruption:
    """Localize the panoramas that are left, write each result as it comes, until a signal ends it."""
    is_quiet = run.arguments.quiet or run.total == 1
    bar = {"desc": "panoramas", "total": run.total, "initial": records.counts.total(), "unit": ""}
    values = executor.values(map(run.localizer.task, left))
    with interruptible() as interruption, suppress(Stopped):
        for pair in shown(values, is_quiet, **bar):
            with interruption.postponed() if run.total != 1 else nullcontext():
                record(run, pair, write)
            if interruption.number:
                break
        for pair in values.finished():  # behind the one after which a signal has ended it
            with interruption.postponed():
                record(run, pair, write)
    return interruption


def finish(run: Run, records: Records, interruption: Interruption, seconds: float) -> int:
    """Put the results in order, say what was done, and how to go on; the exit code."""
    arguments, counts = run.arguments, run.counts + records.counts
    num_dropped = 0 if interruption.number else records.finish(keeps_others=run.total is None)
    if run.total != 1 or run.left_out or num_dropped:
        words = ", ".join(f"{counts[status]} {status.replace('_', ' ')}" for status in STATUSES)
        again = ", which the same command tries again" if counts[FAILED] else ""
        note = f"{counts.total()} panoramas in {seconds:.0f} s: {words}{again}"
        dropped = f"dropped {num_dropped} results of panoramas not named any more" if num_dropped else ""
        print_note(arguments, "; ".join(filter(None, (note, dropped, described(run.left_out)))))
    if interruption.number:
        is_kept = is_resumable(arguments.out)
        how = "the same command goes on from here" if is_kept else "with --out FILE the same command goes on"
        text = f"ended by {SIGNALS[interruption.number]} after {counts.total()} results; {how}"
        return print_error(arguments, text, interruption.exit_code)
    if run.total is None:
        note_unused(arguments, run.localizer.priors)
    return exit_code_of(counts)


def run_frames(arguments: argparse.Namespace) -> int:
    """Localize the frames of one walk, return the exit code."""
    run = prepare_run(arguments)
    settings, read_options = run.localizer.settings, run.localizer.read_options
    if not isinstance(settings, CoarseToFineSettings):
        raise UsageError("--walk, --video: not options of the preset paper")
    with walk_inputs(arguments, list(run.panoramas)) as inputs:
        opening = partial(open_scan, run, run.localizer, arguments.threads or num_cores())
        if run.left_out:
            print_note(arguments, described(run.left_out))
        return run_walk(arguments, inputs, settings, read_options, opening)


def run(arguments: argparse.Namespace) -> int:
    """Localize every panorama, write the results, return the exit code."""
    if arguments.walk or arguments.video:
        return run_frames(arguments)
    watch = Stopwatch()
    run = prepare_run(arguments)
    with output(arguments.out or STDOUT) as (file, write):
        records = take_up(run, file)
        panoramas = iter(run.panoramas)
        if run.total is not None:
            panoramas = progress_bar(arguments.quiet)(panoramas, run.total, "check what is finished")
        left = records.left(panoramas, run.localizer.read_options.rig)
        num_left = None
        if run.total is not None:
            known = list(left)
            left = iter(known)
            num_left = len(known)
        first = next(left, None)
        if first is None:
            print_note(arguments, f"{arguments.out or 'nothing'}: nothing is left to do")
            return finish(run, records, Interruption(), 0.0)
        place = executing(arguments, run.localizer, num_left, partial(open_scan, run))
        with place as (executor, run.localizer), watch.stage("all"):
            records.begin()
            interruption = localize_all(run, records, itertools.chain([first], left), executor, write)
        return finish(run, records, interruption, watch.seconds["all"])


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
