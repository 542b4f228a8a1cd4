"""Answers to the panoramas of a batch, in this process or where else the scan is opened."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from .. import __version__
from ..camera import Calibration
from ..cloud.settings import CloudSettings
from ..errors import InputError, is_passing
from ..files.json_file import reading_once
from ..jobs.cluster import find_sent_file
from ..jobs.memory import limit_memory
from ..jobs.tasks import WorkerLostError
from ..jobs.threads import Workers
from ..localization.beside import SurePhoto
from ..localization.settings import CoarseToFineSettings
from ..opened_scan import OpenedScan, Settings, make_failed_result, settings_json
from ..opening import open_files
from ..panorama import ReadOptions, read_panorama
from ..result import Beside, Result, Source, unreadable_result
from ..scan_map.map_file import load_map
from ..scan_map.open_map import CachePolicy
from ..views.pictures import encode_image, overlay_png
from .priors import PriorTable
from .second_look import MOST_PICTURES, Look


class Task(NamedTuple):
    """A panorama to be localized."""

    pano: Path
    settings: Settings
    calibration: Calibration | None = None  # the camera of this photo
    files: Mapping[str, bytes] | None = None  # what is at `pano`, where that is not to be seen
    look: Look | None = None  # if it is looked at again, beside others

    @contextmanager
    def place(self, folder: Path) -> Iterator[Path]:
        """Yield the panorama's path here: relative to a folder, or written from the files."""
        if self.files is None:
            yield folder / self.pano
            return
        with TemporaryDirectory(prefix="piccolo-") as temporary:
            for name, content in self.files.items():
                path = Path(temporary) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            yield Path(temporary) / self.pano.name


def files_of(pano: Path) -> dict[str, bytes]:
    """Return the content of a photo's file, or of all files in its folder; none of what can't be read."""
    with suppress(OSError):
        paths = sorted(pano.rglob("*")) if pano.is_dir() else [pano]
        return {str(path.relative_to(pano.parent)): path.read_bytes() for path in paths if path.is_file()}
    return {}


class Answer(NamedTuple):
    """A result, and the pictures that go with it."""

    result: Result
    warnings: tuple[str, ...] = ()  # of the photo, without those of the scan
    overlay: bytes | None = None  # PNG
    occlusion_mask: bytes | None = None  # PNG


