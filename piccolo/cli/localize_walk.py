"""localize.py --walk and --video: each frame is told by those before and after it."""

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from .. import __version__
from ..batch.results_file import WAYS, finished_lines
from ..camera import Calibration
from ..confidence.confidence import LOCALIZED
from ..errors import InputError
from ..files.atomic import STDOUT, check_output, is_stream, write_atomically
from ..files.line_file import locked, whole_lines, whole_size
from ..jobs.stopwatch import Stopwatch
from ..localization.settings import CoarseToFineSettings
from ..optional import import_optional
from ..panorama import ReadOptions
from ..panorama.photo import sha256_of
from ..result import FAILED, UNREADABLE, Result, read_results
from ..scan import Scan
from ..scan_map.scan_map import ScanMap
from ..scan_walk import Prepared, Walk
from .errors import EXIT_BAD_INPUT, print_error, print_note
from .interruption import SIGNALS, Interruption, Stopped, interruptible
from .outputs import check_suffix
from .progress import progress_bar, shown
from .walking import WalkInput, WalkInputs

EXIT_ALL_LOCALIZED, EXIT_SOME_NOT = 0, 1
KEY_BEGINS = b'{"'
KEYS = ("settings", "cloud_sha256", "version")  # that all results of a walk have in common


def run_walk(
    arguments: argparse.Namespace,
    inputs: WalkInputs,
    settings: CoarseToFineSettings,
    read_options: ReadOptions,
    open_scan: Callable[[], Scan],
) -> int:
    """Localize a walk, write its results, return the exit code."""
    watch = Stopwatch()
    scan = open_scan()
    walk = scan.walk(read_options, settings, inputs.motion)
    key = key_of(walk)
    if (statuses := finished_statuses(arguments, key, inputs, read_options.rig)) is not None:
        print_note(arguments, f"{arguments.out}: nothing is left to do")
        write_plan(arguments.plan, scan, read_results([arguments.out]) if arguments.plan else [])
        return exit_code_of(statuses)
    with watch.stage("all"):
        interruption = follow_all(arguments, walk, inputs.frames, json.dumps(key))
        if interruption.number:
            kept = "the same command goes on" if kept_in(arguments.out) else "with --out FILE it would go on"
            text = f"ended by {SIGNALS[interruption.number]} after {len(walk.taken)} frames; {kept}"
            return print_error(arguments, text, interruption.exit_code)
        results = spaced(walk.finish(progress_bar(arguments.quiet)), inputs.min_distance)
    write_all(arguments.out, results)
    write_plan(arguments.plan, scan, results)
    counts = Counter(result.status for result in results)
    if (path := kept_in(arguments.out)) and not counts[FAILED]:
        path.unlink(missing_ok=True)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    gaps = sum(result.walk is not None and result.walk.gap is not None for result in results)
    print_note(arguments, f"{len(results)} frames in {watch.seconds['all']:.0f} s: {words}; {gaps} gaps")
    return exit_code_of(counts)


def check_plan(path: Path) -> None:
    """Refuse, before any work, a plan that could not be written."""
    from ..report.plan_file import DXF, SUFFIXES  # noqa: PLC0415  # only walks with a plan wait for it

    check_suffix("--plan", path, SUFFIXES)
    check_output(path)
    import_optional("--plan", "ezdxf" if path.suffix.lower() == DXF else "matplotlib", "tools")


def write_plan(path: Path | None, scan: Scan, results: Sequence[Result]) -> None:
    """Draw the path on the scan from above, if asked for."""
    if path is None or not isinstance(scan.prepared, ScanMap):
        return
    from ..report.build import ReportSettings  # noqa: PLC0415  # only walks with a plan wait for it
    from ..report.entries import entries_of_walk  # noqa: PLC0415
    from ..report.plan_file import write_plan_file  # noqa: PLC0415

    write_plan_file(entries_of_walk(results), scan.prepared, path, ReportSettings())


def exit_code_of(statuses: Collection[str]) -> int:
    """0 if all photos are localized, 3 if one can't be read or has failed, else 1."""
    if UNREADABLE in statuses or FAILED in statuses:
        return EXIT_BAD_INPUT
    return EXIT_ALL_LOCALIZED if set(statuses) <= {LOCALIZED} else EXIT_SOME_NOT


def key_of(walk: Walk) -> dict[str, Any]:
    """What must be the same where a walk goes on."""
    digest = walk.tracker.scan_map.scan_sha256 or None
    settings = json.loads(json.dumps(walk.about.settings))
    return {"settings": settings, "cloud_sha256": digest, "version": __version__}


def kept_in(out: Path | None) -> Path | None:
    """Where what was found of each frame is kept until the walk is finished; None for a stream."""
    return None if out is None or is_stream(out) else out.with_name(f"{out.name}.frames")


