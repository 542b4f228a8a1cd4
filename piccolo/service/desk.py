"""A scan that is open to questions: what a page shows of it, and the processes that answer.

Photos come as their content and leave nothing behind: a process writes one below a folder of its own for as
long as it is at work on it.
"""

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from ..batch.localizer import Answer, Localizer, Task
from ..errors import InputError
from ..files.atomic import temporary_folder
from ..jobs.processes import Function, Processes
from ..jobs.threads import Workers
from ..opened_scan import OpenedScan
from ..panorama.picture import picture_shape
from ..photo import Photo
from ..report import site
from ..report.build import WIDTH, document_of_scan
from ..report.pictures import make_pictures
from ..result import Result
from ..scan_map.scan_map import ScanMap
from ..scan_walk import Walk
from ..views.surfels import MAX_SURFELS, make_surfels
from ..walk.frames import Motion

PIXELS = 1e6  # in a megapixel


class Limits(NamedTuple):
    """Bounds of what a request may take."""

    max_bytes: int  # of its body
    max_pixels: float  # of a picture, by its header
    max_waiting: int  # requests at once; one more is sent away
    seconds: float  # from the moment that a process takes it


class Drawing(NamedTuple):
    """A photo whose pictures are wanted, for the page."""

    task: Task
    result: Result


class Frame(NamedTuple):
    """A frame of a walk."""

    photo: Photo  # at a path that lasts as long as the walk
    name: str
    time: float | None


class Desk(NamedTuple):
    """An open scan."""

    localizer: Localizer
    scan_map: ScanMap
    document: dict[str, Any]  # what the page knows of the scan
    plans: dict[str, bytes]  # PNG, by the name that the document has
    processes: Processes  # of `open_answering`
    files: object  # what `look_at` said of the scan's files


def open_desk(
    localizer: Localizer, num_jobs: int, limits: Limits, keeps_photos: bool, workers: Workers
) -> Desk:
    """Open a scan, with its local features, so that no photo waits for these; InputError if it can't be."""
    files = look_at(localizer.paths)
    opened = localizer.open_scan(workers)
    scan_map, _ = opened.require_default_method("the service", localizer.settings)
    scan_map.features_now(workers)
    with temporary_folder() as folder:
        site.begin_folder(folder)
        document = document_of_scan(scan_map, localizer.name, folder)
        drawn = [storey["plan"]["file"] for storey in document["storeys"] if storey["plan"]]
        plans = {name: (folder / name).read_bytes() for name in drawn}
    points = scan_map.points
    extent = [[float(axis.min()), float(axis.max())] for axis in (points.x, points.y, points.z)]
    about = {"scanSha256": scan_map.scan_sha256, "scans": list(scan_map.scan_names), "extent": extent}
    terms = {"maxBytes": limits.max_bytes, "keepsPhotos": keeps_photos}
    service = {"note": "", "photos": [], "service": terms}
    answering = partial(open_answering, localizer, limits.max_pixels)
    processes = Processes(answering, num_jobs, localizer.num_threads, limits.seconds)
    for _ in range(num_jobs):
        processes.submit(None)
    return Desk(localizer, scan_map, document | about | service, plans, processes, files)


def look_at(paths: Sequence[Path]) -> list[object]:
    """Return what changes when a file of a scan is replaced or written to."""
    found: list[object] = []
    for path in paths:
        try:
            status = path.stat()
            found.append((status.st_ino, status.st_size, status.st_mtime_ns))
        except OSError as error:
            found.append(error.errno)
    return found


def open_answering(localizer: Localizer, max_pixels: float) -> Function:
    """Open what a process answers with.

    A `Task` gets its `Answer`, a `Drawing` the JSON of its pictures; None makes ready for both.
    """
    scan = localizer.open_here()
    answer = localizer.answer_in(scan)

    @cache
    def surfels() -> Any:
        points = scan.prepared.points.subsample(MAX_SURFELS)
        return make_surfels(points, scan.workers), points

    def work(item: Task | Drawing | None) -> Answer | str | None:
        if isinstance(item, Drawing):
            return draw(scan, surfels(), item)
        if item is None:
            surfels()
            return None
        with item.place(Path()) as photo:
            check_size(photo.path, item.photo.name, max_pixels)
        return answer(item)

    return work


def check_size(path: Path, name: str, max_pixels: float) -> None:
    """Refuse a picture with more pixels than a service takes, before it is decoded."""
    width = height = 0
    with suppress(InputError):  # no picture: said by what reads it
        (width, height), _ = picture_shape(path)
    if width * height > max_pixels:
        found = f"found {width} x {height} px"
        raise InputError(f"{name}: {found}, wanted at most {max_pixels / PIXELS:g} megapixels")


def draw(scan: OpenedScan, surfels: Any, drawing: Drawing) -> str:
    """Return JSON of a photo's thumbnail and pictures."""
    result = drawing.result
    found = [result.best_pose, *(a.pose for a in result.alternatives)]
    poses = [scan.prepared.from_world(pose) for pose in found if pose]
    with drawing.task.place(Path()) as photo:
        thumbnail, pictures = make_pictures(photo.path, result, poses, surfels, WIDTH)
    return f'{{"thumb": "{site.data_url(thumbnail, "image/jpeg")}", "pictures": {pictures}}}'


def open_walk(localizer: Localizer, motion: Motion) -> Function:
    """Open what a process follows a walk with: a `Frame` gets its line, None the lines of all frames."""
    walk = Walk(localizer.open_here(), localizer.settings, motion)

    def follow(frame: Frame | None) -> str | list[str]:
        if frame is None:
            return [result.to_json() for result in walk.finish()]
        return walk.add(frame.photo, frame.time, frame.name).to_json()

    return follow


class WalkDesk:
    """A walk that is followed, frame by frame, in a process of its own."""

    def __init__(self, localizer: Localizer, motion: Motion, seconds: float) -> None:
        opening = partial(open_walk, localizer, motion)
        self.processes = Processes(opening, 1, localizer.num_threads, seconds, attempts=1)
        self._end = ExitStack()
        self._folder = self._end.enter_context(temporary_folder())
        self._count = 0
        self.used_s = monotonic()  # [s] when it was asked last

    def keep(self, task: Task, time: float | None) -> Frame:
        """Write a frame, which lasts as long as the walk."""
        self._count += 1
        name = task.photo.name
        path = self._folder / f"{self._count}{task.photo.path.suffix}"
        path.write_bytes((task.files or {})[name])
        return Frame(replace(task.photo, picture=path), name, time)

    def close(self) -> None:
        """End the process, and remove the frames."""
        self.processes.close()
        self._end.close()