@dataclass(frozen=True)
class Localizer:
    """A scan and the options for its photos, which answer tasks; pickled for other processes."""

    paths: tuple[Path, ...]  # of the scan
    settings: Settings  # for which the scan is prepared
    cloud_settings: CloudSettings
    read_options: ReadOptions
    cache: CachePolicy
    priors: PriorTable | None = None
    num_threads: int = 1
    max_memory: float | None = None  # [10^9 byte], of a process
    makes_overlays: bool = False
    makes_occlusion_masks: bool = False
    folder: Path = Path()  # which paths are relative to
    map_name: str | None = None  # of the map's file that a cluster's workers have been sent
    sends_photos: bool = False

    @property
    def name(self) -> str | tuple[str, ...]:
        """The scan's path as given, or the paths of its files."""
        return str(self.paths[0]) if len(self.paths) == 1 else tuple(map(str, self.paths))

    def task(self, pano: Path, calibration: Calibration | None = None) -> Task:
        """Return what is to be done for a panorama."""
        files = files_of(pano) if self.sends_photos else None
        return Task(pano, self.settings_of(pano), calibration, files)

    def settings_of(self, pano: Path) -> Settings:
        """Return the settings of one panorama: its own prior, if it has one."""
        if self.priors is None or not isinstance(self.settings, CoarseToFineSettings):
            return self.settings
        return replace(self.settings, prior=self.priors.prior_of(pano, self.settings.prior))

    def expect(self, cloud_sha256: str) -> Callable[[Path], Mapping[str, Any]]:
        """Return the fields of a panorama's line that say how it was made, the most telling first."""

        @lru_cache
        def make_fields(settings: Settings) -> Mapping[str, Any]:
            scan = {"cloud_sha256": cloud_sha256, "cloud": self.name}
            repeated = settings_json(settings, self.cloud_settings, self.read_options)
            return dict(json.loads(json.dumps({**scan, "settings": repeated, "version": __version__})))

        return lambda pano: make_fields(self.settings_of(pano))

    def open(self) -> Callable[[Task], Answer]:
        """Open the scan in this process; return what answers tasks."""
        limit_memory(self.max_memory)
        return self.answer_in(self.open_scan(Workers(self.num_threads)))

    def answer_in(self, scan: OpenedScan) -> Callable[[Task], Answer]:
        """Return what answers tasks in an opened scan."""
        locate = lru_cache(MOST_PICTURES)(partial(self.locate, scan))

        def answer(task: Task) -> Answer:
            if task.look is None:
                return self.answer(scan, task)
            return self.answer_again(scan, task, task.look, locate)

        return answer

    def open_scan(self, workers: Workers) -> OpenedScan:
        """Read and prepare the scan."""
        if self.map_name:
            scan_map = load_map(find_sent_file(self.map_name))
            return OpenedScan(scan_map, self.name, self.cloud_settings, self.settings, workers, {})
        paths = [self.folder / path for path in self.paths]
        scan = open_files(paths, self.cloud_settings, self.settings, self.cache, workers)
        return replace(scan, name=self.name)

    def answer(self, scan: OpenedScan, task: Task) -> Answer:
        """Localize one panorama, and make the pictures asked for; of one that can't be read say why."""

        def localize(path: Path) -> Result:
            return scan.localize_query(path, self.read_options, task.settings, None, task.calibration)

        return self._answer(scan, task, localize)

    def answer_again(
        self, scan: OpenedScan, task: Task, look: Look, locate: Callable[[str], SurePhoto | None]
    ) -> Answer:
        """Look at a photo again, beside others; `locate` returns one of these by its result's JSON."""

        def list_pictures() -> dict[str, SurePhoto]:
            found = ((json.loads(line)["pano"], locate(line)) for line in look.beside)
            return {name: picture for name, picture in found if picture}

        def localize(path: Path) -> Result:
            read = self.read_options
            if look.first:
                first = Result.from_json(look.first)
            else:
                first = scan.localize_query(path, read, task.settings, None, task.calibration, look.focal)
            if not look.beside:
                return replace(first, beside=None)
            found, names = scan.localize_again(path, first, list_pictures, read, task.settings)
            return replace(found, beside=Beside(names, look.asked_sha256))

        return self._answer(scan, task, localize)

    def locate(self, scan: OpenedScan, line: str) -> SurePhoto | None:
        """Return a photo that is sure, by the JSON of its result; None if it is another or none any more."""
        result = Result.from_json(line)
        pano = Path(result.pano)
        try:
            return scan.locate(self.folder / pano, result, self.read_options, self.settings_of(pano))
        except (OSError, InputError) as error:
            if is_passing(error):
                raise
        return None

    def _answer(self, scan: OpenedScan, task: Task, localize: Callable[[Path], Result]) -> Answer:
        """Return the answer by a function of the photo's path."""
        with task.place(self.folder) as path, reading_once():
            try:
                found = localize(path)
                overlay, mask = self._pictures(scan, path, found)
            except Exception as error:
                name = str(task.pano)
                return Answer(make_failed_result(scan, path, error, self.read_options, task.settings, name))
        name = str(task.pano)
        warnings = tuple(warning.replace(str(path), name) for warning in found.warnings)
        result = replace(found, pano=name, warnings=warnings)
        return Answer(result, warnings[len(scan.warnings) :], overlay, mask)

    def wait_for(self, task: Task, wait: Callable[[], Answer], cloud_sha256: str | None) -> Answer:
        """Return the answer to a task, also to one whose workers were lost."""
        try:
            return wait()
        except WorkerLostError as error:
            text = f"{task.pano}: {error}"
        settings = settings_json(task.settings, self.cloud_settings, self.read_options)
        about = {"settings": settings, "source": Source(cloud_sha256)}
        return Answer(unreadable_result(text, self.name, str(task.pano), is_passing=True, **about))

    def _pictures(self, scan: OpenedScan, pano: Path, result: Result) -> tuple[bytes | None, bytes | None]:
        """Overlay and occlusion mask as PNG, where they are asked for and there is a pose."""
        overlay = None
        mask = None
        pose = result.best_pose
        if pose is None:
            return overlay, mask
        read_options = self.read_options.with_refined_camera(result.cameras, pano)
        if self.makes_overlays:
            panorama = read_panorama(pano, read_options)
            overlay = overlay_png(scan.points, panorama, scan.from_world(pose), scan.workers)
        if self.makes_occlusion_masks:
            mask = encode_image(scan.occlusion_mask(pano, pose, read_options), ".png")
        return overlay, mask
