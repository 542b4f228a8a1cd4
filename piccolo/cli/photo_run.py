"""The work of localize.py: its photos, one by one or together, and its results."""

import itertools
import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ..api.scan import Scan
from ..api.values import (
    FAILED,
    LOCALIZED,
    STATUSES,
    Change,
    CoarseToFineSettings,
    Reason,
    Result,
    Step,
)
from ..batch.answering import Answering, count_looks, follow_all
from ..batch.inputs import describe_left_out, is_from_stdin, list_panoramas, read_priors
from ..batch.localizer import Answer, Localizer
from ..batch.results_file import FileOutput, Output, Records, StreamOutput
from ..photo.panorama.cube import is_cube
from ..photo.panorama.facts import sha256_of
from ..photo.panorama.masks import find_mask
from ..photo.photo import Photo
from ..scan_map.open_map import scan_sha256_of
from ..scan_map.scan_map import ScanMap
from ..system.arguments import PICTURES
from ..system.errors import InputError
from ..system.files.atomic import (
    STDOUT,
    check_output,
    is_stdout,
    is_stream,
    write_atomically,
)
from ..system.files.line_file import open_locked, write_line
from ..system.jobs.interruption import Interruption, interruptible
from ..system.jobs.memory import limit_memory
from ..system.jobs.threads import Stopwatch, num_cores
from . import execution, terminal, together
from .command import Arguments, UsageError, check_distinct, check_suffix, checking_options
from .options import check_arguments
from .settings_given import localizer_from

MAX_STEM = 255 - len(".png")  # [byte] of a file name
NUM_MIRRORED = 2  # of the photos that were not localized
LEFT_HANDED = (
    "the photos fit the scan mirrored, left for right: its axes are left-handed, which `up` can't mend; "
    "negate one of its coordinates, or export it with right-handed axes"
)
JOINT = ("walk", "video", "relative", "together", "color_scan")  # options of photos that help each other
Write = Callable[[str], object]


def ignore_step(line: str) -> None:
    """Write no step of a search: nobody asked for them."""


@dataclass
class Run:
    """A command's batch, and what it has done so far."""

    arguments: Arguments
    localizer: Localizer
    panoramas: Iterable[Path]
    total: int | None  # of the panoramas; None if they come on standard input
    left_out: Counter[str]  # files in the folders named that are no panoramas, by suffix
    counts: Counter[str]  # results written, by status
    cloud_sha256: str | None = None  # of the scan, when it has been opened
    are_mirrored: list[bool] = field(default_factory=list)  # of spheres that were not localized
    write_step: Write = ignore_step  # of a search

    @property
    def looks_again(self) -> bool:
        """True if photos that are not sure are looked at again beside others."""
        is_default = isinstance(self.localizer.settings, CoarseToFineSettings)
        return is_default and self.total not in (None, 1) and not self.localizer.sends_photos


def check_files(arguments: Arguments, panoramas: list[Path], total: int | None) -> None:
    """Refuse, before any work, what could not be written, or would replace an input or another output."""
    a = arguments
    given = filter(None, (a.mask, a.priors, a.camera, a.rig, *(a.video or ()), a.relative, a.odometry))
    lists = [Path(word[1:]) for word in arguments.pano if word.startswith("@")]
    pictures = {"--overlay": arguments.overlay, "--occlusion-mask": arguments.occlusion_mask}
    outputs = {"--out": a.out or STDOUT, "--color-scan": a.color_scan, "--trace": a.trace, **pictures}
    check_distinct(outputs, [*arguments.cloud, *panoramas, *lists, *given])
    mask = arguments.mask and Path(arguments.mask)
    if mask and mask.is_dir() and panoramas and total and not any(find_mask(mask, p) for p in panoramas):
        raise InputError(f"{mask}: found no mask of {panoramas[0].name} or another photo, wanted NAME.png")
    check_output(arguments.out or STDOUT)
    for path in filter(None, (arguments.color_scan, arguments.trace)):
        check_output(path)
    for option, path in pictures.items():
        if path is None or path.is_dir():
            continue
        if total != 1:
            found = "names on stdin" if total is None else f"{total} photos"
            raise UsageError(f"{option}: found {found}, wanted one photo or a folder that exists")
        check_suffix(option, path, (".png",))
        check_output(path)


