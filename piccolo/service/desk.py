"""A scan that is open to questions: what a page shows of it, and the processes that answer.

Photos come as their content and leave nothing behind: a process writes one below a folder of its own for as
long as it is at work on it.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from ..batch.localizer import Answer, Localizer, Task
from ..errors import InputError
from ..files.atomic import temporary_folder
from ..jobs.memory import limit_memory
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
    """Bounds of what one request may take."""

    max_bytes: int  # of its body
    max_pixels: float  # of a picture, by its header
    max_waiting: int  # requests at once; one more is sent away
    seconds: float  # from the moment that a process takes it


class Drawing(NamedTuple):
    """A photo whose pictures are wanted, for the page."""

    task: Task
    result: str  # JSON


class Frame(NamedTuple):
    """A frame of a walk."""

    photo: Photo  # at a path that lasts as long as the walk
    name: str
    time: float | None


@dataclass(frozen=True)
class Answering:
    """Opens what a process answers with.

    A `Task` gets its `Answer`, a `Drawing` the JSON of its pictures. None makes ready for both.
    """

    localizer: Localizer
    max_pixels: float

    def __call__(self) -> Function:
        """Open the scan in this process."""
        limit_memory(self.localizer.max_memory)
        scan = self.localizer.open_scan(Workers(self.localizer.num_threads))
        answer = self.localizer.answer_in(scan)
        draw = cache(partial(open_drawing, scan))

        def work(item: Task | Drawing | None) -> Answer | str | None:
            if item is None:
                draw()
                return None
            if isinstance(item, Drawing):
                return draw()(item)
            with item.place(Path()) as photo:
                check_size(photo.path, item.photo.name, self.max_pixels)
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


def open_drawing(scan: OpenedScan) -> Callable[[Drawing], str]:
    """Return what draws photos and the scan from their poses."""
    points = scan.prepared.points.subsample(MAX_SURFELS)
    surfels = make_surfels(points, scan.workers)

    def draw(drawing: Drawing) -> str:
        result = Result.from_json(drawing.result)
        found = [result.best_pose, *(a.pose for a in result.alternatives)]
        poses = [scan.prepared.from_world(pose) for pose in found if pose]
        with drawing.task.place(Path()) as photo:
            thumbnail, pictures = make_pictures(photo.path, result, poses, (surfels, points), WIDTH)
        url = site.data_url(thumbnail, "image/jpeg")
        return f'{{"thumb": "{url}", "pictures": {pictures}}}'

    return draw


@dataclass(frozen=True)
class Following:
    """Opens what a process follows one walk with: a `Frame` gets its line, None the lines of all frames."""

    localizer: Localizer
    motion: Motion

    def __call__(self) -> Function:
        """Open the scan in this process, and begin the walk."""
        limit_memory(self.localizer.max_memory)
        scan = self.localizer.open_scan(Workers(self.localizer.num_threads))
        settings = self.localizer.settings
        walk = Walk(scan, settings, self.motion)

        def follow(frame: Frame | None) -> str | list[str]:
            if frame is None:
                return [result.to_json() for result in walk.finish()]
            return walk.add(frame.photo, frame.time, frame.name).to_json()

        return follow


@dataclass
class Desk:
    """An open scan."""

    localizer: Localizer
    scan_map: ScanMap
    document: dict[str, Any]  # what the page knows of the scan
    plans: dict[str, bytes]  # PNG, by the name that the document has
    processes: Processes
    extent: list[list[float]]  # least and greatest x, y, z [m] of the points, in the frame of the plans
    files: object  # what `look_at` said of the scan's files
    num_at_work: int = 0  # questions
    is_retired: bool = False

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Within this, a question is at work; a desk that is retired closes after the last."""
        self.num_at_work += 1
        try:
            yield
        finally:
            self.num_at_work -= 1
            self._close_if_done()

    def retire(self) -> None:
        """Close when nothing is at work any more."""
        self.is_retired = True
        self._close_if_done()

    def describe(self, result: Result, key: str) -> dict[str, Any]:
        """Return what the page knows of a photo before its pictures."""
        (short,) = site.shorten_names([result.pano])
        entry = site.document_of_entry(site.Entry(result, None, 0.0), result.pano, key, self.scan_map)
        return {**entry, "short": short, "hasPictures": True, "thumb": None}

    def _close_if_done(self) -> None:
        if self.is_retired and not self.num_at_work:
            self.processes.close()


def open_desk(localizer: Localizer, num_jobs: int, limits: Limits, workers: Workers) -> Desk:
    """Open a scan, with its local features, so that no photo waits for these; InputError if it can't be."""
    files = look_at(localizer.paths)
    opened = localizer.open_scan(workers)
    scan_map, _ = opened.require_default_method("the service", localizer.settings)
    scan_map.features_now(workers)
    for warning in opened.warnings:
        workers.warn(warning)
    with temporary_folder() as folder:
        site.begin_folder(folder)
        document = document_of_scan(scan_map, localizer.name, folder)
        drawn = [storey["plan"]["file"] for storey in document["storeys"] if storey["plan"]]
        plans = {name: (folder / name).read_bytes() for name in drawn}
    about = {"scanSha256": scan_map.scan_sha256, "scans": list(scan_map.scan_names), "photos": []}
    document |= {"note": "", **about, "service": {"maxBytes": limits.max_bytes}}
    extent = [
        [float(x.min()), float(x.max())] for x in (scan_map.points.x, scan_map.points.y, scan_map.points.z)
    ]
    answering = Answering(localizer, limits.max_pixels)
    processes = Processes(answering, num_jobs, localizer.num_threads, limits.seconds)
    for _ in range(num_jobs):
        processes.submit(None)
    return Desk(localizer, scan_map, document, plans, processes, extent, files)


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


class WalkDesk:
    """A walk that is followed, frame by frame, in a process of its own."""

    def __init__(self, localizer: Localizer, motion: Motion, seconds: float) -> None:
        following = Following(localizer, motion)
        self.processes = Processes(following, 1, localizer.num_threads, seconds, attempts=1)
        self._end = ExitStack()
        self.folder = self._end.enter_context(temporary_folder())
        self._count = 0

    def keep(self, photo: Photo, content: bytes, time: float | None) -> Frame:
        """Write a frame, which lasts as long as the walk."""
        self._count += 1
        path = self.folder / f"{self._count}{photo.path.suffix}"
        path.write_bytes(content)
        return Frame(replace(photo, picture=path), photo.name, time)

    def close(self) -> None:
        """End the process, and remove the frames."""
        self.processes.close()
        self._end.close()
