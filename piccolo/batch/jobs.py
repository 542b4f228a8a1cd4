"""Jobs of photos that help each other: a bundle, a colouring, the frames of a walk.

Results are written when all are known. Until then the steps of a job are kept beside them.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from ..api.result_files import read_results
from ..api.scan import Scan
from ..api.scan_bundle import AskedPosed, localize_posed
from ..api.scan_group import OF_RESULTS, AskedTogether, localize_photos_together
from ..api.scan_walk import Walk
from ..api.values import FAILED, UNREADABLE, CoarseToFineSettings, Pose, Result, Step, Trace
from ..photo.panorama.facts import sha256_of
from ..photo.photo import Photo
from ..poses.relative_poses import find_file_scale, read_relative_poses
from ..scan_map.scan_map import ScanMap
from ..system.errors import InputError
from ..system.files.atomic import STDOUT, is_stream, write_lines
from ..system.files.line_file import Journal, keeping_steps
from ..system.jobs.interruption import Interruption, interruptible
from ..system.jobs.processes import InFlight, Pair
from ..system.jobs.threads import Progress, Stopwatch
from ..together.coloring import painting
from .localizer import Localizer, rename
from .results_file import WAYS, Records

NUM_TRIED = 3  # first frames: a walk is refused if one reason prevents reading all of them and the last
WriteSteps = Callable[[str, Sequence[Step]], object]  # writes the steps of the search of a photo, by its name


class Job(NamedTuple):
    """Photos to be localized together."""

    what: str  # the kind of photos, in words for messages
    photos: Mapping[str, Photo]  # the photos by their names in the results
    fields: Callable[[Path], Mapping[str, Any]]  # fields of a photo's line that say how it was made
    run: Callable[[Journal], list[Result] | Interruption]
    output: Path | None = None  # further file that is written beside the results


class Done(NamedTuple):
    """The results of a job."""

    results: list[Result]
    seconds: float | None  # time that the job took; None if an earlier run had done all


def run_job(job: Job, out: Path | None, is_new: bool) -> Done | Interruption:
    """Do the steps of a job that no earlier run has done, and write the results, unless a signal ends it.

    The file of steps is deleted, unless a photo is to be tried again.
    """
    path = steps_file(out)
    if path and out and not is_new and is_finished(out, job):
        results = read_results([out])
        if job.output is None or job.output.exists():
            return Done(results, None)
        return Done(results, 0.0)
    watch = Stopwatch()
    digest = sha256(json.dumps([job.fields(Path(name)) for name in job.photos]).encode()).hexdigest()
    key = {"photos": job.what, "sha256": digest}
    with watch.stage("all"), keeping_steps(path, key, WAYS, is_new) as journal:
        found = job.run(journal)
    if isinstance(found, Interruption):
        return found
    write_lines(out or STDOUT, [result.to_json() for result in found])
    if path and not any(result.status == FAILED for result in found):
        path.unlink(missing_ok=True)
    return Done(found, watch.seconds["all"])


def steps_file(out: Path | None) -> Path | None:
    """Return the file that keeps the steps of a job until all results are written; None for a stream."""
    return None if out is None or is_stream(out) else out.with_name(f"{out.name}.steps")


def is_finished(out: Path, job: Job) -> bool:
    """Return True if an earlier run has left all results of a job, of unchanged photos that did not fail.

    Raises InputError if the file has results of another job.
    """
    records = Records(out)
    records.read(job.fields, job.photos)
    paths = {name: (Path(str(photo.picture)), photo.instant) for name, photo in job.photos.items()}
    return not list(records.remaining(paths, lambda name: sha256_of(*paths[name]))) and records.is_in_order


def make_bundle_job(
    localizer: Localizer, scan: Scan, photos: Sequence[Path], relative: Path, write_steps: WriteSteps
) -> Job:
    """Return the job of localizing photos as one camera, by a file of relative poses; it has no steps."""
    poses = read_relative_poses(relative, photos)
    more = {"relative_sha256": sha256_of(relative, None)}
    asked = [localizer.ask(path) for path in photos]
    traces = [Trace(localizer.is_traced) for _ in photos]

    def run(_journal: Journal) -> list[Result]:
        scan_map, _ = scan.require_default_method("`relative_poses`", scan.settings)
        posed = [
            AskedPosed(photo, pose, settings, trace)
            for (photo, settings), pose, trace in zip(asked, poses, traces, strict=True)
            if pose is not None and isinstance(settings, CoarseToFineSettings)
        ]
        found = iter(localize_posed(scan_map, scan.reader, scan.workers, posed, find_file_scale(relative)))
        answer = localizer.answer_in(scan)
        results = []
        for path, pose, trace in zip(photos, poses, traces, strict=True):
            if pose is None:  # structure from motion did not register the photo
                alone = answer(localizer.task(path))
                trace.steps.extend(alone.steps)
            results.append(alone.result if pose is None else next(found))
            write_steps(str(path), trace.steps)
        return [replace(result, settings={**result.settings, **more}) for result in results]

    fields = localizer.expect(scan.prepared.scan_sha256, more)
    return Job("photos together", {photo.name: photo for photo, _ in asked}, fields, run)


def make_group_job(
    localizer: Localizer, scan: Scan, photos: Sequence[tuple[str, Path]], write_steps: WriteSteps
) -> Job:
    """Return the job of localizing photos of one place together, by names and paths; it has no steps."""
    asked = [localizer.ask(Path(name)) for name, _ in photos]
    asked = [(replace(one, picture=path), more) for (one, more), (_, path) in zip(asked, photos, strict=True)]
    names = {str(path): name for name, path in photos}
    traces = [Trace(localizer.is_traced) for _ in photos]

    def run(_journal: Journal) -> list[Result]:
        scan_map, _ = scan.require_default_method("photos together", scan.settings)
        together = [
            AskedTogether(photo, settings, trace)
            for (photo, settings), trace in zip(asked, traces, strict=True)
            if isinstance(settings, CoarseToFineSettings)
        ]
        found = localize_photos_together(scan_map, scan.reader, scan.workers, together)
        results = [rename(result, names) for result in found]
        for result, trace in zip(results, traces, strict=True):
            write_steps(result.pano, trace.steps)
        return results

    fields = localizer.expect(scan.prepared.scan_sha256, OF_RESULTS)
    return Job("photos together", {names[photo.name]: photo for photo, _ in asked}, fields, run)


def make_coloring_job(
    localizer: Localizer, scan: Scan, photos: Sequence[Path], out: Path, write_steps: WriteSteps
) -> Job:
    """Return the job of localizing photos in the colours of the others, and of colouring `out` by them."""
    scan_map, _ = scan.require_default_method("colours", scan.settings)
    painting.check_point_files(localizer.paths)
    given = {str(path): localizer.ask(path)[0] for path in photos}

    def localize(shown: ScanMap, k: int) -> Result:
        answer = localizer.answer_in(replace(scan, prepared=shown))(localizer.task(photos[k]))
        write_steps(str(photos[k]), answer.steps)
        settings = {**answer.result.settings, **painting.OF_RESULTS}
        return replace(answer.result, settings=settings)

    def run(journal: Journal) -> list[Result]:
        steps = (f"shape: {path} {sha256_of(path, localizer.photo.instant)}" for path in photos)
        return painting.localize_for_colors(scan_map, steps, localize, len(photos), scan.workers, journal)

    return Job("photos", given, localizer.expect(scan_map.scan_sha256, painting.OF_RESULTS), run, out)


class WalkInput(NamedTuple):
    """A frame of a walk."""

    photo: Photo
    time: float  # [s] since the first frame; the frame's number if frames have no times
    name: str  # in the results
    odometry: Pose | None = None

    def step(self, digest: str | None) -> str:
        """Return the name in the journal of the step that tracks this frame, with the digest of its file."""
        return f"{self.name} {self.time} {digest}"


class Watching(NamedTuple):
    """Functions that are called while a walk is followed, to show its progress."""

    show_frames: Callable[[Iterable[Pair]], Iterable[Pair]]  # wraps the frames that are left
    tell: Callable[[str], object]  # called with the reason if a frame can't be read
    show: Progress  # of the second look, after all frames
    write_steps: WriteSteps


def make_walk_job(frames: Sequence[WalkInput], walk: Walk, is_traced: bool, watching: Watching) -> Job:
    """Return the job of localizing the frames of a walk."""
    fields = walk.key_of(frames[0].photo)
    walk.tracker.means = walk.tracker.means._replace(trace=Trace(is_traced))

    def run(journal: Journal) -> list[Result] | Interruption:
        interruption = follow_frames(walk, frames, journal, watching)
        return interruption if interruption.number else walk.finish(watching.show)

    return Job("frames", {frame.name: frame.photo for frame in frames}, lambda _: fields, run)


def follow_frames(
    walk: Walk, frames: Sequence[WalkInput], journal: Journal, watching: Watching
) -> Interruption:
    """Localize the frames in order, and keep each in the journal; tell why one can't be read."""
    steps = (frame.step(sha256_of(frame.photo.path, frame.photo.instant)) for frame in frames)
    journal.recall(steps, lambda k, text: walk.restore(text, frames[k].photo))
    left = iter(frames[len(walk.blanks) :])
    searched = walk.tracker.means.trace.steps
    with ThreadPoolExecutor(1) as pool, interruptible() as interruption:
        # each frame is prepared while the one before it is localized
        prepared = InFlight(lambda frame: pool.submit(walk.prepare, frame.photo, frame.name), left, 2)
        pairs = watching.show_frames(prepared)
        for frame, wait in interruption.each(pairs) if journal.is_kept else pairs:
            result = walk.follow(wait(), frame.time, frame.odometry)
            watching.write_steps(frame.name, searched)
            searched.clear()
            if result.status == UNREADABLE and frame is frames[0]:
                check_others(walk, frames, str(result.error))
            if result.error is not None:
                watching.tell(result.error)
            if result.status != FAILED:
                journal.append(frame.step(result.source.pano_sha256), walk.last_to_json())
        pool.shutdown(cancel_futures=True)
    return interruption


def check_others(walk: Walk, frames: Sequence[WalkInput], error: str) -> None:
    """Refuse a walk whose first frames, and the last, can't be read for the same reason."""
    others = [*frames[1:NUM_TRIED], frames[-1]]
    found = (str(walk.prepare(other.photo, other.name).blank.error) for other in others)
    is_same = (text.replace(o.name, frames[0].name) == error for text, o in zip(found, others, strict=True))
    if len(frames) > NUM_TRIED and all(is_same):
        raise InputError(f"{error}; the other {len(frames) - 1} frames seem no better")
