"""localize.py with photos that help each other: a bundle, a colouring or a walk.

Results are written when all are known. Until then the steps of the job are kept beside them.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from ..batch.inputs import is_from_stdin, times_of
from ..batch.localizer import Localizer
from ..batch.relative_poses import find_scale, read_odometry, read_relative_poses
from ..batch.results_file import WAYS, Records
from ..coloring import color_scan
from ..errors import InputError
from ..files.atomic import STDOUT, is_stream, temporary_folder, write_lines
from ..files.line_file import Journal, keeping_steps
from ..geometry.pose import Pose
from ..jobs.processes import InFlight
from ..jobs.threads import Stopwatch
from ..judge.probability import LOCALIZED
from ..judge.result import FAILED, UNREADABLE, Result
from ..panorama.photo import sha256_of
from ..panorama.video import frames_of_chapters
from ..photo import Photo
from ..result_files import read_results
from ..scan import Scan
from ..scan_map.scan_map import ScanMap
from ..scan_walk import Walk
from ..together.walk.frames import Motion
from . import terminal
from .command import Arguments, UsageError
from .execution import EXIT_SOME_NOT, Interruption, choose_exit_code, interruptible, print_result
from .options import DEFAULT_EVERY

OF_LOOP = ("jobs", "dask", "overlay", "occlusion_mask", "trace")  # options of photos that come one by one
NOT_WITH = {  # options that do not go with what is asked for
    "a video": ("times",),
    "a walk": (*OF_LOOP, "priors", "refine_focal"),
    "--relative": ("walk", "video", *OF_LOOP, "priors", "refine_focal"),
    "--color-scan": ("walk", "video", "relative", *OF_LOOP, "labels"),
}
ONLY_WITH_WALKS = ("times", "max_speed", "odometry")
LEAST_LOST = 0.25  # chosen: of the frames, that may be those of a time lapse
FASTER = 2.0  # chosen: than between two frames
NUM_TRIED = 3  # frames that can't be read for one reason, and the last: then none can


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
    asked = {"a video": a.video, "a walk": a.walk or a.video, "--relative": a.relative}
    asked["--color-scan"] = a.color_scan
    for what in (what for what, is_asked in asked.items() if is_asked):
        a.refuse_given(NOT_WITH[what], f"not with {what}")
    if (a.walk or a.color_scan) and is_from_stdin(a.pano):
        option = "--walk" if a.walk else "--color-scan"
        raise UsageError(f"{option}: found names on stdin, wanted files or folders")
    if a.color_scan:
        color_scan.check_suffix(a.color_scan)
    Motion(max_speed=a.max_speed)  # refuses a wrong one


class Job(NamedTuple):
    """Photos to be localized together."""

    what: str  # the photos, in words
    photos: Mapping[str, Photo]  # by their names in the results
    fields: Callable[[Path], Mapping[str, Any]]  # of a photo's line, that say how it was made
    run: Callable[[Journal], list[Result] | Interruption]
    # writes what else was asked for; returns words on all results, and whether it could be written
    report: Callable[[Sequence[Result]], tuple[str, bool]]
    output: Path | None = None  # that is written beside the results


def run_together(arguments: Arguments, job: Job) -> int:
    """Do a job, or what an earlier run has left of it; write and print the results, return the exit code."""
    out = arguments.out
    path = steps_file(out)
    watch = Stopwatch()
    if path and not arguments.overwrite and is_finished(out, job):
        results = read_results([out])
        if job.output is None or job.output.exists():
            arguments.note(f"{out}: nothing is left to do")
            return choose_exit_code({result.status for result in results})
    else:
        digest = sha256(json.dumps([job.fields(Path(name)) for name in job.photos]).encode()).hexdigest()
        key = {"photos": job.what, "sha256": digest}
        with watch.stage("all"), keeping_steps(path, key, WAYS, arguments.overwrite) as journal:
            found = job.run(journal)
        if isinstance(found, Interruption):
            return found.stop(arguments, f"some of {len(job.photos)} {job.what}", path is not None)
        results = found
        write_lines(out or STDOUT, [result.to_json() for result in results])
        if path and not any(result.status == FAILED for result in results):
            path.unlink(missing_ok=True)
    more, is_whole = job.report(results)
    counts = Counter(result.status for result in results)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    note = f"{len(results)} {job.what} in {watch.seconds.get('all', 0.0):.0f} s: {words}{more}"
    code = choose_exit_code(counts)
    if not is_whole:
        return arguments.error(note, code or EXIT_SOME_NOT)
    arguments.note(note)
    return code


def steps_file(out: Path | None) -> Path | None:
    """Return where the steps of a job are kept until its results are whole; None for a stream."""
    return None if out is None or is_stream(out) else out.with_name(f"{out.name}.steps")


def is_finished(out: Path, job: Job) -> bool:
    """Return True if an earlier run of a job has left all results, none of a photo that failed or is another.

    Raises InputError for results of something else.
    """
    records = Records(out)
    records.read(job.fields, job.photos)
    paths = {name: (Path(str(photo.picture)), photo.instant) for name, photo in job.photos.items()}
    return not list(records.remaining(paths, lambda name: sha256_of(*paths[name]))) and records.is_in_order


def make_bundle_job(arguments: Arguments, photos: Sequence[Path], localizer: Localizer, scan: Scan) -> Job:
    """Return the job of localizing photos as one camera, by --relative; a stopped one begins again."""
    poses = read_relative_poses(arguments.relative, photos)
    more = {"relative_sha256": sha256_of(arguments.relative, None)}
    asked = [localizer.ask(path)[0] for path in photos]
    posed = [(photo, pose) for photo, pose in zip(asked, poses, strict=True) if pose is not None]

    def run(_journal: Journal) -> list[Result]:
        scale = find_scale(arguments.relative)
        of_all = [pose for _, pose in posed]
        given = [photo for photo, _ in posed]
        found = iter(scan.localize_bundle(given, of_all, relative_scale=scale))
        answer = localizer.answer_in(scan)
        pairs = zip(photos, poses, strict=True)
        # a photo that structure from motion did not register is localized alone
        results = [next(found) if pose else answer(localizer.task(path)).result for path, pose in pairs]
        return [replace(result, settings={**result.settings, **more}) for result in results]

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        for result in results:
            print_result(arguments, result, result.warnings[len(scan.warnings) :])
        return "", True

    fields = localizer.expect(scan.prepared.scan_sha256, more)
    return Job("photos together", {photo.name: photo for photo in asked}, fields, run, report)


def make_coloring_job(arguments: Arguments, photos: Sequence[Path], localizer: Localizer, scan: Scan) -> Job:
    """Return the job of localizing photos in the colours of the others, and of colouring the scan by them.

    If too few are localized to colour the scan, the results alone are written.
    """
    scan_map = scan.prepared
    assert isinstance(scan_map, ScanMap)
    given = {str(path): localizer.ask(path)[0] for path in photos}

    def localize(shown: ScanMap, k: int) -> Result:
        result = localizer.answer_in(replace(scan, prepared=shown))(localizer.task(photos[k])).result
        return replace(result, settings={**result.settings, **color_scan.OF_RESULTS})

    def run(journal: Journal) -> list[Result]:
        steps = (f"shape: {path} {sha256_of(path, localizer.photo.instant)}" for path in photos)
        return color_scan.localize_for_colors(scan_map, steps, localize, len(photos), scan.workers, journal)

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        of_scan = {*scan.warnings, color_scan.PAINTED}
        for result in results:
            own = [warning for warning in result.warnings if warning not in of_scan]
            print_result(arguments, result, own)
        least = color_scan.LEAST_PHOTOS
        if sum(result.status == LOCALIZED for result in results) < least:
            return f"; {arguments.color_scan} is not written: wanted {least} localized photos or more", False
        colored = color_scan.write_colored_scan(
            localizer.paths, scan_map, scan.cloud_settings, results, arguments.color_scan, scan.workers
        )
        part = 100.0 * colored.num_colored / max(colored.num_points, 1)
        return f"; {part:.0f} % of the points coloured", True

    fields = localizer.expect(scan_map.scan_sha256, color_scan.OF_RESULTS)
    return Job("photos", given, fields, run, report, arguments.color_scan)


class WalkInput(NamedTuple):
    """A frame of a walk."""

    photo: Photo
    time: float  # [s] since the first; of frames without times their number
    name: str  # in the results
    odometry: Pose | None = None

    def step(self, digest: str | None) -> str:
        """Return the name of the step that follows it, if its file has a digest."""
        return f"{self.name} {self.time} {digest}"


@contextmanager
def walk_frames(
    arguments: Arguments, photo: Photo, panoramas: Sequence[Path]
) -> Iterator[tuple[list[WalkInput], Motion]]:
    """Yield the frames of a walk, those of a video as files until the end, and how the camera was carried."""
    with temporary_folder() if arguments.video else nullcontext(Path()) as folder:
        times = None
        if arguments.video:
            taken = frames_of_chapters(arguments.video, arguments.every or DEFAULT_EVERY, folder)
            bar = {"desc": "read the video", "unit": " frames", "leave": False}
            shots = terminal.show_progress(taken, arguments.quiet, **bar)
            found = ((f.path, time, f"{video}#t={f.time:.3f}") for video, f, time in shots)
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


def make_walk_job(arguments: Arguments, frames: Sequence[WalkInput], scan: Scan, walk: Walk) -> Job:
    """Return the job of localizing the frames of a walk."""
    if arguments.odometry:
        walk.more_settings["odometry_sha256"] = sha256_of(arguments.odometry, None)
    fields = walk.key_of(frames[0].photo)

    def run(journal: Journal) -> list[Result] | Interruption:
        interruption = follow_all(arguments, walk, frames, journal)
        return interruption if interruption.number else walk.finish(arguments.progress())

    def report(results: Sequence[Result]) -> tuple[str, bool]:
        arguments.warn({w for r in results for w in r.warnings if w.startswith("`odometry`")})
        if arguments.video and not (arguments.max_speed or arguments.quiet):
            arguments.warn(suggest_speed(scan, walk, results))
        gaps = sum(result.walk is not None and result.walk.gap is not None for result in results)
        return f"; {gaps} gaps", True

    return Job("frames", {frame.name: frame.photo for frame in frames}, lambda _: fields, run, report)


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


def follow_all(
    arguments: Arguments, walk: Walk, frames: Sequence[WalkInput], journal: Journal
) -> Interruption:
    """Follow the frames, and keep what was found of each; say why one can't be read."""
    steps = (frame.step(sha256_of(frame.photo.path, frame.photo.instant)) for frame in frames)
    journal.recall(steps, lambda k, text: walk.restore(text, frames[k].photo))
    bar = {"desc": "frames", "total": len(frames), "initial": len(walk.blanks), "unit": ""}
    left = iter(frames[len(walk.blanks) :])
    with ThreadPoolExecutor(1) as pool, interruptible() as interruption:
        # each is prepared while the one before it is followed
        prepared = InFlight(lambda frame: pool.submit(walk.prepare, frame.photo, frame.name), left, 2)
        pairs = terminal.show_progress(prepared, arguments.quiet, **bar)
        for frame, wait in interruption.each(pairs) if journal.is_kept else pairs:
            result = walk.follow(wait(), frame.time, frame.odometry)
            if result.status == UNREADABLE and frame is frames[0]:
                check_others(walk, frames, str(result.error))
            if result.error is not None:
                arguments.error(result.error)
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
