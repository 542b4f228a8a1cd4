"""A report of results in a scan: facts, plans, and the pictures of each photo, taken up where stopped."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import KW_ONLY, dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import __version__
from ...api.result_files import check_scan
from ...api.scan import Scan
from ...api.values import FAILED, UNREADABLE, Result
from ...geometry.points import PackedPoints
from ...geometry.pose import Pose
from ...photo.panorama.picture import encode_image
from ...photo.photo import File
from ...scan_map.scan_map import ScanMap
from ...system.arguments import check_fields, check_kind
from ...system.errors import InputError
from ...system.files.atomic import temporary_folder, write_atomically
from ...system.files.cache import digest_of_sources
from ...system.jobs.threads import Workers
from ...views.surfels import MAX_SURFELS, Surfels, make_surfels
from . import site
from .drawings import PlanImage, draw_plan, extract_frames, make_pictures, own_plan
from .photo_folder import PhotoFolder

FORMAT = "piccolo-report/1"
WIDTH = 2048  # [px] of spheres
MAX_SELF_CONTAINED = 50  # photos
CAMERA_HEIGHT = 1.5  # [m] taken of a map in which nothing is level
MAKERS = ("apps/report", "views", "evidence", "photo")  # folders whose sources make the pictures


@dataclass(frozen=True)
class ReportSettings:
    """Settings of a report, apart from its results and its scan.

    Parameters
    ----------
    title
        Title of the page, by default the scan's name.
    storeys
        Names of the storeys, the lowest first, by default numbers.
    images
        Folder of the photos, if they are no longer at the paths in the results. A photo whose digest is
        another than that in its result is not shown.
    full_size
        Keep the size of the photos. By default spheres are at most 2048 px wide.
    self_contained
        Write one HTML file, of at most 50 photos.
    own_plans
        Plans in place of the drawn ones, by storey (1 is the lowest): paths of an image and of a CSV file of
        two or more control points, with the columns u, v [px] and x, y [m].
    crs
        Coordinate system of the scan, for an arrow to grid north, if the scan does not name it.
    force
        Show results of another scan too, with a note on the page. Otherwise they raise InputError.
    """

    _: KW_ONLY
    title: str = ""
    storeys: Sequence[str] = ()
    images: File | None = None
    full_size: bool = False
    self_contained: bool = False
    own_plans: Mapping[int, tuple[File, File]] | None = None
    crs: str = ""
    force: bool = False

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def width(self) -> int | None:
        """Width [px] of spheres, at most; None for the photos' own."""
        return None if self.full_size else WIDTH


DEFAULT = ReportSettings()


class Report(NamedTuple):
    """A report that has been written."""

    page: Path  # the page
    document: dict[str, Any]  # what it shows
    warnings: tuple[str, ...]  # photos of which there are no pictures, and why


class PictureTask(NamedTuple):
    """A photo whose pictures are to be made."""

    entry: site.Entry
    photo: Path
    key: str
    poses: list[Pose]  # the best and the alternatives, in the map's frame
    problem: str = ""  # why its pictures can't be made


def build_report(
    entries: Sequence[site.Entry], scan_map: ScanMap, out: Path, settings: ReportSettings, workers: Workers
) -> Report:
    """Write the report of results in a scan: a folder, or one file."""
    if not entries:
        raise InputError("report: found no result")
    if settings.self_contained and len(entries) > MAX_SELF_CONTAINED:
        found = f"found {len(entries)} photos, wanted {MAX_SELF_CONTAINED} or fewer"
        raise InputError(f"`self_contained`: {found}; without it the report is a folder")
    note = check_settings(settings, scan_map, entries)
    with temporary_folder() if settings.self_contained else nullcontext(out) as folder:
        if not settings.self_contained:
            site.check_folder(out)
        site.begin_folder(folder)
        photos = PhotoFolder(None if settings.images is None else Path(settings.images))
        tasks = [make_task(entry, scan_map, settings, photos) for entry in entries]
        warnings = (*filter(None, [note]), *write_pictures(tasks, scan_map, folder, settings, workers))
        document = {**make_document(tasks, scan_map, folder, settings), "note": note}
        if not settings.self_contained:
            site.finish_folder(folder, document)
            return Report(out / "index.html", document, warnings)
        write_atomically(out, site.self_contained(folder, document).encode())
        return Report(out, document, warnings)