def prepare_run(arguments: Arguments) -> Run:
    """Return what is to be done: the options, the panoramas, and how many there are."""
    with checking_options():
        check_arguments(arguments)
        together.check_joint_options(arguments)
        execution.check_execution(arguments)
        limit_memory(arguments.max_memory)
        localizer = localizer_from(arguments, tuple(arguments.cloud))
    priors = None
    if arguments.priors:
        if not isinstance(localizer.settings, CoarseToFineSettings):
            raise UsageError("--priors: not an option of the preset paper")
        priors = read_priors(arguments.priors, localizer.settings.prior)
    masks = arguments.occlusion_mask is not None
    overlays = arguments.overlay is not None
    localizer = replace(localizer, priors=priors, makes_overlays=overlays, makes_occlusion_masks=masks)
    localizer = replace(localizer, is_traced=arguments.trace is not None)
    rig = localizer.photo.instant
    is_one = rig.is_instant if rig else is_cube
    left_out = Counter[str]()
    named = list_panoramas(arguments.pano, sys.stdin, left_out, is_one)
    if is_from_stdin(arguments.pano):
        check_files(arguments, [], None)
        return Run(arguments, localizer, named, None, left_out, Counter())
    known = list(named)
    check_files(arguments, known, len(known))
    for pano in known:
        localizer.ask(pano)
    note_unused_priors(arguments, localizer)
    return Run(arguments, localizer, known, len(known), left_out, Counter())


def note_unused_priors(arguments: Arguments, localizer: Localizer) -> None:
    """Warn of names in the table of priors that no panorama has had."""
    priors = localizer.priors
    if priors and (names := [name for name in priors.by_name if name not in priors.used]):
        note = f"{len(names)} names without a photo, such as {names[0]}"
        arguments.note(f"warning: {priors.path}: {note}")


def open_scan_of_run(run: Run, localizer: Localizer, num_threads: int) -> Scan:
    """Read and prepare the scan."""
    workers = run.arguments.workers(num_threads)
    scan = localizer.open_scan(workers)
    for warning in scan.warnings:  # those of a map prepared earlier; others have been written
        workers.warn(warning)
    run.cloud_sha256 = scan.prepared.scan_sha256 or None
    if localizer.priors and isinstance(scan.prepared, ScanMap):
        localizer.priors.check_scans(scan.prepared)
    return scan


@contextmanager
def open_output(run: Run) -> Iterator[tuple[Output, Records]]:
    """Yield where the results go, and which an earlier run has left there."""
    out = run.arguments.out or STDOUT
    if is_stdout(out):
        with closing(StreamOutput(lambda line: print(line, flush=True), run.looks_again)) as output:
            yield output, Records()
    elif is_stream(out):
        with out.open("wb", buffering=0) as stream:
            write = partial(write_line, stream.fileno(), out)
            with closing(StreamOutput(write, run.looks_again)) as output:
                yield output, Records()
    else:
        with open_locked(out) as file:
            records = Records(file.path)
            if file.size and not run.arguments.overwrite:
                expected = run.localizer.expect(scan_sha256_of(run.arguments.cloud, run.localizer.cache))
                records.read(expected, None if run.total is None else run.panoramas)
            yield FileOutput(file, records), records


def record(run: Run, answer: Answer, write: Write) -> None:
    """Write the pictures asked for and the result, and say what was found."""
    result = answer.result
    write_photo_pictures(run.arguments, result.pano, answer.overlay, answer.occlusion_mask)
    execution.print_result(run.arguments, result, answer.warnings)
    write_steps(run, result.pano, answer.steps)
    write(result.to_json())
    run.counts[result.status] += 1
    was_read = result.probability_none is not None
    if was_read and result.pose is None and not result.cameras:
        run.are_mirrored.append(Reason.MIRRORED in result.belief.ruled_out)


