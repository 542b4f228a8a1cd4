"""What answers the panoramas of a batch: in this process, or where else the scan is opened."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from ..cloud.settings import CloudSettings
from ..coarse_to_fine.map_file import load_map
from ..coarse_to_fine.open_map import CachePolicy
from ..errors import InputError
from ..opening import open_files
from ..panorama import ReadOptions, read_panorama
from ..query_options import Settings
from ..render.surfel_renderer import encode_image, overlay_png
from ..result import Result, Source, named, unreadable_result
from ..runtime.cluster import sent_file
from ..runtime.memory import limit_memory
from ..runtime.threads import Workers
from ..scan import Scan, settings_json
from .batch import pano_sha256


class Task(NamedTuple):
    """A panorama to be localized."""

    pano: Path
    settings: Settings
    files: Mapping[str, bytes] | None = None  # what is at `pano`, where that is not to be seen

    @contextmanager
    def placed(self, folder: Path) -> Iterator[Path]:
        """Where the panorama is here: relative to a folder, or written from the files."""
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
    """The content of a photo's file, or of all files in its folder; none of what can't be read."""
    paths = sorted(pano.rglob("*")) if pano.is_dir() else [pano]
    with suppress(OSError):
        return {str(path.relative_to(pano.parent)): path.read_bytes() for path in paths if path.is_file()}
    return {}


class Answer(NamedTuple):
    """What is made of a task."""

    result: Result
    warnings: tuple[str, ...] = ()  # of the photo, without those of the scan
    overlay: bytes | None = None  # PNG
    occlusion_mask: bytes | None = None  # PNG


@dataclass(frozen=True)
class Localizer:
    """How tasks are answered; pickled for other processes."""

    paths: tuple[Path, ...]  # of the scan
    settings: Settings  # for which the scan is prepared
    cloud_settings: CloudSettings
    read_options: ReadOptions
    cache: CachePolicy
    num_threads: int = 1
    max_memory: float | None = None  # [10^9 byte], of a process
    makes_overlays: bool = False
    makes_occlusion_masks: bool = False
    folder: Path = Path()  # which paths are relative to
    map_name: str | None = None  # of the map's file that a cluster's workers have been sent
    sends_photos: bool = False

    def task(self, pano: Path, settings: Settings) -> Task:
        """What is to be done for a panorama."""
        return Task(pano, settings, files_of(pano) if self.sends_photos else None)

    def opened(self) -> Callable[[Task], Answer]:
        """What answers tasks in this process, when the scan has been opened for it."""
        limit_memory(self.max_memory)
        return partial(self.answer, self.open_scan(Workers(self.num_threads)))

    def open_scan(self, workers: Workers) -> Scan:
        """Read and prepare the scan."""
        name = str(self.paths[0]) if len(self.paths) == 1 else tuple(map(str, self.paths))
        if self.map_name:
            scan_map = load_map(sent_file(self.map_name))
            return Scan(scan_map, name, self.cloud_settings, self.settings, workers, {})
        paths = [self.folder / path for path in self.paths]
        scan = open_files(paths, self.cloud_settings, self.settings, self.cache, workers)
        return replace(scan, name=name)

    def answer(self, scan: Scan, task: Task) -> Answer:
        """Localize one panorama, and make the pictures asked for; of one that can't be read say why."""
        with task.placed(self.folder) as path:
            try:
                found = scan.localize_query(path, self.read_options, task.settings)
                overlay, mask = self._pictures(scan, path, found)
            except (OSError, InputError) as error:
                text = str(error).replace(str(path), str(task.pano))
                return self.failed(task, text, scan.name, scan.prepared.scan_sha256, path)
        result = named(found, path, task.pano)
        return Answer(result, result.warnings[len(scan.warnings) :], overlay, mask)

    def failed(
        self, task: Task, error: str, cloud: str | tuple[str, ...], cloud_sha256: str, path: Path
    ) -> Answer:
        """The answer to a task whose photo is at `path`, when nothing but an error in one line has come."""
        source = Source(cloud_sha256 or None, pano_sha256(path, self.read_options.rig))
        repeated = settings_json(task.settings, self.cloud_settings, self.read_options)
        return Answer(unreadable_result(error, cloud, str(task.pano), settings=repeated, source=source))

    def _pictures(self, scan: Scan, pano: Path, result: Result) -> tuple[bytes | None, bytes | None]:
        """Overlay and occlusion mask as PNG, where they are asked for and there is a pose."""
        pose, overlay, mask = result.best_pose, None, None
        if pose is None:
            return None, None
        read_options = self.read_options.refined(result.cameras)
        if self.makes_overlays:
            panorama = read_panorama(pano, read_options)
            overlay = overlay_png(scan.points, panorama, scan.from_world(pose), scan.workers)
        if self.makes_occlusion_masks:
            mask = encode_image(scan.occlusion_mask(pano, pose, read_options), ".png")
        return overlay, mask