def follow_all(
    arguments: argparse.Namespace, walk: Walk, frames: Sequence[WalkInput], key: str
) -> Interruption:
    """Follow the frames, and keep what was found of each."""
    path = kept_in(arguments.out)
    with locked(path) if path else nullcontext() as file:
        if file is not None:
            file.cut(0 if arguments.overwrite else take_up(walk, frames, file.path, key))
            if file.size == 0:
                file.append(key)
        bar = {"desc": "frames", "total": len(frames), "initial": len(walk.taken), "unit": ""}
        left = shown(frames[len(walk.taken) :], arguments.quiet, **bar)
        with interruptible() as interruption, suppress(Stopped):
            for frame, prepared in ahead(walk, left):
                with interruption.postponed() if file else nullcontext():
                    follow(arguments, walk, prepared, frame)
                    if file is not None:
                        file.append(walk.last_to_json())
                if interruption.number:
                    break
    return interruption


def follow(arguments: argparse.Namespace, walk: Walk, prepared: Prepared, frame: WalkInput) -> None:
    """Follow a frame, and say why one can't be read."""
    result = walk.follow(prepared, frame.time)
    if result.error is not None:
        print_error(arguments, result.error, EXIT_BAD_INPUT)


def ahead(walk: Walk, frames: Iterable[WalkInput]) -> Iterator[tuple[WalkInput, Prepared]]:
    """Frames, each prepared while the one before it is followed."""
    with ThreadPoolExecutor(1) as pool:
        waiting: tuple[WalkInput, Future[Prepared]] | None = None
        for frame in frames:
            last, waiting = waiting, (frame, pool.submit(walk.prepare, frame.path, frame.name))
            if last is not None:
                yield last[0], last[1].result()
        if waiting is not None:
            yield waiting[0], waiting[1].result()


def take_up(walk: Walk, frames: Sequence[WalkInput], path: Path, key: str) -> int:
    """Restore the frames that an earlier run of the same walk has left; the size of their lines [byte]."""
    size = whole_size(path, KEY_BEGINS, f"frames of a walk: {WAYS}")
    lines = whole_lines(path, size)
    first = next(lines, b"")
    if first.strip() not in (b"", key.encode()):
        raise InputError(f"{path}: of a walk with other settings, another scan or version; {WAYS}")
    kept = len(first)
    for frame, line in zip(frames, lines, strict=False):
        try:
            is_same = walk.restore(line.decode(), frame.path, frame.time, frame.name)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: found a damaged line ({type(error).__name__}); {WAYS}") from error
        if not is_same:
            break
        kept += len(line)
    return kept


def spaced(results: Sequence[Result], metres: float) -> list[Result]:
    """The results that lie so far apart, and all that have no pose."""
    kept: list[Result] = []
    last = None
    for result in results:
        center = result.pose.center_world if result.pose else None
        if center is not None and last is not None and math.dist(center, last) < metres:
            continue
        last = last if center is None else center
        kept.append(result)
    return kept


def finished_statuses(
    arguments: argparse.Namespace, key: dict[str, Any], inputs: WalkInputs, rig: Calibration | None
) -> list[str] | None:
    """The statuses of the results that an earlier run of this walk has left; None if it is to be done.

    It is if there are none, one has failed, or frames were others. InputError for results of something else.
    """
    out = arguments.out
    if arguments.overwrite or out is None or is_stream(out) or not out.exists() or not out.stat().st_size:
        return None
    statuses: list[str] = []
    digests: dict[str, str | None] = {}
    for fields in finished_lines(out):
        different = next((name for name in KEYS if fields.get(name) != key[name]), None)
        if different or fields["walk"] is None:
            raise InputError(f"{fields['line']}: of another run ({different or 'no walk'}); {WAYS}")
        statuses.append(str(fields["status"]))
        digests[str(fields["pano"])] = fields["pano_sha256"]
    paths = {frame.name: frame.path for frame in inputs.frames}
    if not digests.keys() & paths.keys():
        raise InputError(f"{out}: none of its results is of a frame of this walk; {WAYS}")
    is_done = digests.keys() <= paths.keys() if inputs.min_distance else list(digests) == list(paths)
    is_done = is_done and FAILED not in statuses
    is_done = is_done and all(sha256_of(paths[name], rig) in (None, digests[name]) for name in digests)
    return statuses if is_done else None


def write_all(out: Path | None, results: Sequence[Result]) -> None:
    """Write the results, whole or not at all."""
    text = "".join(f"{result.to_json()}\n" for result in results)
    if out is None or out == STDOUT:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_atomically(out, text.encode())
