"""What answers the panoramas of a batch: in this process, or where else the scan is opened."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ..cloud.settings import CloudSettings
from ..coarse_to_fine.open_map import CachePolicy
from ..errors import InputError
from ..opening import open_files
from ..panorama import ReadOptions, read_panorama
from ..render.surfel_renderer import encode_image, overlay_png
from ..result import Result, Source, unreadable_result
from ..runtime.memory import limit_memory
from ..runtime.threads import Workers
from ..scan import Scan, Settings, settings_json
from .batch import pano_sha256


class Task(NamedTuple):
    """A panorama to be localized."""

    pano: Path
    settings: Settings


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

    def opened(self) -> Callable[[Task], Answer]:
        """What answers tasks in this process, when the scan has been opened for it."""
        limit_memory(self.max_memory)
        return partial(self.answer, self.open_scan(Workers(self.num_threads)))

    def open_scan(self, workers: Workers) -> Scan:
        """Read and prepare the scan."""
        return open_files(self.paths, self.cloud_settings, self.settings, self.cache, workers)

    def answer(self, scan: Scan, task: Task) -> Answer:
        """Localize one panorama, and make the pictures asked for; of one that can't be read say why."""
        try:
            result = scan.localize_query(task.pano, self.read_options, task.settings)
            overlay, mask = self._pictures(scan, task.pano, result)
        except (OSError, InputError) as error:
            return self.failed(task, str(error), scan.name, scan.prepared.scan_sha256)
        return Answer(result, result.warnings[len(scan.warnings) :], overlay, mask)

    def failed(self, task: Task, error: str, cloud: str | tuple[str, ...], cloud_sha256: str) -> Answer:
        """The answer to a task of which nothing but an error, one line, has come."""
        source = Source(cloud_sha256 or None, pano_sha256(task.pano, self.read_options.rig))
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
