"""localize.py --walk and --video: frames of one walk, each of which narrows the others."""

import argparse
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from .. import __version__
from ..batch.frame_times import times_of
from ..batch.inputs import is_from_stdin
from ..batch.relative_poses import read_odometry
from ..batch.results_file import WAYS, Records, write_results
from ..camera import Calibration
from ..errors import InputError
from ..files.atomic import is_stream
from ..files.line_file import LineFile, open_locked, whole_lines, whole_size
from ..files.temporary import temporary_folder
from ..geometry.pose import Pose
from ..jobs.stopwatch import Stopwatch
from ..jobs.tasks import InFlight
from ..localization.settings import CoarseToFineSettings
from ..opened_scan import OpenedScan
from ..panorama import ReadOptions
from ..panorama.photo import sha256_of
from ..panorama.video import frames_of
from ..result import FAILED, Result
from ..scan_walk import Walk
from ..walk.motion import Motion
from .errors import EXIT_BAD_INPUT, UsageError, print_error, print_note
from .executing import Interruption, choose_exit_code, interruptible
from .options import DEFAULT_EVERY, check_alone
from .progress import progress_bar, show_progress

STEP = re.compile(r"(\d+(?:\.\d+)?)(s|m)")
ONLY_WITH = ("times", "max_speed", "odometry")
NOT_WITH = ("jobs", "dask", "overlay", "occlusion_mask", "priors", "refine_focal")
KEY_BEGINS = b'{"'


class WalkInput(NamedTuple):
    """A frame of a walk."""

    path: Path
    time: float  # [s] since the first; of frames without times their number
    name: str  # in the results
    odometry: Pose | None = None


class WalkInputs(NamedTuple):
    """A walk's frames."""

    frames: list[WalkInput]
    motion: Motion  # how the camera is carried
    min_distance: float  # [m] below which frames are dropped


def check_walk_options(arguments: argparse.Namespace) -> None:
    """Refuse what does not go together; take the step of a video apart from its path."""
    is_video = arguments.video is not None
    arguments.video, arguments.step = take_step(arguments.video or [None])
    if not (arguments.walk or is_video):
        if not arguments.pano:
            raise UsageError("the following arguments are required: --pano")
        for name in ONLY_WITH:
            if getattr(arguments, name) is not None:
                raise UsageError(f"--{name.replace('_', '-')}: only with --walk or --video")
        return
    speed = arguments.max_speed
    wrong = {
        f"--max-speed: found {speed}, wanted a number above 0": speed is not None
        and not 0.0 < speed < math.inf,
        "--walk, --video: wanted --walk with --pano, or --video alone": is_video == bool(arguments.pano),
        "--walk: found names on stdin, wanted files or folders": is_from_stdin(arguments.pano),
        "--times: not with --video, which contains its times": is_video and arguments.times is not None,
    }
    for text, is_so in wrong.items():
        if is_so:
            raise UsageError(text)
    check_alone(arguments, "a walk", NOT_WITH)


def take_step(words: Sequence[Path | None]) -> tuple[Path | None, str]:
    """Return the path and the step of --video, a path of None without."""
    path, *step = words
    if len(step) > 1:
        raise UsageError(f"--video: found {len(words)} words, wanted a file and a step, such as 0.5s")
    return path, str(step[0]) if step else DEFAULT_EVERY


def measure_step(text: str, max_speed: float) -> tuple[float, float]:
    """Return the seconds from frame to frame, and the metres below which frames are dropped, of a step."""
    found = STEP.fullmatch(text)
    if not found or not 0.0 < float(found[1]) < math.inf:
        raise UsageError(f"--video: found the step {text!r}, wanted seconds or metres, such as 0.5s or 1m")
    value = float(found[1])
    return (value, 0.0) if found[2] == "s" else (value / max_speed, value)


@contextmanager
def walk_inputs(arguments: argparse.Namespace, panoramas: Sequence[Path]) -> Iterator[WalkInputs]:
    """Yield the frames of a walk; those of a video are files until the end."""
    if arguments.video is None:
        times = times_of(panoramas, arguments.times)
        numbers = times or [float(k) for k in range(len(panoramas))]
        frames = [WalkInput(p, t, str(p)) for p, t in zip(panoramas, numbers, strict=True)]
        motion = Motion(arguments.max_speed, is_timed=times is not None)
        yield WalkInputs(add_odometry(frames, arguments.odometry), motion, 0.0)
        return
    motion = Motion(arguments.max_speed)
    seconds, metres = measure_step(arguments.step, motion.speed)
    with temporary_folder() as folder:
        found = frames_of(arguments.video, seconds, folder)
        bar = {"desc": "read the video", "unit": " frames", "leave": False}
        shots = show_progress(found, arguments.quiet, **bar)
        frames = [WalkInput(f.path, f.time, f"{arguments.video}#t={f.time:.3f}") for f in shots]
        yield WalkInputs(add_odometry(frames, arguments.odometry), motion, metres)


def add_odometry(frames: list[WalkInput], path: Path | None) -> list[WalkInput]:
    """Return the frames with their poses in an odometry, if there is one."""
    if path is None:
        return frames
    poses = read_odometry(path, [frame.path for frame in frames], [frame.time for frame in frames])
    return [frame._replace(odometry=pose) for frame, pose in zip(frames, poses, strict=True)]


