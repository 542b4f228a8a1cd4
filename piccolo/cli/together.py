"""localize.py with photos that help each other: its options, what it prints, and what it writes beside."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..api import scan_coloring
from ..api.scan import Scan
from ..api.scan_walk import Walk
from ..api.values import MOST_IN_SERIES, Motion, Result
from ..batch.inputs import is_from_stdin
from ..batch.jobs import (
    Job,
    WalkInput,
    Watching,
    WriteSteps,
    make_bundle_job,
    make_coloring_job,
    make_group_job,
    make_walk_job,
    run_job,
    steps_file,
)
from ..batch.localizer import Localizer
from ..photo.panorama.facts import sha256_of
from ..photo.panorama.video import choose_distinct, frames_of_chapters
from ..photo.photo import Photo
from ..poses.relative_poses import read_odometry
from ..poses.times import times_of
from ..system.files.atomic import temporary_folder
from ..system.jobs.interruption import Interruption
from ..system.jobs.processes import Pair
from . import terminal
from .command import Arguments, UsageError
from .execution import EXIT_SOME_NOT, choose_exit_code, print_result, stop
from .options import DEFAULT_EVERY

KNOWN = "their camera must be known: refine it with a single photo"
IN_TURN = "its frames come one after another"
AS_ONE = "its photos are weighed as one camera, in one process"
IN_GROUPS = "which photos belong together is decided in one process"
NO_WALK = "its photos are in no order, so no way between them is followed"
IN_ROUNDS = "a photo needs the colours of all others"
OTHER = "photos are localized together in one way"
NOT_WITH: Mapping[str, Mapping[str, str]] = {  # options that do not go with what is asked for, and why
    "a video": {"times": "it has times"},
    "a walk": {
        "jobs": IN_TURN,
        "dask": IN_TURN,
        "priors": "where a frame is follows from the others: give what holds for all, as --near",
        "refine_focal": KNOWN,
    },
    "--relative": {"walk": OTHER, "video": OTHER, "jobs": AS_ONE, "dask": AS_ONE, "refine_focal": KNOWN},
    "--together": {
        "walk": OTHER,
        "relative": OTHER,
        "max_speed": NO_WALK,
        "odometry": NO_WALK,
        "jobs": IN_GROUPS,
        "dask": IN_GROUPS,
    },
    "--color-scan": {
        "walk": OTHER,
        "video": OTHER,
        "relative": OTHER,
        "together": OTHER,
        "jobs": IN_ROUNDS,
        "dask": IN_ROUNDS,
    },
}
ONLY_WITH_WALKS = ("times", "max_speed", "odometry")
LEAST_LOST = 0.25  # chosen: of the frames, that may be those of a time lapse
FASTER = 2.0  # chosen: than between two frames


def check_joint_options(arguments: Arguments) -> None:
    """Refuse options that do not go with photos that help each other, or with each other."""
    a = arguments
    if not a.video:
        a.refuse_given(("every",), "only with --video")
    if not (a.walk or a.video):
        if not a.pano:
            raise UsageError("the following arguments are required: --pano")
        a.refuse_given(ONLY_WITH_WALKS, "only with --walk or --video")
    elif bool(a.video) == bool(a.pano):
        raise UsageError("--walk, --video: wanted --walk with --pano, or --video alone")
    refuse_others(a)
    if (a.walk or a.together or a.color_scan) and is_from_stdin(a.pano):
        option = "--walk" if a.walk else "--together" if a.together else "--color-scan"
        raise UsageError(f"{option}: found names on stdin, wanted files or folders")
    if a.color_scan:
        scan_coloring.check_colored_suffix(a.color_scan)
    Motion(max_speed=a.max_speed)  # refuses a wrong one


def is_walk(arguments: Arguments) -> bool:
    """Return True if frames are to be followed one after another."""
    return arguments.walk or bool(arguments.video and not arguments.together)


def refuse_others(arguments: Arguments) -> None:
    """Refuse options that do not go with what is asked for, and say why."""
    a = arguments
    asked = {"a video": a.video, "a walk": is_walk(a), "--relative": a.relative}
    asked |= {"--together": a.together, "--color-scan": a.color_scan}
    for what in (what for what, is_asked in asked.items() if is_asked):
        for name, why in NOT_WITH[what].items():
            a.refuse_given((name,), f"not with {what}: {why}")


class Printed(NamedTuple):
    """A job, and what is said and written when it is done."""

    job: Job
    # prints and writes what else was asked for; returns words on all results, and whether it could be written
    report: Callable[[Sequence[Result]], tuple[str, bool]]


def run_together(
    arguments: Arguments,
    asked: Printed,
    write_pictures: Callable[[Photo, Result], object],
) -> int:
    """Do a job, or what an earlier run has left of it; print the results, return the exit code."""
    job = asked.job
    done = run_job(job, arguments.out, arguments.overwrite)
    if isinstance(done, Interruption):
        is_kept = steps_file(arguments.out) is not None
        return stop(done, arguments, f"some of {len(job.photos)} {job.what}", is_kept)
    results = done.results
    if done.seconds is None:
        arguments.note(f"{arguments.out}: nothing is left to do")
        return choose_exit_code({result.status for result in results})
    for result in results:
        write_pictures(job.photos[result.pano], result)
    more, is_whole = asked.report(results)
    counts = Counter(result.status for result in results)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    note = f"{len(results)} {job.what} in {done.seconds:.0f} s: {words}{more}"
    code = choose_exit_code(counts)
    if not is_whole:
        return arguments.error(note, code or EXIT_SOME_NOT)
    arguments.note(note)
    return code


def print_each(arguments: Arguments, scan: Scan, results: Sequence[Result]) -> None:
    """Print results with their own warnings, without those of the scan."""
    for result in results:
        print_result(arguments, result, result.warnings[len(scan.warnings) :])


def ask_for_bundle(
    arguments: Arguments, photos: Sequence[Path], localizer: Localizer, scan: Scan, write_steps: WriteSteps
) -> Printed:
    """Return the job of --relative."""

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        print_each(arguments, scan, results)
        return "", True

    return Printed(make_bundle_job(localizer, scan, photos, arguments.relative, write_steps), report)


def ask_for_group(
    arguments: Arguments, photos: Sequence[Path], localizer: Localizer, scan: Scan, write_steps: WriteSteps
) -> Printed:
    """Return the job of --together for photos."""
    return ask_together(arguments, [(str(path), path) for path in photos], localizer, scan, write_steps)


def ask_together(
    arguments: Arguments,
    photos: Sequence[tuple[str, Path]],
    localizer: Localizer,
    scan: Scan,
    write_steps: WriteSteps,
) -> Printed:
    """Return the job of --together for photos by their names, or the frames of a video."""

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        print_each(arguments, scan, results)
        num_together = sum(result.beside is not None for result in results)
        return f"; {num_together} of them by others too", True

    return Printed(make_group_job(localizer, scan, photos, write_steps), report)


def ask_for_coloring(
    arguments: Arguments, photos: Sequence[Path], localizer: Localizer, scan: Scan, write_steps: WriteSteps
) -> Printed:
    """Return the job of --color-scan; if too few are localized to colour by, it writes results alone."""
    out = arguments.color_scan

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        of_scan = {*scan.warnings, scan_coloring.PAINTED}
        for result in results:
            print_result(arguments, result, [w for w in result.warnings if w not in of_scan])
        scan_map, _ = scan.require_default_method("colours", scan.settings)
        colored = scan_coloring.color_if_enough(
            localizer.paths, scan_map, scan.cloud_settings, list(results), out, scan.workers
        )
        if not colored.num_points:
            least = scan_coloring.LEAST_COLORING_PHOTOS
            return f"; {out} is not written: wanted {least} localized photos or more", False
        part = 100.0 * colored.num_colored / colored.num_points
        return f"; {part:.0f} % of the points coloured", True

    return Printed(make_coloring_job(localizer, scan, photos, out, write_steps), report)


JOBS: Mapping[str, Callable[..., Printed]] = {  # by the option that asks for it
    "relative": ask_for_bundle,
    "together": ask_for_group,
    "color_scan": ask_for_coloring,
}


def choose_job(arguments: Arguments) -> Callable[..., Printed]:
    """Return the function that makes the job that is asked for, of photos that are no frames."""
    return next(ask for option, ask in JOBS.items() if getattr(arguments, option))


def read_video(arguments: Arguments, folder: Path) -> Iterator[tuple[Path, float, str]]:
    """Yield the frames of a video as files in a folder, with their times and names."""
    taken = frames_of_chapters(arguments.video, arguments.every or DEFAULT_EVERY, folder)
    bar = {"desc": "read the video", "unit": " frames", "leave": False}
    for video, frame, time in terminal.show_progress(taken, arguments.quiet, **bar):
        yield frame.path, time, f"{video}#t={frame.time:.3f}"


@contextmanager
def distinct_frames(arguments: Arguments) -> Iterator[list[tuple[str, Path]]]:
    """Yield names and files of the frames of a video, of many those that differ most, until the end."""
    with temporary_folder() as folder:
        frames = [(name, path) for path, _, name in read_video(arguments, folder)]
        chosen = choose_distinct([path for _, path in frames], MOST_IN_SERIES)
        if len(chosen) < len(frames):
            arguments.note(f"took {len(chosen)} of {len(frames)} frames, between which the picture changes")
        yield [frames[k] for k in chosen]


@contextmanager
def walk_frames(
    arguments: Arguments, photo: Photo, panoramas: Sequence[Path]
) -> Iterator[tuple[list[WalkInput], Motion]]:
    """Yield the frames of a walk, those of a video as files until the end, and how the camera was carried."""
    with temporary_folder() if arguments.video else nullcontext(Path()) as folder:
        times = None
        found: Iterable[tuple[Path, float, str]]
        if arguments.video:
            found = read_video(arguments, folder)
        else:
            times = times_of(panoramas, arguments.times)
            clock = times or [float(k) for k in range(len(panoramas))]
            found = ((p, t - clock[0], str(p)) for p, t in zip(panoramas, clock, strict=True))
        frames = [WalkInput(replace(photo, picture=path), time, name) for path, time, name in found]
        if arguments.odometry:
            paths = [frame.photo.path for frame in frames]
            when = times or [frame.time for frame in frames]
            poses = read_odometry(arguments.odometry, paths, when, has_clock=times is not None)
            frames = [f._replace(odometry=pose) for f, pose in zip(frames, poses, strict=True)]
        is_timed = times is not None or arguments.video is not None
        yield frames, Motion(max_speed=arguments.max_speed, is_timed=is_timed)


def ask_for_walk(
    arguments: Arguments, frames: Sequence[WalkInput], scan: Scan, motion: Motion, write_steps: WriteSteps
) -> Printed:
    """Return the job of --walk or --video."""
    walk = scan.track(motion=motion)
    if arguments.odometry:
        walk.more_settings["odometry_sha256"] = sha256_of(arguments.odometry, None)

    def show_frames(left: Iterable[Pair]) -> Iterable[Pair]:
        bar = {"desc": "frames", "total": len(frames), "initial": len(walk.blanks), "unit": ""}
        return terminal.show_progress(left, arguments.quiet, **bar)

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        arguments.warn({w for r in results for w in r.warnings if w.startswith("`odometry`")})
        if arguments.video and not (arguments.max_speed or arguments.quiet):
            arguments.warn(suggest_speed(scan, walk, results))
        gaps = sum(result.walk is not None and result.walk.gap is not None for result in results)
        return f"; {gaps} gaps", True

    watching = Watching(show_frames, arguments.error, arguments.progress(), write_steps)
    return Printed(make_walk_job(frames, walk, arguments.trace is not None, watching), report)


def suggest_speed(scan: Scan, walk: Walk, results: Sequence[Result]) -> list[str]:
    """Return a warning if many frames were not found, and one of them is, alone, but beyond reach."""
    lost = [k for k, r in enumerate(results) if r.pose is None and r.error is None and not is_tracked(r)]
    sure = [(r.walk.time, r.pose) for r in results if r.walk and r.pose]
    if not sure or len(lost) < LEAST_LOST * len(results):
        return []
    k = lost[len(lost) // 2]
    own = results[k].walk
    pose = scan.localize(walk.photos[k]).pose
    if own is None or pose is None:
        return []
    time, other = min(sure, key=lambda at: abs(at[0] - own.time))
    seconds = abs(own.time - time)
    distance = pose.distance(other)
    if distance < walk.tracker.motion.reach(seconds):
        return []
    found = f"{results[k].pano}: alone it is localized {distance:.1f} m from the walk {seconds:.1f} s away"
    speed = math.ceil(FASTER * distance / seconds)
    return [f"{found}; if this is a time lapse, add --max-speed {speed}"]


def is_tracked(result: Result) -> bool:
    """Return True if the motion from another frame is known."""
    return result.walk is not None and result.walk.how == "tracked"
