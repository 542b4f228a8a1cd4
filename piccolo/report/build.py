"""A report of results in a scan: facts, plans, and the pictures of each photo, taken up where stopped."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import __version__
from ..cloud.soa import PackedPoints
from ..errors import InputError
from ..files.atomic import write_atomically
from ..files.cache import digest_of_sources
from ..files.temporary import temporary_folder
from ..geometry.pose import Array, Pose
from ..jobs.threads import Workers
from ..panorama.photo import photo_of
from ..result import FAILED, UNREADABLE, check_scan
from ..scan_map.scan_map import ScanMap
from ..views.pictures import encode_image
from ..views.surfels import MAX_SURFELS, Surfels, surfels_of
from .entries import Entry, Place, document_of_entry, names_of, short_names_of
from .own_plan import OwnPlan, check_own_plans, own_plan
from .pictures import make_pictures, read_options_of
from .plan_image import draw_plan
from .site import begin_folder, check_folder, finish_folder, picture_path, self_contained, write_photo_script
from .video_frames import taken_out

FORMAT = "piccolo-report/1"
WIDTH = 2048  # [px] of spheres
MAX_SELF_CONTAINED = 50  # photos
CAMERA_HEIGHT = 1.5  # [m] taken of a map in which nothing is level
MAKERS = ("report", "render", "confidence", "panorama", "camera")  # folders whose sources make the pictures


@dataclass(frozen=True)
class ReportSettings:
    """What a report is to show, beside results and scan."""

    title: str = ""  # of the page; by default the scan's name
    storey_names: tuple[str, ...] = ()  # the lowest first; by default they are numbered
    images: Path | None = None  # folder of the photos, where they are no more at the results' paths
    width: int | None = WIDTH  # [px] of spheres, at most; None for the photos' own
    is_self_contained: bool = False  # one file, of few photos
    own_plans: tuple[OwnPlan, ...] = ()  # in place of those drawn from the scan
    crs: str = ""  # coordinate system of the scan, if its map names none
    is_forced: bool = False  # results of another scan are shown all the same, and the page says so


class Report(NamedTuple):
    """What was made."""

    page: Path  # the page
    document: dict[str, Any]  # what it shows
    warnings: tuple[str, ...]  # photos of which there are no pictures, and why


class Task(NamedTuple):
    """A photo whose pictures are to be made."""

    entry: Entry
    photo: Path
    key: str
    poses: list[Pose]  # the best and the alternatives, in the map's frame


def build_report(
    entries: Sequence[Entry], scan_map: ScanMap, out: Path, settings: ReportSettings, workers: Workers
) -> Report:
    """Write the report of results in a scan: a folder, or one file."""
    if not entries:
        raise InputError("report: found no result")
    if settings.is_self_contained and len(entries) > MAX_SELF_CONTAINED:
        found = f"found {len(entries)} photos, wanted {MAX_SELF_CONTAINED} or fewer"
        raise InputError(f"--self-contained: {found}; without it the report is a folder")
    place = Place(scan_map, scan_map.storeys)
    note = check_settings(settings, place, entries)
    with temporary_folder() if settings.is_self_contained else nullcontext(out) as folder:
        if not settings.is_self_contained:
            check_folder(out)
        begin_folder(folder)
        tasks = [task_of(entry, place, settings) for entry in entries]
        warnings = (*filter(None, [note]), *write_pictures(tasks, place, folder, settings, workers))
        document = {**document_of(tasks, place, folder, settings), "note": note}
        if not settings.is_self_contained:
            finish_folder(folder, document)
            return Report(out / "index.html", document, warnings)
        write_atomically(out, self_contained(folder, document).encode())
        return Report(out, document, warnings)


def check_settings(settings: ReportSettings, place: Place, entries: Sequence[Entry]) -> str:
    """Refuse storeys that are not there, and results of another scan; if forced, return words on these."""
    found = max(len(place.storeys.storeys), 1)
    if settings.storey_names and len(settings.storey_names) != found:
        names = f"found {len(settings.storey_names)} names"
        raise InputError(f"--storeys: {names}, wanted {found}, as the scan has storeys, the lowest first")
    check_own_plans(settings.own_plans, found)
    return check_scan(
        [entry.result for entry in entries], place.scan_map.scan_sha256, "that given", settings.is_forced
    )


def task_of(entry: Entry, place: Place, settings: ReportSettings) -> Task:
    """What is to be done for a result; its key is of all that its pictures depend on."""
    result = entry.result
    photo = Path(result.pano)
    if settings.images is not None:
        photo = settings.images / photo.name
    try:
        digest = photo_of(photo, read_options_of(result).rig).sha256
    except (OSError, InputError):
        digest = ""
    parts = entry.line, digest, place.scan_map.scan_sha256, repr(settings.width), digest_of_sources(MAKERS)
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    found = [result.best_pose, *(a.pose for a in result.alternatives)] if result.best_pose else []
    return Task(entry, photo, key, [place.scan_map.from_world(pose) for pose in found if pose])


def write_pictures(
    tasks: Sequence[Task], place: Place, folder: Path, settings: ReportSettings, workers: Workers
) -> tuple[str, ...]:
    """Make the pictures that are not there yet; why some could not be made."""
    todo = list({task.key: task for task in tasks if needs_pictures(task, folder)}.values())
    if not todo:
        return ()
    points = place.scan_map.points.subsample(MAX_SURFELS)
    scan = surfels_of(points, workers) if any(task.poses for task in todo) else None
    with taken_out([task.photo for task in todo]) as files:
        write = writer(scan, points, folder, settings.width)
        taken = [task._replace(photo=files.get(task.photo, task.photo)) for task in todo]
        return tuple(warning for warning in workers.map(write, taken, "photos") if warning)


def needs_pictures(task: Task, folder: Path) -> bool:
    """True unless they are there, or can't be: the photo was not read when it was localized."""
    is_there = picture_path(folder, "photos", task.key).exists()
    return task.entry.result.status not in (UNREADABLE, FAILED) and not is_there