def write_photo_pictures(
    arguments: Arguments, pano: str, overlay: bytes | None, occlusion_mask: bytes | None
) -> None:
    """Write the pictures of a photo that are asked for, in folders by its name."""
    path = Path(pano)
    name = path.stem if path.suffix.lower() in PICTURES else path.name  # of a frame of a video, with its time
    while len(os.fsencode(name)) > MAX_STEM:
        name = name[:-1]
    pictures = (arguments.overlay, overlay), (arguments.occlusion_mask, occlusion_mask)
    for place, png in pictures:
        if place and png is not None:
            write_atomically(place / f"{name}.png" if place.is_dir() else place, png)


def write_steps(run: Run, pano: str, steps: Sequence[Step]) -> None:
    """Write the steps of a photo's search to the file of --trace, if it is asked for."""
    for step in steps:
        run.write_step(json.dumps({"pano": pano, **step}))


@contextmanager
def tracing(run: Run) -> Iterator[None]:
    """Write the steps of searches to the file of --trace, from its beginning, if it is given."""
    path = run.arguments.trace
    if path is None:
        yield
        return
    with path.open("wb", buffering=0) as stream:
        run.write_step = partial(write_line, stream.fileno(), path)
        yield


def localize_all(
    run: Run, records: Records, left: Iterable[Path], answering: Answering, write: Write
) -> Interruption:
    """Localize the panoramas that are left, write each result as it comes, until a signal ends it."""
    is_one = run.total == 1
    bar: dict[str, Any] = {"desc": "photos", "total": run.total, "unit": ""}
    bar["initial"] = records.counts.total()
    show = partial(terminal.show_progress, is_quiet=run.arguments.quiet or is_one, **bar)
    tasks = map(run.localizer.task, left)
    with interruptible() as interruption:
        signals = None if is_one else interruption
        for answer in answering.answer_all(tasks, show, signals):
            record(run, answer, write)
    return interruption


def record_change(run: Run, change: Change, answer: Answer, output: Output) -> None:
    """Replace a result by what others have made of it, and say so if that is news."""
    replace_line = partial(output.replace, change.number)
    if change.is_news:
        run.counts[change.before.status] -= 1
        record(run, answer, replace_line)
    else:
        replace_line(change.after.to_json())


def follow_all_cameras(run: Run, results: list[Result], output: Output) -> None:
    """Change results by what all photos of a camera say of its focal length."""
    for change, answer in follow_all(results, run.localizer.settings.min_confidence):
        record_change(run, change, answer, output)


def look_again(run: Run, answering: Answering, output: Output) -> Interruption:
    """Look again at photos, with what others say of their camera, then beside others, until a signal."""

    def show(looks: Iterable[Any], total: int) -> Iterable[Any]:
        bar: dict[str, Any] = {"desc": "second look", "total": total, "unit": ""}
        return terminal.show_progress(looks, run.arguments.quiet, **bar)

    with interruptible() as interruption:
        looked = answering.look_again(output.results(), show, interruption, run.arguments.error)
        for change, answer in looked:
            record_change(run, change, answer, output)
    return interruption


def note_left_handed(run: Run, records: Records, interruption: Interruption) -> None:
    """Say so if no photo was localized, but most of the first spheres fit when they are mirrored."""
    is_over = interruption.number or run.counts[LOCALIZED] or records.counts[LOCALIZED]
    first = run.are_mirrored[:NUM_MIRRORED]
    if not is_over and len(first) == NUM_MIRRORED and 2 * sum(first) >= NUM_MIRRORED:
        run.arguments.note(LEFT_HANDED)


