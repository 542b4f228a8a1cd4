"""The two presets behind one interface: a cloud is opened once, and panoramas are localized in it."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from .cloud import open_cloud
from .cloud.settings import IN_METRES, CloudSettings
from .cloud.soa import LocalCloud, PackedPoints, pack_points
from .coarse_to_fine import localize as engine
from .coarse_to_fine.map_file import cached_map, content_key, is_map_file, load_map
from .coarse_to_fine.scan_map import ScanMap, prepare_map
from .coarse_to_fine.settings import CoarseToFineSettings
from .confidence.localization import Localization
from .errors import InputError
from .geometry.pose import Pose
from .gravity import R_z_from_axis
from .panorama import AS_STORED, Panorama, ReadOptions, read_panorama
from .paper import localize as paper
from .paper.settings import PaperSettings
from .result import Result, result_of
from .runtime.stopwatch import Stopwatch
from .runtime.threads import Workers


class Localizer(Protocol):
    """A prepared cloud."""

    @property
    def points(self) -> PackedPoints:
        """The cloud's points, near a local origin, for pictures."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know about the cloud, one line each."""

    @property
    def settings(self) -> CoarseToFineSettings | PaperSettings:
        """What it localizes with."""

    def from_world(self, pose: Pose) -> Pose:
        """A pose of the world in the frame of `points`."""

    def localize(self, panorama: Panorama, workers: Workers, watch: Stopwatch) -> Localization:
        """Where a panorama was taken."""


LABELS_WARNING = "labels: the confidence was learnt on colours, and is a rough guide only"


@dataclass(frozen=True)
class PaperLocalizer:
    """Preset `paper`."""

    paper_map: paper.PaperMap
    settings: PaperSettings
    warnings: tuple[str, ...]

    @property
    def points(self) -> PackedPoints:
        """See Localizer."""
        return self.paper_map.points

    def from_world(self, pose: Pose) -> Pose:
        """See Localizer."""
        return Pose(pose.R_cam_from_world, pose.center_world - self.paper_map.origin_world)

    def localize(self, panorama: Panorama, workers: Workers, watch: Stopwatch) -> Localization:
        """See Localizer."""
        return paper.localize(self.paper_map, panorama, self.settings, workers, watch)


@dataclass(frozen=True)
class DefaultLocalizer:
    """Preset `default`."""

    scan_map: ScanMap
    settings: CoarseToFineSettings

    @property
    def points(self) -> PackedPoints:
        """See Localizer."""
        return self.scan_map.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """See Localizer."""
        return self.scan_map.warnings

    def from_world(self, pose: Pose) -> Pose:
        """See Localizer."""
        return self.scan_map.from_world(pose)

    def localize(self, panorama: Panorama, workers: Workers, watch: Stopwatch) -> Localization:
        """See Localizer."""
        return engine.localize(self.scan_map, panorama, self.settings, workers, watch)


@dataclass(frozen=True)
class Inputs:
    """A cloud's files, and how they and the panoramas are to be read."""

    clouds: tuple[Path, ...]
    cloud_settings: CloudSettings = IN_METRES
    read_options: ReadOptions = AS_STORED

    def to_json(self) -> dict[str, object]:
        """What a result repeats of them."""
        panorama = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self.read_options).items()}
        return {"cloud": asdict(self.cloud_settings), "panorama": panorama}

    @property
    def cloud_name(self) -> str | tuple[str, ...]:
        """The cloud's files as a result names them."""
        return str(self.clouds[0]) if len(self.clouds) == 1 else tuple(map(str, self.clouds))


@dataclass(frozen=True)
class CachePolicy:
    """Where prepared maps are kept."""

    is_used: bool = True
    folder: Path | None = None  # None for the user's cache


