"""An open scan of the service: its description for the page, and the processes that localize photos in it.

Photos are sent as contents of files: a process writes a photo into a temporary folder while it works on it.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from ...api.scan import Scan
from ...api.values import Result
from ...batch.localizer import Localizer, Task
from ...photo.panorama.picture import open_picture
from ...scan_map.open_map import write_map
from ...scan_map.scan_map import ScanMap
from ...system.errors import InputError
from ...system.files.atomic import temporary_folder
from ...system.jobs.processes import Function, Processes
from ...system.jobs.threads import Workers
from ..report import site
from ..report.build import WIDTH, document_of_scan, draw_surfels, list_poses
from ..report.drawings import make_pictures

PIXELS = 1e6  # in a megapixel
MAP = "service.piccolo-map"


class RequestLimits(NamedTuple):
    """Limits of requests."""

    max_bytes: int  # of a request's body
    max_pixels: float  # of a picture, as its header says
    max_waiting: int  # photos at once; while so many wait, requests are refused
    seconds: float  # [s] that a process may work on a photo


class Sent(NamedTuple):
    """The photos of a request."""

    tasks: Sequence[Task]
    are_together: bool  # they were taken at one place


class Drawing(NamedTuple):
    """A request for the pictures of a localized photo, for the page."""

    task: Task
    result: Result


@dataclass
class Desk:
    """An open scan. Its processes use a map of their own, so the scan's files may be replaced meanwhile."""

    localizer: Localizer
    scan_map: ScanMap
    document: dict[str, Any]  # description of the scan for the page
    plans: dict[str, bytes]  # PNG files, by the names in the document
    processes: Processes  # that run `open_answering`
    files: object  # state of the scan's files, as `look_at` returned it
    end: ExitStack  # that removes the folder of the map
    num_users: int = 0  # requests that use it now
    is_retired: bool = False  # it closes when nobody uses it

    @contextmanager
    def in_use(self) -> Iterator["Desk"]:
        """Yield the desk, which stays open within the block."""
        self.num_users += 1
        try:
            yield self
        finally:
            self.num_users -= 1
            self._close_if_idle()

    def retire(self) -> None:
        """Close the desk, now or as soon as nobody uses it."""
        self.is_retired = True
        self._close_if_idle()

    def close(self) -> None:
        """Kill the processes and remove the map."""
        self.processes.close()
        self.end.close()

    def _close_if_idle(self) -> None:
        if self.is_retired and not self.num_users:
            self.close()


def open_desk(
    localizer: Localizer, num_jobs: int, limits: RequestLimits, keeps_photos: bool, workers: Workers
) -> Desk:
    """Open a scan and start its processes. Raise InputError if it can't be opened."""
    files = look_at(localizer.paths)
    opened = localizer.open_scan(workers)
    scan_map, _ = opened.require_default_method("the service", localizer.settings)
    end = ExitStack()
    folder = end.enter_context(temporary_folder())
    write_map(scan_map, folder / MAP)
    localizer = replace(localizer, map_name=str(folder / MAP))
    site.begin_folder(folder)
    document = document_of_scan(scan_map, localizer.name, folder)
    drawn = [storey["plan"]["file"] for storey in document["storeys"] if storey["plan"]]
    plans = {name: (folder / name).read_bytes() for name in drawn}
    points = scan_map.points
    extent = [[float(axis.min()), float(axis.max())] for axis in (points.x, points.y, points.z)]
    about = {"scanSha256": scan_map.scan_sha256, "scans": list(scan_map.scan_names), "extent": extent}
    terms = {"maxBytes": limits.max_bytes, "keepsPhotos": keeps_photos}
    document |= {**about, "note": "", "photos": [], "service": terms}
    answering = partial(open_answering, localizer, limits.max_pixels)
    processes = Processes(answering, num_jobs, localizer.num_threads, limits.seconds)
    for _ in range(num_jobs):
        processes.submit(None)
    return Desk(localizer, scan_map, document, plans, processes, files, end)


def look_at(paths: Sequence[Path]) -> list[object]:
    """Return the state of a scan's files, which changes when one is replaced or written to."""
    states: list[object] = []
    for path in paths:
        try:
            status = path.stat()
            states.append((status.st_ino, status.st_size, status.st_mtime_ns))
        except OSError as error:
            states.append(error.errno)
    return states


def open_answering(localizer: Localizer, max_pixels: float) -> Function:
    """Open the scan in a process; return the function that answers its items.

    For the photos of a request (`Sent`) it returns their results; several photos help each other. For a
    `Drawing` it returns JSON of the pictures. For None it prepares what both need.
    """
    tempfile.tempdir = os.environ.get("TMPDIR")  # else Python tests it, and rejects it on a full disk
    scan = localizer.open_here()
    answer = localizer.answer_in(scan)

    @cache
    def surfels() -> Any:
        return draw_surfels(scan.prepared.points, scan.workers)

    def work(item: Sent | Drawing | None) -> list[Result] | str | None:
        if isinstance(item, Drawing):
            return draw_photo(scan, surfels(), item)
        if item is None:
            surfels()
            return None
        for task in item.tasks:
            check_sent_size(task, max_pixels)
        if len(item.tasks) == 1:
            return [answer(item.tasks[0]).result]
        if item.are_together:
            return localizer.answer_group(scan, item.tasks)
        return localizer.answer_in_order(scan, item.tasks)

    return work


def check_sent_size(task: Task, max_pixels: float) -> None:
    """Refuse a picture with more pixels than the service allows, before it is decoded."""
    name = task.photo.name
    width = height = 0
    with suppress(InputError), open_picture(Path(name), content_of(task)) as image:
        width, height = image.size  # a file that is no picture is refused later, by its reader
    if width * height > max_pixels:
        found = f"found {width} x {height} px"
        raise InputError(f"{name}: {found}, wanted at most {max_pixels / PIXELS:g} megapixels")


def content_of(task: Task) -> bytes:
    """Return the content of the picture that was sent."""
    return (task.files or {})[task.photo.name]


def draw_photo(scan: Scan, surfels: Any, drawing: Drawing) -> str:
    """Return JSON of a photo's thumbnail and pictures."""
    result = drawing.result
    poses = list_poses(result, scan.prepared.from_world)
    with drawing.task.place(Path()) as photo:
        thumbnail, pictures = make_pictures(photo.path, result, poses, surfels, WIDTH)
    return f'{{"thumb": "{site.data_url(thumbnail, "image/jpeg")}", "pictures": {pictures}}}'