def run_walk(
    arguments: argparse.Namespace,
    inputs: WalkInputs,
    settings: CoarseToFineSettings,
    read_options: ReadOptions,
    open_scan: Callable[[], OpenedScan],
) -> int:
    """Localize a walk, write its results, return the exit code."""
    watch = Stopwatch()
    scan = open_scan()
    walk = scan.walk(read_options, settings, inputs.motion)
    key = make_key(walk, arguments.odometry)
    if (counts := count_finished(arguments, key, inputs, read_options.rig)) is not None:
        print_note(arguments, f"{arguments.out}: nothing is left to do")
        return choose_exit_code(counts)
    with watch.stage("all"):
        interruption = follow_all(arguments, walk, inputs.frames, json.dumps(key))
        if interruption.number:
            how = (
                "the same command continues"
                if frames_file(arguments.out)
                else "with --out FILE it would continue"
            )
            return interruption.stop(arguments, f"{len(walk.taken)} frames", how)
        results = keep_spaced(walk.finish(progress_bar(arguments.quiet)), inputs.min_distance)
    write_results(arguments.out, results)
    counts = Counter(result.status for result in results)
    if (path := frames_file(arguments.out)) and not counts[FAILED]:
        path.unlink(missing_ok=True)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    gaps = sum(result.walk is not None and result.walk.gap is not None for result in results)
    print_note(arguments, f"{len(results)} frames in {watch.seconds['all']:.0f} s: {words}; {gaps} gaps")
    return choose_exit_code(counts)


def make_key(walk: Walk, odometry: Path | None) -> dict[str, Any]:
    """Return what must be the same where a walk goes on."""
    if odometry is not None:
        walk.about.settings["odometry_sha256"] = sha256_of(odometry, None)
    digest = walk.tracker.scan_map.scan_sha256 or None
    settings = json.loads(json.dumps(walk.about.settings))
    return {"settings": settings, "cloud_sha256": digest, "version": __version__}


def frames_file(out: Path | None) -> Path | None:
    """Return where what was found of each frame is kept until the walk is finished; None for a stream."""
    return None if out is None or is_stream(out) else out.with_name(f"{out.name}.frames")


def follow_all(
    arguments: argparse.Namespace, walk: Walk, frames: Sequence[WalkInput], key: str
) -> Interruption:
    """Follow the frames, and keep what was found of each; say why one can't be read."""
    path = frames_file(arguments.out)
    with open_locked(path) if path else nullcontext() as file, ThreadPoolExecutor(1) as pool:
        if file is not None:
            take_up(walk, frames, file, key, arguments.overwrite)
        bar = {"desc": "frames", "total": len(frames), "initial": len(walk.taken), "unit": ""}
        left = iter(frames[len(walk.taken) :])
        # each is prepared while the one before it is followed
        prepared = InFlight(lambda frame: pool.submit(walk.prepare, frame.path, frame.name), left, 2)
        with interruptible() as interruption:
            pairs = show_progress(prepared, arguments.quiet, **bar)
            for frame, wait in interruption.each(pairs) if file else pairs:
                result = walk.follow(wait(), frame.time, frame.odometry)
                if result.error is not None:
                    print_error(arguments, result.error, EXIT_BAD_INPUT)
                if file is not None:
                    file.append(walk.last_to_json())
        pool.shutdown(cancel_futures=True)
    return interruption


def take_up(walk: Walk, frames: Sequence[WalkInput], file: LineFile, key: str, is_new: bool) -> None:
    """Restore the frames that an earlier run of the same walk has left, and cut off the rest of the file."""
    path = file.path
    size = 0 if is_new else whole_size(path, KEY_BEGINS, f"frames of a walk: {WAYS}")
    lines = whole_lines(path, size)
    first = next(lines, b"")
    if first.strip() not in (b"", key.encode()):
        raise InputError(f"{path}: found a walk with other settings, another scan or version; {WAYS}")
    kept = len(first)
    for frame, line in zip(frames, lines, strict=False):
        try:
            is_same = walk.restore(line, frame.path, frame.time, frame.name)
        except ValueError as error:
            raise InputError(f"{path}: found a damaged line ({type(error).__name__}); {WAYS}") from error
        if not is_same:
            break
        kept += len(line)
    file.cut(kept)
    if kept == 0:
        file.append(key)


def keep_spaced(results: Sequence[Result], metres: float) -> list[Result]:
    """Return the results that lie so far apart, and all that have no pose."""
    kept: list[Result] = []
    last = None
    for result in results:
        center = result.pose.center_world if result.pose else None
        if center is not None and last is not None and math.dist(center, last) < metres:
            continue
        last = last if center is None else center
        kept.append(result)
    return kept


def count_finished(
    arguments: argparse.Namespace, key: dict[str, Any], inputs: WalkInputs, rig: Calibration | None
) -> Counter[str] | None:
    """Return the results that an earlier run of this walk has left, by status; None if it is to be done.

    It is if there are none, one has failed, or frames were others. InputError for results of something else.
    """
    out = arguments.out
    if arguments.overwrite or out is None or is_stream(out) or not out.exists() or not out.stat().st_size:
        return None
    paths = {frame.name: frame.path for frame in inputs.frames}
    records = Records(out)
    records.read(lambda name: key, paths)
    names = [name for name in paths if name in records.names or not inputs.min_distance]
    left = list(records.remaining(names, lambda name: sha256_of(paths[name], rig)))
    return None if left or not records.is_in_order else records.counts