def finish(run: Run, records: Records, output: Output, interruption: Interruption, seconds: float) -> int:
    """Put the results in order, say what was done, and how to go on; return the exit code."""
    arguments = run.arguments
    counts = Counter(run.counts)
    counts.update(records.counts)
    num_dropped = 0
    if isinstance(output, FileOutput) and not interruption.number:
        num_dropped = output.finish(keeps_others=run.total is None)
    if run.total != 1 or run.left_out or num_dropped:
        words = ", ".join(f"{counts[status]} {status.replace('_', ' ')}" for status in STATUSES)
        again = ", which the same command will try again" if counts[FAILED] else ""
        note = f"{counts.total()} photos in {seconds:.0f} s: {words}{again}"
        dropped = f"dropped {num_dropped} results of photos that are no longer given" if num_dropped else ""
        parts = note, dropped, describe_left_out(run.left_out)
        arguments.note("; ".join(filter(None, parts)))
    if interruption.number:
        return execution.stop(
            interruption, arguments, f"{counts.total()} results", isinstance(output, FileOutput)
        )
    if run.total is None:
        note_unused_priors(arguments, run.localizer)
    return execution.choose_exit_code(+counts)


def run_jointly(run: Run) -> int:
    """Localize photos that help each other, return the exit code."""
    arguments = run.arguments
    localizer = run.localizer
    if not isinstance(localizer.settings, CoarseToFineSettings):
        option = next(name for name in JOINT if getattr(arguments, name))
        raise UsageError(f"--{option.replace('_', '-')}: not an option of the preset paper")
    photos = list(run.panoramas)
    steps_of = partial(write_steps, run)
    with ExitStack() as stack:
        if together.is_walk(arguments):
            taken = together.walk_frames(arguments, localizer.photo, photos)
            frames, motion = stack.enter_context(taken)
            if run.left_out:
                arguments.note(describe_left_out(run.left_out))
            scan = open_scan_of_run(run, localizer, arguments.threads or num_cores())
            asked = together.ask_for_walk(arguments, frames, scan, motion, steps_of)
        elif arguments.video:
            shown = stack.enter_context(together.distinct_frames(arguments))
            scan = open_scan_of_run(run, localizer, arguments.threads or num_cores())
            asked = together.ask_together(arguments, shown, localizer, scan, steps_of)
        else:
            scan = open_scan_of_run(run, localizer, arguments.threads or num_cores())
            asked = together.choose_job(arguments)(arguments, photos, localizer, scan, steps_of)
        stack.enter_context(tracing(run))

        def write(photo: Photo, result: Result) -> None:
            write_photo_pictures(arguments, result.pano, *localizer.make_pictures(scan, photo, result))

        return together.run_together(arguments, asked, write)


def localize_photos(arguments: Arguments) -> int:
    """Localize every panorama, write the results, return the exit code."""
    watch = Stopwatch()
    run = prepare_run(arguments)
    if any(getattr(arguments, name) for name in JOINT):
        return run_jointly(run)
    rig = run.localizer.photo.instant
    with open_output(run) as (output, records):
        panoramas = iter(run.panoramas)
        if run.total is not None:
            show = arguments.progress()
            panoramas = show(panoramas, run.total, "check what is finished")
        left = records.remaining(panoramas, lambda pano: sha256_of(pano, rig))
        num_left = None
        if run.total is not None:
            known = list(left)
            left = iter(known)
            num_left = len(known)
        first = next(left, None)
        if isinstance(output, FileOutput):
            output.begin()
        results = output.results() if first is None and run.looks_again else []
        follow_all_cameras(run, results, output)
        num_looks = count_looks(results)
        if first is None and not num_looks:
            arguments.note(f"{arguments.out or 'nothing'}: nothing is left to do")
            return finish(run, records, output, Interruption(), 0.0)
        num_jobs = execution.count_jobs(arguments, num_left or num_looks or None)
        opening = partial(open_scan_of_run, run)
        with (
            execution.connecting(arguments) as cluster,
            execution.executing(arguments, run.localizer, num_jobs, cluster, opening) as place,
            tracing(run),
            watch.stage("all"),
        ):
            executor, run.localizer = place
            answering = Answering(executor, run.localizer, run.cloud_sha256)
            rest = itertools.chain([first] if first else [], left)
            interruption = localize_all(run, records, rest, answering, output.write)
            if run.looks_again and not interruption.number:
                interruption = look_again(run, answering, output)
            note_left_handed(run, records, interruption)
        return finish(run, records, output, interruption, watch.seconds["all"])