def check_settings(settings: ReportSettings, scan_map: ScanMap, entries: Sequence[site.Entry]) -> str:
    """Refuse storeys that are not there, and results of another scan; if forced, return words on these."""
    found = max(len(scan_map.storeys.storeys), 1)
    if settings.storeys and len(settings.storeys) != found:
        names = f"found {len(settings.storeys)} names"
        raise InputError(f"`storeys`: {names}, wanted {found}, as the scan has storeys, the lowest first")
    for storey, (image, _) in (settings.own_plans or {}).items():
        if not 1 <= storey <= found:
            raise InputError(f"{image}: found storey {storey}, wanted 1 to {found}")
    results = [entry.result for entry in entries]
    return check_scan(results, scan_map.scan_sha256, "that given", settings.force)


def make_task(
    entry: site.Entry, scan_map: ScanMap, settings: ReportSettings, folder: PhotoFolder
) -> PictureTask:
    """Return what is to be done for a result; its key is of all that its pictures depend on."""
    result = entry.result
    photo = folder.guess(result.pano)
    digest = problem = ""
    try:
        photo, digest = folder.find(result)
    except InputError as error:
        problem = str(error)
    parts = result.to_json(), digest, scan_map.scan_sha256, repr(settings.width), digest_of_sources(MAKERS)
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    return PictureTask(entry, photo, key, list_poses(result, scan_map.from_world), problem)


def list_poses(result: Result, from_world: Callable[[Pose], Pose]) -> list[Pose]:
    """Return the best pose and the alternatives in the map's frame; none of a photo without a pose."""
    found = [result.best_pose, *(alternative.pose for alternative in result.alternatives)]
    return [from_world(pose) for pose in found if pose]


def draw_surfels(points: PackedPoints, workers: Workers) -> tuple[Surfels, PackedPoints]:
    """Return the surfels of a scan, of a part of its points if these are many, and these points."""
    some = points.subsample(MAX_SURFELS)
    return make_surfels(some, workers), some


def write_pictures(
    tasks: Sequence[PictureTask], scan_map: ScanMap, folder: Path, settings: ReportSettings, workers: Workers
) -> tuple[str, ...]:
    """Make the pictures that are not there yet; why some could not be made."""
    readable = [task for task in tasks if task.entry.result.status not in (UNREADABLE, FAILED)]
    missing = [task for task in readable if not site.picture_path(folder, "photos", task.key).exists()]
    todo = list({task.key: task for task in missing}.values())
    if not todo:
        return ()
    if any(task.poses for task in todo):
        scan = draw_surfels(scan_map.points, workers)
    else:
        points = scan_map.points.subsample(MAX_SURFELS)
        scan = Surfels(points, np.empty((0, 3), np.float32), np.empty(0, np.float32)), points

    def write(task: PictureTask) -> str:
        if task.problem:
            return task.problem
        try:
            thumbnail, script = make_pictures(task.photo, task.entry.result, task.poses, scan, settings.width)
        except (OSError, InputError) as error:
            is_here = settings.images is not None or task.photo.is_absolute()
            where = "" if is_here else "; if it is in another folder, give `images` FOLDER"
            return f"{task.photo}: no pictures of it ({error}){where}"
        write_atomically(site.picture_path(folder, "thumbs", task.key), thumbnail)
        site.write_photo_script(folder, task.key, script)  # last: it says that both are there
        return ""

    with extract_frames([task.photo for task in todo]) as files:
        taken = [task._replace(photo=files.get(task.photo, task.photo)) for task in todo]
        return tuple(warning for warning in workers.map(write, taken, "photos") if warning)


def make_document(
    tasks: Sequence[PictureTask], scan_map: ScanMap, folder: Path, settings: ReportSettings
) -> dict[str, Any]:
    """All that the page knows at once; writes the plans."""
    names = site.unique_names([task.entry for task in tasks])
    photos = []
    for task, name, short in zip(tasks, names, site.shorten_names(names), strict=True):
        has_pictures = site.picture_path(folder, "photos", task.key).exists()
        thumb = f"thumbs/{task.key}.jpg" if site.picture_path(folder, "thumbs", task.key).exists() else None
        entry = site.document_of_entry(task.entry, name, task.key, scan_map)
        photos.append({**entry, "short": short, "hasPictures": has_pictures, "thumb": thumb})
    cloud = tasks[0].entry.result.cloud
    return {**document_of_scan(scan_map, cloud, folder, settings), "photos": photos}