def writer(
    scan: Surfels | None, points: PackedPoints, folder: Path, width: int | None
) -> Callable[[Task], str]:
    """A function that makes and writes a photo's pictures; what it returns says why it could not."""

    def write(task: Task) -> str:
        try:
            poses = task.poses if scan is not None else []
            whole = scan or Surfels(points, np.empty((0, 3), np.float32), np.empty(0, np.float32))
            made = make_pictures(task.photo, task.entry.result, poses, (whole, points), width)
        except (OSError, InputError) as error:
            return f"{task.photo}: no pictures of it ({error})"
        if made.thumbnail is not None:
            write_atomically(picture_path(folder, "thumbs", task.key), made.thumbnail)
        write_photo_script(folder, task.key, made.script)  # last: it says that both are there
        return ""

    return write


def document_of(
    tasks: Sequence[Task], place: Place, folder: Path, settings: ReportSettings
) -> dict[str, Any]:
    """All that the page knows at once; writes the plans."""
    m = place.scan_map
    names = names_of([task.entry for task in tasks])
    photos = []
    for task, name, short in zip(tasks, names, short_names_of(names), strict=True):
        has_pictures = picture_path(folder, "photos", task.key).exists()
        thumb = f"thumbs/{task.key}.jpg" if picture_path(folder, "thumbs", task.key).exists() else None
        entry = document_of_entry(task.entry, name, task.key, place)
        photos.append({**entry, "short": short, "hasPictures": has_pictures, "thumb": thumb})
    cloud = tasks[0].entry.result.cloud
    clouds = [Path(path).name for path in ([cloud] if isinstance(cloud, str) else cloud)]
    north = m.R_map_from_world @ np.array([0.0, 1.0, 0.0])
    has_north = bool(settings.crs or m.crs)
    return {
        "format": FORMAT,
        "version": __version__,
        "title": settings.title or Path(clouds[0]).stem,
        "cloud": ", ".join(clouds),
        "crs": settings.crs or m.crs,
        "north": [float(north[0]), float(north[1])] if has_north else None,
        "origin": m.origin_world.tolist(),
        "R": m.R_map_from_world.ravel().tolist(),
        "storeys": list(storey_documents(place, tasks, folder, settings)),
        "photos": photos,
    }


def storey_documents(
    place: Place, tasks: Sequence[Task], folder: Path, settings: ReportSettings
) -> Iterator[dict[str, Any]]:
    """The storeys, each with its plan, which is written."""
    m = place.scan_map
    origin = float((m.R_map_from_world @ m.origin_world)[2])
    storey, height = place.storeys.at(m.centers)
    if not place.storeys.storeys:
        storey, height = np.zeros(len(m.centers), np.int64), np.full(len(m.centers), CAMERA_HEIGHT)
    own = {plan.storey - 1: plan for plan in settings.own_plans}
    for k in range(max(len(place.storeys.storeys), 1)):
        name = settings.storey_names[k] if settings.storey_names else f"Storey {k + 1}"
        is_here = storey == k
        places, floors = m.centers[is_here], m.centers[is_here, 2] - height[is_here]
        floor = place.storeys.storeys[k].floor if place.storeys.storeys else float(np.median([*floors, 0.0]))
        plan = write_own_plan(own[k], m, folder) if k in own else write_plan(m, places, floors, folder)
        yield {"name": name, "floor": floor, "level": round(origin + floor, 3), "plan": plan}


def write_plan(m: ScanMap, places: Array, floors: Array, folder: Path) -> dict[str, Any] | None:
    """Draw and write the plan of a storey: its file, size [px], matrix and metres a pixel."""
    plan = draw_plan(m.points, places, floors)
    if plan is None:
        return None
    height, width = plan.rgba.shape[:2]
    file = keep_plan(folder, encode_image(plan.rgba, ".png"))
    return {"file": file, "width": width, "height": height, "matrix": plan.matrix, "pixel": plan.pixel}


def write_own_plan(plan: OwnPlan, m: ScanMap, folder: Path) -> dict[str, Any]:
    """The same of the user's plan."""
    content, (width, height), matrix = own_plan(plan, m)
    pixel = float(np.hypot(matrix[0], matrix[1]))
    file = keep_plan(folder, content)
    return {"file": file, "width": width, "height": height, "matrix": matrix, "pixel": pixel}


def keep_plan(folder: Path, content: bytes) -> str:
    """Write a plan under the name of its content; its path in the report."""
    key = hashlib.sha256(content).hexdigest()[:32]
    write_atomically(picture_path(folder, "plans", key), content)
    return f"plans/{key}.png"
