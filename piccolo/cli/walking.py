"""localize.py --walk and --video: frames of one walk, each of which narrows the others."""

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..batch.frame_times import times_of
from ..batch.inputs import is_from_stdin
from ..batch.relative_poses import read_odometry
from ..batch.results_file import WAYS, Records, write_results
from ..errors import InputError
from ..files.atomic import is_stream
from ..files.line_file import LineFile, open_locked, whole_lines, whole_size
from ..files.temporary import temporary_folder
from ..geometry.pose import Pose
from ..jobs.stopwatch import Stopwatch
from ..jobs.tasks import InFlight
from ..panorama.photo import sha256_of
from ..panorama.video import frames_of
from ..photo import Photo
from ..result import FAILED, UNREADABLE
from ..scan_walk import Walk
from ..walk.motion import Motion
from .command import check_alone, check_only_with, print_warnings
from .errors import EXIT_BAD_INPUT, UsageError, print_error, print_note
from .executing import Interruption, choose_exit_code, interruptible
from .options import DEFAULT_EVERY
from .progress import progress_bar, show_progress

ONLY_WITH = ("times", "max_speed", "odometry")
NOT_WITH = ("jobs", "dask", "overlay", "occlusion_mask", "priors", "refine_focal")
NUM_TRIED = 3  # frames that can't be read for one reason, and the last: then none can
KEY_BEGINS = b'{"'


class WalkInput(NamedTuple):
    """A frame of a walk."""

    photo: Photo
    time: float  # [s] since the first; of frames without times their number
    name: str  # in the results
    odometry: Pose | None = None


def check_walk_options(arguments: argparse.Namespace) -> None:
    """Refuse what does not go together."""
    is_video = arguments.video is not None
    if is_video:
        check_alone(arguments, "a video", ("times",))
    else:
        check_only_with(arguments, "--video", ("every",))
    if not (arguments.walk or is_video):
        if not arguments.pano:
            raise UsageError("the following arguments are required: --pano")
        check_only_with(arguments, "--walk or --video", ONLY_WITH)
        return
    if is_video == bool(arguments.pano):
        raise UsageError("--walk, --video: wanted --walk with --pano, or --video alone")
    if is_from_stdin(arguments.pano):
        raise UsageError("--walk: found names on stdin, wanted files or folders")
    check_alone(arguments, "a walk", NOT_WITH)
    Motion(max_speed=arguments.max_speed)  # refuses a wrong one


@contextmanager
def walk_frames(
    arguments: argparse.Namespace, photo: Photo, panoramas: Sequence[Path]
) -> Iterator[tuple[list[WalkInput], Motion]]:
    """Yield the frames of a walk, those of a video as files until the end, and how the camera was carried.

    `photo` has the options of all.
    """
    with temporary_folder() if arguments.video else nullcontext(Path()) as folder:
        times = None
        if arguments.video:
            taken = frames_of(arguments.video, arguments.every or DEFAULT_EVERY, folder)
            shots = show_progress(taken, arguments.quiet, desc="read the video", unit=" frames", leave=False)
            found = ((f.path, f.time, f"{arguments.video}#t={f.time:.3f}") for f in shots)
        else:
            times = times_of(panoramas, arguments.times)
            clock = times or [float(k) for k in range(len(panoramas))]
            found = ((p, t - clock[0], str(p)) for p, t in zip(panoramas, clock, strict=True))
        frames = [WalkInput(replace(photo, picture=path), *more) for path, *more in found]
        if arguments.odometry:
            paths = [frame.photo.path for frame in frames]
            when = times or [frame.time for frame in frames]
            poses = read_odometry(arguments.odometry, paths, when, has_clock=times is not None)
            frames = [f._replace(odometry=pose) for f, pose in zip(frames, poses, strict=True)]
        is_timed = times is not None or arguments.video is not None
        yield frames, Motion(max_speed=arguments.max_speed, is_timed=is_timed)


