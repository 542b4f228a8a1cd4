"""Answers to the photos of a batch, in this process or another one that has opened the scan."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from .. import __version__
from ..api.opening import open_files
from ..api.photo_reader import Settings, settings_json, unreadable_result
from ..api.scan import Scan
from ..api.scan_group import AskedTogether, localize_photos_together
from ..api.scan_look import Others
from ..api.scan_photo import Asked
from ..api.values import CloudSettings, CoarseToFineSettings, Result, Source, Step, Trace
from ..photo.camera import Calibration
from ..photo.panorama import read_panorama
from ..photo.panorama.picture import encode_image
from ..photo.photo import Photo, Vector
from ..scan_map.map_file import load_map
from ..scan_map.open_map import CachePolicy
from ..system.files.atomic import temporary_folder, write_temporary
from ..system.files.json_file import reading_once
from ..system.jobs.cluster import find_sent_file
from ..system.jobs.memory import limit_memory
from ..system.jobs.processes import WorkerLostError
from ..system.jobs.threads import Workers
from ..together.second_looks import Look, localize_in_order
from ..views.pictures import overlay_png
from .inputs import PriorTable


class Task(NamedTuple):
    """A photo to be localized."""

    photo: Photo
    settings: Settings
    files: Mapping[str, bytes] | None = None  # content of its file or folder, where its path can't be read
    look: Look | None = None  # a second look at the photo; None for the first

    @contextmanager
    def place(self, folder: Path) -> Iterator[Photo]:
        """Yield the photo with a path that can be read here: in `folder`, or written from `files`."""
        if self.files is None:
            yield replace(self.photo, picture=folder / self.photo.path)
            return
        with temporary_folder() as temporary:
            self.write_files(temporary)
            yield replace(self.photo, picture=temporary / self.photo.path.name)

    def write_files(self, folder: Path) -> None:
        """Write the task's `files` into a folder."""
        for name, content in (self.files or {}).items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_temporary(path, content)


def rename(result: Result, names: Mapping[str, str]) -> Result:
    """Return the result of a photo in a temporary folder with the names of photos in place of their paths."""
    path = result.pano
    name = names[path]
    beside = result.beside
    if beside is not None:
        beside = replace(beside, photos=tuple(names[photo] for photo in beside.photos))
    warnings = tuple(warning.replace(path, name) for warning in result.warnings)
    error = result.error and result.error.replace(path, name)
    return replace(result, pano=name, beside=beside, warnings=warnings, error=error)


def files_of(pano: Path) -> dict[str, bytes]:
    """Return the content of a photo's file, or of all files in its folder, without unreadable ones."""
    with suppress(OSError):
        paths = sorted(pano.rglob("*")) if pano.is_dir() else [pano]
        return {str(path.relative_to(pano.parent)): path.read_bytes() for path in paths if path.is_file()}
    return {}


class Answer(NamedTuple):
    """A result, and the pictures that belong to it."""

    result: Result
    warnings: tuple[str, ...] = ()  # those of the photo, without those of the scan
    overlay: bytes | None = None  # PNG
    occlusion_mask: bytes | None = None  # PNG
    steps: tuple[Step, ...] = ()  # steps of the search, if they are traced