def open_map(
    paths: Sequence[Path],
    cloud_settings: CloudSettings,
    cache: CachePolicy,
    workers: Workers,
    watch: Stopwatch,
) -> ScanMap:
    """The map of a cloud's files: prepared already, from the cache, or built now.

    A prepared map may stand in place of the files.
    """
    map_path = _map_among(paths)
    if map_path:
        if len(paths) > 1 or replace(cloud_settings, labels=None) != IN_METRES:
            raise InputError(f"{map_path}: found a prepared map, wanted it alone, without options for clouds")
        with watch.stage("read"):
            scan_map = load_map(map_path)
        if scan_map.has_labels != (cloud_settings.labels is not None):
            kind = "labels, wanted --labels too" if scan_map.has_labels else "colours, wanted no --labels"
            raise InputError(f"{map_path}: found a prepared map of {kind}")
        return scan_map

    def build() -> ScanMap:
        with watch.stage("read"):
            cloud = open_cloud(paths, cloud_settings, workers.show)
        scan_map = prepare_map(cloud, workers, cloud_settings.up, watch)
        return replace(scan_map, has_labels=cloud_settings.labels is not None)

    if not (cache.is_used and all(path.is_file() for path in paths)):
        return build()
    with watch.stage("read"):
        key = content_key(paths, cloud_settings)
    return cached_map(cache.folder, key, build, watch)


def _map_among(paths: Sequence[Path]) -> Path | None:
    return next((path for path in paths if path.is_file() and is_map_file(path)), None)


def open_points(paths: Sequence[Path], settings: CloudSettings, workers: Workers) -> LocalCloud:
    """All points of a cloud's files, or the voxels of the prepared map that stands in place of them."""
    if _map_among(paths):
        scan_map = open_map(paths, settings, CachePolicy(is_used=False), workers, Stopwatch())
        return LocalCloud(
            scan_map.points, scan_map.R_map_from_world, scan_map.origin_world, scan_map.warnings
        )
    cloud = open_cloud(paths, settings, workers.show).read()
    R_local_from_world = R_z_from_axis(settings.up)
    points = pack_points((cloud.points @ R_local_from_world.T).astype(np.float32), cloud.colors)
    return LocalCloud(points, R_local_from_world, cloud.origin_world, cloud.warnings)


def open_localizer(
    inputs: Inputs,
    settings: CoarseToFineSettings | PaperSettings,
    cache: CachePolicy,
    workers: Workers,
    watch: Stopwatch,
) -> Localizer:
    """Read and prepare a cloud for the preset that the settings belong to."""
    paths, cloud_settings = inputs.clouds, inputs.cloud_settings
    if isinstance(settings, CoarseToFineSettings):
        return DefaultLocalizer(open_map(paths, cloud_settings, cache, workers, watch), settings)
    map_path = _map_among(paths)
    if map_path:
        raise InputError(f"{map_path}: found a prepared map, wanted a cloud with the preset paper")
    with watch.stage("read"):
        cloud = open_cloud(paths, cloud_settings, workers.show).read()
    for warning in cloud.warnings:
        workers.warn(warning)
    with watch.stage("prepare"):
        paper_map = paper.prepare(cloud, settings)
    return PaperLocalizer(paper_map, settings, cloud.warnings)


def settings_json(inputs: Inputs, settings: CoarseToFineSettings | PaperSettings) -> dict[str, object]:
    """What a result repeats of how it was made."""
    return {**settings.to_json(), **inputs.to_json()}


def localize_file(
    localizer: Localizer, inputs: Inputs, pano: Path, workers: Workers, seconds: dict[str, float]
) -> tuple[Result, Panorama]:
    """The result of one panorama, and the panorama; `seconds` were spent on the cloud.

    Raises
    ------
    InputError
        The panorama can't be read.
    """
    watch = Stopwatch(dict(seconds))
    with watch.stage("read"):
        panorama = read_panorama(pano, inputs.read_options)
    found = localizer.localize(panorama, workers, watch)
    settings = settings_json(inputs, localizer.settings)
    result = result_of(found, inputs.cloud_name, str(pano), watch.seconds, settings)
    warnings = localizer.warnings + panorama.warnings
    warnings += (LABELS_WARNING,) if inputs.read_options.labels else ()
    return replace(result, warnings=warnings), panorama