def document_of_scan(
    scan_map: ScanMap, cloud: str | tuple[str, ...], folder: Path, settings: ReportSettings = DEFAULT
) -> dict[str, Any]:
    """Return what the page knows of a scan, with the paths of its files; writes the plans."""
    clouds = [Path(path).name for path in ([cloud] if isinstance(cloud, str) else cloud)]
    north = scan_map.R_map_from_world @ np.array([0.0, 1.0, 0.0])
    has_north = bool(settings.crs or scan_map.crs)
    return {
        "format": FORMAT,
        "version": __version__,
        "title": settings.title or Path(clouds[0]).stem,
        "cloud": ", ".join(clouds),
        "crs": settings.crs or scan_map.crs,
        "north": [float(north[0]), float(north[1])] if has_north else None,
        "origin": scan_map.origin_world.tolist(),
        "R": scan_map.R_map_from_world.ravel().tolist(),
        "storeys": list(storey_documents(scan_map, folder, settings)),
    }


def storey_documents(scan_map: ScanMap, folder: Path, settings: ReportSettings) -> Iterator[dict[str, Any]]:
    """Yield the storeys, each with its plan, which is written."""
    origin = float((scan_map.R_map_from_world @ scan_map.origin_world)[2])
    storey, height = scan_map.storeys.at(scan_map.centers)
    found = scan_map.storeys.storeys
    if not found:
        storey = np.zeros(len(scan_map.centers), np.int64)
        height = np.full(len(scan_map.centers), CAMERA_HEIGHT)
    given = (settings.own_plans or {}).items()
    own = {storey - 1: own_plan(Path(image), Path(csv), scan_map) for storey, (image, csv) in given}
    for k in range(max(len(found), 1)):
        name = settings.storeys[k] if settings.storeys else f"Storey {k + 1}"
        is_here = storey == k
        places = scan_map.centers[is_here]
        floors = scan_map.centers[is_here, 2] - height[is_here]
        floor = found[k].floor if found else float(np.median([*floors, 0.0]))
        plan = own.get(k) or draw_plan(scan_map.points, places, floors)
        document = plan and write_plan(plan, folder)
        yield {"name": name, "floor": floor, "level": round(origin + floor, 3), "plan": document}


def write_plan(plan: PlanImage, folder: Path) -> dict[str, Any]:
    """Write a plan under the name of its content: its file, size [px], matrix and metres a pixel."""
    content = encode_image(plan.pixels, ".png")
    key = hashlib.sha256(content).hexdigest()[:32]
    write_atomically(site.picture_path(folder, "plans", key), content)
    height, width = plan.pixels.shape[:2]
    size = {"width": width, "height": height, "pixel": float(np.hypot(plan.matrix[0], plan.matrix[1]))}
    return {"file": f"plans/{key}.png", "matrix": plan.matrix, **size}


def write_report(
    results: File | Iterable[File | Result], scan: Scan, out: File, settings: ReportSettings = DEFAULT
) -> Path:
    """Write a page that shows the photos on plans of the scan, and each photo over the scan.

    Parameters
    ----------
    results
        Results, or paths of files of JSON lines that localize.py wrote; one path or several items.
    scan
        The open `Scan`, whose threads and progress are used.
    out
        Folder that is new, empty, or has an earlier report, of which only the changed parts are written.
    settings
        The page's title, the storeys' names and more.

    Returns
    -------
    Path
        The page: index.html in `out`, or `out` itself if it is `self_contained`.

    Raises
    ------
    InputError
        A file can't be read, results are of another scan, the folder holds something else, or an option is
        invalid.

    Examples
    --------
    >>> import piccolo
    >>> scan = piccolo.open_scan("room/cloud.ply")
    >>> result = scan.localize("room/images/clean_0.jpg")
    >>> settings = piccolo.ReportSettings(storeys=["Ground floor"])
    >>> piccolo.write_report([result], scan, "report", settings)
    PosixPath('report/index.html')
    """
    check_kind("results", results, File | Iterable[File | Result])
    check_kind("scan", scan, Scan)
    check_kind("out", out, File)
    check_kind("settings", settings, ReportSettings)
    if not isinstance(scan.prepared, ScanMap):
        raise InputError("write_report: found a scan of the preset paper, wanted one of the default method")
    several = [results] if isinstance(results, str | PathLike) else results
    entries = site.collect_entries([item if isinstance(item, Result) else Path(item) for item in several])
    return build_report(entries, scan.prepared, Path(out), settings, scan.workers).page