@dataclass(frozen=True)
class Localizer:
    """A scan and the options for its photos, which answer tasks; pickled for other processes."""

    paths: tuple[Path, ...]  # paths of the scan's files
    settings: Settings  # with which the scan is prepared
    cloud_settings: CloudSettings
    photo: Photo  # the options that all photos share; it has no picture
    cache: CachePolicy
    priors: PriorTable | None = None
    num_threads: int = 1
    max_memory: float | None = None  # [10^9 byte] of each process
    makes_overlays: bool = False
    makes_occlusion_masks: bool = False
    is_traced: bool = False
    folder: Path = Path()  # to which paths are relative
    map_name: str | None = None  # a map's file: its absolute path, or its name among a cluster's sent files
    sends_photos: bool = False

    @property
    def name(self) -> str | tuple[str, ...]:
        """The scan's path as given, or the paths of its files."""
        return str(self.paths[0]) if len(self.paths) == 1 else tuple(map(str, self.paths))

    def ask(self, pano: Path) -> tuple[Photo, Settings]:
        """Return a photo and its settings, with its own row of the table of priors if it has one."""
        photo = replace(self.photo, picture=pano)
        settings = self.settings
        if self.priors is None or not isinstance(settings, CoarseToFineSettings):
            return photo, settings
        photo, prior = self.priors.apply(photo, settings.prior)
        return photo, replace(settings, prior=prior)

    def task(self, pano: Path, calibration: Calibration | None = None) -> Task:
        """Return the task of localizing a photo; `calibration` is used if no option gives one."""
        photo, settings = self.ask(pano)
        if calibration is not None and photo.camera is None and photo.rig is None:
            photo = photo.with_calibration(calibration)
        return Task(photo, settings, files_of(pano) if self.sends_photos else None)

    def expect(
        self, cloud_sha256: str, more: Mapping[str, Any] | None = None
    ) -> Callable[[Path], Mapping[str, Any]]:
        """Return a function that gives, for a photo's path, the fields that say how its line was made.

        The fields `more` are added to all of them.
        """

        @lru_cache
        def make_fields(settings: Settings, gravity_vector: Vector | None) -> Mapping[str, Any]:
            scan = {"cloud_sha256": cloud_sha256, "cloud": self.name}
            photo = replace(self.photo, gravity_vector=gravity_vector)
            repeated = settings_json(settings, self.cloud_settings, photo) | dict(more or {})
            return dict(json.loads(json.dumps({**scan, "settings": repeated, "version": __version__})))

        def expect(pano: Path) -> Mapping[str, Any]:
            photo, settings = self.ask(pano)
            return make_fields(settings, photo.gravity_vector)

        return expect

    def open(self) -> Callable[[Task], Answer]:
        """Open the scan in this process; return a function that answers tasks."""
        return self.answer_in(self.open_here())

    def open_here(self) -> Scan:
        """Open the scan with a process's own threads and memory."""
        limit_memory(self.max_memory)
        return self.open_scan(Workers(self.num_threads))

    def answer_in(self, scan: Scan) -> Callable[[Task], Answer]:
        """Return a function that answers tasks in an opened scan."""
        return partial(self.answer, scan, Others(scan, self.ask_by_result))

    def open_scan(self, workers: Workers) -> Scan:
        """Read and prepare the scan."""
        if self.map_name:
            path = Path(self.map_name)
            scan_map = load_map(path if path.is_absolute() else find_sent_file(self.map_name))
            return Scan(scan_map, self.name, self.cloud_settings, self.settings, workers, {})
        paths = [self.folder / path for path in self.paths]
        scan = open_files(paths, self.cloud_settings, self.settings, self.cache, workers)
        return replace(scan, name=self.name)

    def answer(self, scan: Scan, others: Others, task: Task) -> Answer:
        """Localize one photo, and make the wanted pictures; the result of an unreadable photo says why."""
        name = task.photo.name
        trace = Trace(self.is_traced)
        with task.place(self.folder) as photo, reading_once():
            try:
                if task.look is None:
                    found = scan.localize_photo(Asked(photo, task.settings), trace=trace)
                else:
                    found = scan.look_again(Asked(photo, task.settings), task.look, others)
                overlay, mask = self.make_pictures(scan, photo, found)
            except Exception as error:
                return Answer(scan.reader.make_failed(photo, error, task.settings, name))
        warnings = tuple(warning.replace(photo.name, name) for warning in found.warnings)
        result = replace(found, pano=name, warnings=warnings)
        return Answer(result, warnings[len(scan.warnings) :], overlay, mask, tuple(trace.steps))

    def ask_by_result(self, result: Result) -> Asked:
        """Return the photo of a result, and its settings."""
        photo, settings = self.ask(Path(result.pano))
        return Asked(replace(photo, picture=self.folder / photo.path), settings)

    def answer_in_order(self, scan: Scan, tasks: Sequence[Task]) -> list[Result]:
        """Localize photos that were sent together with the same options, so that they help each other."""
        with temporary_folder() as folder:
            for task in tasks:
                task.write_files(folder)
            photo, settings = tasks[0][:2]
            here = replace(self, folder=folder, photo=photo, settings=settings, priors=None)
            answer = here.answer_in(scan)

            def localize(task: Task, look: Look | None = None) -> Result:
                return answer(task._replace(files=None, look=look)).result

            return list(localize_in_order(tasks, localize, localize, settings.min_confidence))

    def answer_group(self, scan: Scan, tasks: Sequence[Task]) -> list[Result]:
        """Localize photos of one place that were sent together."""
        scan_map, _ = scan.require_default_method("photos together", self.settings)
        with temporary_folder() as folder:
            asked = []
            for task in tasks:
                task.write_files(folder)
                assert isinstance(task.settings, CoarseToFineSettings)
                asked.append(
                    AskedTogether(replace(task.photo, picture=folder / task.photo.path), task.settings)
                )
            found = localize_photos_together(scan_map, scan.reader, scan.workers, asked)
            names = {one.photo.name: task.photo.name for one, task in zip(asked, tasks, strict=True)}
            return [rename(result, names) for result in found]

    def give_up(self, task: Task, error: WorkerLostError, cloud_sha256: str | None) -> Answer:
        """Return the answer to a task whose workers were lost."""
        name = task.photo.name
        settings = settings_json(task.settings, self.cloud_settings, task.photo)
        about = {"settings": settings, "source": Source(cloud_sha256)}
        return Answer(unreadable_result(f"{name}: {error}", self.name, name, is_passing=True, **about))

    def make_pictures(self, scan: Scan, photo: Photo, result: Result) -> tuple[bytes | None, bytes | None]:
        """Return overlay and occlusion mask as PNG, each None if it is not wanted or there is no pose."""
        overlay = mask = None
        pose = result.best_pose
        if pose is None:
            return overlay, mask
        photo = photo.with_refined_camera(result.cameras)
        if self.makes_overlays:
            local = scan.prepared.from_world(pose)
            overlay = overlay_png(scan.prepared.points, read_panorama(photo), local, scan.workers)
        if self.makes_occlusion_masks:
            mask = encode_image(scan.occlusion_mask(photo, pose), ".png")
        return overlay, mask
