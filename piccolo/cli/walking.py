"""localize.py --walk and --video: frames of one walk, each of which narrows the others."""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..batch.frame_times import times_of
from ..batch.inputs import is_from_stdin
from ..batch.relative_poses import read_odometry
from ..errors import InputError
from ..files.atomic import temporary_folder
from ..files.line_file import Journal
from ..geometry.pose import Pose
from ..jobs.processes import InFlight
from ..panorama.photo import sha256_of
from ..panorama.video import frames_of
from ..photo import Photo
from ..result import FAILED, UNREADABLE, Result
from ..scan_walk import Walk
from ..walk.motion import Motion
from .command import check_alone, check_only_with, print_warnings
from .errors import EXIT_BAD_INPUT, UsageError, print_error
from .executing import Interruption, interruptible
from .options import DEFAULT_EVERY
from .progress import progress_bar, show_progress
from .together import Job, Report

ONLY_WITH = ("times", "max_speed", "odometry")
NOT_WITH = ("jobs", "dask", "overlay", "occlusion_mask", "priors", "refine_focal")
NUM_TRIED = 3  # frames that can't be read for one reason, and the last: then none can


class WalkInput(NamedTuple):
    """A frame of a walk."""

    photo: Photo
    time: float  # [s] since the first; of frames without times their number
    name: str  # in the results
    odometry: Pose | None = None

    def step(self, digest: str | None) -> str:
        """Return the name of the step that follows it, if its file has a digest."""
        return f"{self.name} {self.time} {digest}"


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


def make_walk_job(arguments: argparse.Namespace, frames: Sequence[WalkInput], walk: Walk) -> Job:
    """Return the job of localizing the frames of a walk."""
    if arguments.odometry:
        walk.more_settings["odometry_sha256"] = sha256_of(arguments.odometry, None)
    fields = walk.key_of(frames[0].photo)

    def run(journal: Journal) -> list[Result] | Interruption:
        interruption = follow_all(arguments, walk, frames, journal)
        return interruption if interruption.number else walk.finish(progress_bar(arguments.quiet))

    def report(results: Sequence[Result]) -> Report:
        warnings = {w for r in results for w in r.warnings if w.startswith("`odometry`")}
        print_warnings(arguments, warnings)
        gaps = sum(result.walk is not None and result.walk.gap is not None for result in results)
        return Report(f"; {gaps} gaps")

    photos = {frame.name: frame.photo for frame in frames}
    return Job("frames", photos, lambda _: fields, run, report)


def follow_all(
    arguments: argparse.Namespace, walk: Walk, frames: Sequence[WalkInput], journal: Journal
) -> Interruption:
    """Follow the frames, and keep what was found of each; say why one can't be read."""
    steps = (frame.step(sha256_of(frame.photo.path, frame.photo.instant)) for frame in frames)
    journal.recall(steps, lambda k, text: walk.restore(text, frames[k].photo))
    bar = {"desc": "frames", "total": len(frames), "initial": len(walk.blanks), "unit": ""}
    left = iter(frames[len(walk.blanks) :])
    with ThreadPoolExecutor(1) as pool, interruptible() as interruption:
        # each is prepared while the one before it is followed
        prepared = InFlight(lambda frame: pool.submit(walk.prepare, frame.photo, frame.name), left, 2)
        pairs = show_progress(prepared, arguments.quiet, **bar)
        for frame, wait in interruption.each(pairs) if journal.is_kept else pairs:
            result = walk.follow(wait(), frame.time, frame.odometry)
            if result.status == UNREADABLE and frame is frames[0]:
                check_others(walk, frames, str(result.error))
            if result.error is not None:
                print_error(arguments, result.error, EXIT_BAD_INPUT)
            if result.status != FAILED:
                journal.append(frame.step(result.source.pano_sha256), walk.last_to_json())
        pool.shutdown(cancel_futures=True)
    return interruption


def check_others(walk: Walk, frames: Sequence[WalkInput], error: str) -> None:
    """Refuse a walk whose first frames, and the last, can't be read for one reason."""
    others = [*frames[1:NUM_TRIED], frames[-1]]
    found = (str(walk.prepare(other.photo, other.name).blank.error) for other in others)
    is_same = (text.replace(o.name, frames[0].name) == error for text, o in zip(found, others, strict=True))
    if len(frames) > NUM_TRIED and all(is_same):
        raise InputError(f"{error}; the other {len(frames) - 1} frames seem no better")
