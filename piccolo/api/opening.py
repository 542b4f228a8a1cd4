"""Opening of scans: files or arrays are read and prepared, or a prepared map is read."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np

from ..cloud.cloud_settings import METRES, CloudSettings, UpAxis
from ..cloud.stream import ARRAYS, CloudStream, open_cloud, stream_of_arrays
from ..localization.paper import PaperMap, prepare_by_paper
from ..photo.photo import File
from ..problem.prior import ball_of
from ..problem.settings import CoarseToFineSettings
from ..scan_map.open_map import CachePolicy, find_prepared_map, open_map, open_points
from ..scan_map.scan_map import ScanMap, check_within, prepare_map
from ..system.arguments import check_fields, check_kind
from ..system.arrays import Array, Floats, Values
from ..system.errors import InputError
from ..system.files.cache import sha256_of_files
from ..system.jobs.threads import (
    ProgressCallback,
    Stopwatch,
    Workers,
    no_progress,
    num_cores,
    report_progress,
)
from .photo_reader import Settings
from .scan import Scan

__all__ = ["Cloud", "find_prepared_map", "open_files", "open_points", "open_scan", "prepare_scan"]
Units = Literal["mm", "cm", "m", "ft", "us-ft"]
DEFAULT = CoarseToFineSettings()


@dataclass(frozen=True, eq=False)
class Cloud:
    """A scan with options that its files do not contain.

    A path, a list of paths or an array can be used in its place if no option is needed.

    Parameters
    ----------
    source
        Path of a scan in any format of docs/USAGE.md; several paths, which together are one scan; the path
        of a map that `Scan.save` or tools/prepare_map.py wrote; or points (N, 3) [m].
    colors
        RGB of the points (N, 3). Only with an array of points.
    units
        Unit of the coordinates in files, by default the one that a LAS or LAZ file names, else the metre.
        Arrays and all poses are in metres.
    up
        Axis of the scan that points up; "auto" is z, in glTF files y.
    ignore_colors
        Use the shape of the scan, and intensities, even if it has colours.
    color_range
        Full brightness of the colours: 1, 255 or 65535. By default it follows from the files.
    columns
        Names of the columns of text, PTS and .npy files, such as "xyzirgb". By default they follow from a
        header or from the values.
    crs
        Coordinate system of the scan, such as "EPSG:25832", to use GPS positions of photos. By default the
        one that a LAS, LAZ or E57 file names.

    Raises
    ------
    InputError
        An option is invalid, or does not go with another.
    """

    source: File | Sequence[File] | Floats
    _: KW_ONLY
    colors: Values | None = None
    units: Units | None = None
    up: UpAxis = "auto"
    ignore_colors: bool = False
    color_range: float | None = None
    columns: Sequence[str] = ()
    crs: str | None = None

    def __post_init__(self) -> None:
        """Refuse invalid values; the message names the option."""
        check_fields(self)
        if not isinstance(self.source, np.ndarray):
            if self.colors is not None:
                raise InputError("`colors`: found files, wanted an array of points")
            if not self.paths:
                raise InputError("`source`: found no file, wanted a scan's path")
        elif self.units not in (None, "m"):
            raise InputError(f"`units`: found {self.units!r} for arrays, wanted points in metres")
        self.settings  # noqa: B018  refuses options that do not go together

    @property
    def paths(self) -> list[Path]:
        """Paths of the files; empty for an array."""
        if isinstance(self.source, str | PathLike):
            return [Path(self.source)]
        return [] if isinstance(self.source, np.ndarray) else [Path(path) for path in self.source]

    @property
    def settings(self) -> CloudSettings:
        """Settings with which the scan is read."""
        return CloudSettings.of_options(
            self.ignore_colors,
            scale=METRES[self.units] if self.units else None,
            up=self.up,
            crs=self.crs,
            color_range=self.color_range,
            columns=tuple(self.columns),
        )


def open_scan(
    cloud: File | Sequence[File] | Floats | Cloud,
    *,
    settings: Settings = DEFAULT,
    cache: bool | File = True,
    num_threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> Scan:
    """Read a coloured scan and prepare it, so that photos can be localized in it.

    Parameters
    ----------
    cloud
        The scan. A path, several paths of one scan, or an array of points is a `Cloud` without options.
    settings
        `CoarseToFineSettings` (the default method) or `PaperSettings` (the method of the paper).
    cache
        Keep the prepared map in the user's cache (True, the default), nowhere (False), or in this folder.
    num_threads
        Threads that prepare the scan and localize photos, by default one for each core.
    progress
        Function that is called as `progress(what, done, total)`; `total` is None where it is unknown.

    Returns
    -------
    Scan
        Its `warnings` name what may be wrong with the scan, such as its unit or vertical.

    Raises
    ------
    InputError
        A file is missing or damaged, or is of an unknown format; or an option is invalid.
        A prepared map takes no `units`, `up` and `ignore_colors`.

    Examples
    --------
    >>> import piccolo
    >>> scan = piccolo.open_scan(piccolo.Cloud("room/cloud.ply", units="m", up="z"))
    >>> for result in scan.localize_many(["room/images/clean_0.jpg", "room/images/clean_1.jpg"]):
    ...     print(result.pano, result.status)
    room/images/clean_0.jpg localized
    room/images/clean_1.jpg localized
    """
    scan = cloud if isinstance(cloud, Cloud) else Cloud(cloud)
    check_kind("settings", settings, Settings)
    check_kind("cache", cache, bool | File)
    check_kind("num_threads", num_threads, int | None)
    check_kind("progress", progress, ProgressCallback | None)
    show = report_progress(progress) if progress else no_progress
    workers = Workers(num_cores() if num_threads is None else num_threads, show)
    if isinstance(scan.source, np.ndarray):
        colors = None if scan.ignore_colors else scan.colors
        stream = stream_of_arrays(scan.source, colors, scan.color_range)
        return prepare_scan(stream, str(ARRAYS), scan.settings, settings, workers, Stopwatch())
    policy = CachePolicy(cache is not False, None if isinstance(cache, bool) else Path(cache))
    return open_files(scan.paths, scan.settings, settings, policy, workers)


def open_files(
    paths: Sequence[Path],
    cloud_settings: CloudSettings,
    settings: Settings,
    cache: CachePolicy,
    workers: Workers,
) -> Scan:
    """Open the files of a scan, or a prepared map."""
    watch = Stopwatch()
    name = str(paths[0]) if len(paths) == 1 else tuple(map(str, paths))
    if isinstance(settings, CoarseToFineSettings):
        scan_map = open_map(paths, cloud_settings, cache, workers, watch, ball_of(settings.prior))
        check_within(scan_map, settings.prior.within)
        return Scan(scan_map, name, cloud_settings, settings, workers, watch.seconds)
    if map_path := find_prepared_map(paths):
        raise InputError(f"{map_path}: a prepared map; the preset paper needs the cloud itself")
    with watch.stage("read"):
        cloud = open_cloud(paths, cloud_settings, workers.show)
        cloud = replace(cloud, sha256=sha256_of_files(paths))
    return prepare_scan(cloud, name, cloud_settings, settings, workers, watch)


def prepare_scan(
    cloud: CloudStream,
    name: str | tuple[str, ...],
    cloud_settings: CloudSettings,
    settings: Settings,
    workers: Workers,
    watch: Stopwatch,
    up: Array | None = None,
) -> Scan:
    """Prepare a scan for the method of the settings; `up` may be a rotation (3, 3) that makes its z up."""
    prepared: ScanMap | PaperMap
    if isinstance(settings, CoarseToFineSettings):
        axis = cloud_settings.up if up is None else up
        prepared = prepare_map(cloud, workers, axis, watch, ball_of(settings.prior))
    elif not cloud.has_colors:
        raise InputError(f"{cloud.label}: found no colours to be used, wanted some for the preset paper")
    else:
        with watch.stage("read"):
            points = cloud.read()
        for warning in points.warnings:
            workers.warn(warning)
        with watch.stage("prepare"):
            prepared = prepare_by_paper(points.pack(), settings)
    prepared = replace(prepared, scan_sha256=cloud.sha256)
    return Scan(prepared, name, cloud_settings, settings, workers, watch.seconds)