def run_walk(arguments: argparse.Namespace, frames: Sequence[WalkInput], walk: Walk) -> int:
    """Localize a walk, write its results, return the exit code."""
    watch = Stopwatch()
    if arguments.odometry:
        walk.more_settings["odometry_sha256"] = sha256_of(arguments.odometry, None)
    if (counts := count_finished(None if arguments.overwrite else arguments.out, walk, frames)) is not None:
        print_note(arguments, f"{arguments.out}: nothing is left to do")
        return choose_exit_code(counts)
    with watch.stage("all"):
        interruption = follow_all(arguments, walk, frames)
        if interruption.number:
            is_kept = frames_file(arguments.out) is not None
            return interruption.stop(arguments, f"{len(walk.blanks)} frames", is_kept)
        results = walk.finish(progress_bar(arguments.quiet))
    write_results(arguments.out, results)
    counts = Counter(result.status for result in results)
    if (path := frames_file(arguments.out)) and not counts[FAILED]:
        path.unlink(missing_ok=True)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    print_warnings(arguments, {w for r in results for w in r.warnings if w.startswith("`odometry`")})
    gaps = sum(result.walk is not None and result.walk.gap is not None for result in results)
    print_note(arguments, f"{len(results)} frames in {watch.seconds['all']:.0f} s: {words}; {gaps} gaps")
    return choose_exit_code(counts)


def frames_file(out: Path | None) -> Path | None:
    """Return where what was found of each frame is kept until the walk is finished; None for a stream."""
    return None if out is None or is_stream(out) else out.with_name(f"{out.name}.frames")


def follow_all(arguments: argparse.Namespace, walk: Walk, frames: Sequence[WalkInput]) -> Interruption:
    """Follow the frames, and keep what was found of each; say why one can't be read."""
    path = frames_file(arguments.out)
    with open_locked(path) if path else nullcontext() as file, ThreadPoolExecutor(1) as pool:
        if file is not None:
            take_up(walk, frames, file, arguments.overwrite)
        bar = {"desc": "frames", "total": len(frames), "initial": len(walk.blanks), "unit": ""}
        left = iter(frames[len(walk.blanks) :])
        # each is prepared while the one before it is followed
        prepared = InFlight(lambda frame: pool.submit(walk.prepare, frame.photo, frame.name), left, 2)
        with interruptible() as interruption:
            pairs = show_progress(prepared, arguments.quiet, **bar)
            for frame, wait in interruption.each(pairs) if file else pairs:
                result = walk.follow(wait(), frame.time, frame.odometry)
                if result.status == UNREADABLE and frame is frames[0]:
                    check_others(walk, frames, str(result.error), path)
                if result.error is not None:
                    print_error(arguments, result.error, EXIT_BAD_INPUT)
                if file is not None:
                    file.append(walk.last_to_json())
        pool.shutdown(cancel_futures=True)
    return interruption


def check_others(walk: Walk, frames: Sequence[WalkInput], error: str, path: Path | None) -> None:
    """Refuse a walk whose first frames, and the last, can't be read for one reason; nothing is kept."""
    others = [*frames[1:NUM_TRIED], frames[-1]]
    found = (str(walk.prepare(other.photo, other.name).blank.error) for other in others)
    is_same = (text.replace(o.name, frames[0].name) == error for text, o in zip(found, others, strict=True))
    if len(frames) > NUM_TRIED and all(is_same):
        if path:
            path.unlink()
        raise InputError(f"{error}; the other {len(frames) - 1} frames seem no better")


def take_up(walk: Walk, frames: Sequence[WalkInput], file: LineFile, is_new: bool) -> None:
    """Restore the frames that an earlier run of the same walk has left, and cut off the rest of the file."""
    path = file.path
    key = json.dumps(walk.key_of(frames[0].photo))
    size = 0 if is_new else whole_size(path, KEY_BEGINS, f"frames of a walk: {WAYS}")
    lines = whole_lines(path, size)
    first = next(lines, b"")
    if first.strip() not in (b"", key.encode()):
        raise InputError(f"{path}: found a walk with other settings, another scan or version; {WAYS}")
    kept = len(first)
    for frame, line in zip(frames, lines, strict=False):
        try:
            is_same = walk.restore(line, frame.photo, frame.time, frame.name)
        except ValueError as error:
            raise InputError(f"{path}: found a damaged line ({type(error).__name__}); {WAYS}") from error
        if not is_same:
            break
        kept += len(line)
    file.cut(kept)
    if kept == 0:
        file.append(key)


def count_finished(out: Path | None, walk: Walk, frames: Sequence[WalkInput]) -> Counter[str] | None:
    """Return the results that an earlier run of this walk has left, by status; None if it is to be done.

    It is if there are none, one has failed, or frames were others. InputError for results of something else.
    """
    if out is None or is_stream(out):
        return None
    photos = {frame.name: frame.photo for frame in frames}
    records = Records(out)
    key = walk.key_of(frames[0].photo)
    records.read(lambda name: key, photos)
    left = list(records.remaining(photos, lambda name: sha256_of(photos[name].path, photos[name].instant)))
    return None if left or not records.is_in_order else records.counts
