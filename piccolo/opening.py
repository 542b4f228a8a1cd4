"""How a scan is opened: read, prepared for a method, or taken from a map prepared before."""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from .cloud import open_cloud
from .cloud.settings import METRES, CloudSettings, UpAxis
from .cloud.stream import ARRAYS, CloudStream, stream_of_arrays
from .errors import InputError
from .files.digest import sha256_of_files
from .jobs.stopwatch import Stopwatch
from .jobs.threads import ProgressCallback, Workers, no_progress, num_cores, progress_to
from .localization.settings import CoarseToFineSettings
from .paper.localize import PaperMap
from .paper.localize import prepare as prepare_by_paper
from .query_options import File, Settings, refuse_unknown
from .scan import Scan
from .scan_map.named_scans import check_within
from .scan_map.open_map import CachePolicy, open_map, prepared_map_among
from .scan_map.scan_map import ScanMap, prepare_map


class ScanOptions(TypedDict, total=False):
    """How `open_scan` understands and prepares a scan; all may be left out."""

    units: Literal["mm", "cm", "m", "ft", "us-ft"]  # of the coordinates; metres if not given
    up: UpAxis  # the axis that points up; "auto" (default): the file's, z or in glTF y
    intensity_as_gray: bool  # for files without colours
    crs: str  # coordinate system, such as EPSG:25832, for photos with GPS; else what the file names
    cache: bool | File  # keep the prepared map in the user's cache (default), nowhere, or in a folder
    num_threads: int  # all cores if not given
    progress: ProgressCallback  # is told (what is done, how many are done, of how many or None)
    settings: Settings  # of the method; the default method's if not given


def open_scan(
    source: File | Sequence[File] | NDArray[np.floating[Any]],
    colors: NDArray[Any] | None = None,
    **options: Unpack[ScanOptions],
) -> Scan:
    """Read and prepare a coloured scan, in which photos can then be localized.

    Parameters
    ----------
    source
        Path of a scan in any format of the README, or of a map by tools/prepare_map.py; or several paths,
        which are one scan; or points (N, 3) [m].
    colors
        With points: (N, 3) RGB, uint8, uint16, or floats in [0, 1].
    **options
        See ScanOptions.

    Raises
    ------
    InputError
        A file is missing or damaged, has no colours, or is of a format that is not read.

    Examples
    --------
    >>> import piccolo
    >>> scan = piccolo.open_scan("room/cloud.ply", units="m", up="z")
    >>> for result in scan.localize_many(["room/images/clean_0.jpg", "room/images/clean_1.jpg"]):
    ...     print(result.pano, result.status)
    room/images/clean_0.jpg localized
    room/images/clean_1.jpg localized
    """
    refuse_unknown(options, ScanOptions, "open_scan")
    if (units := options.get("units", "m")) not in METRES:
        raise InputError(f"units: found {units!r}, wanted one of {', '.join(METRES)}")
    callback = options.get("progress")
    show = progress_to(callback) if callback else no_progress
    workers = Workers(options.get("num_threads", num_cores()), show)
    cache = options.get("cache", True)
    policy = CachePolicy(cache is not False, None if isinstance(cache, bool) else Path(cache))
    cloud_settings = CloudSettings(
        METRES[units],
        options.get("up", "auto"),
        options.get("intensity_as_gray", False),
        crs=options.get("crs"),
    )
    settings = options.get("settings", CoarseToFineSettings())
    if isinstance(source, np.ndarray):
        cloud, watch = stream_of_arrays(source, colors), Stopwatch()
        return scan_of(cloud, str(ARRAYS), cloud_settings, settings, workers, watch)
    if colors is not None:
        raise InputError("colors: given beside files, wanted with an array of points only")
    paths = [Path(source)] if isinstance(source, str | PathLike) else [Path(path) for path in source]
    if not paths:
        raise InputError("open_scan: found no file, wanted a scan's path")
    return open_files(paths, cloud_settings, settings, policy, workers)


def open_files(
    paths: Sequence[Path],
    cloud_settings: CloudSettings,
    settings: Settings,
    cache: CachePolicy,
    workers: Workers,
) -> Scan:
    """The same with all options as objects, for files."""
    watch = Stopwatch()
    name = str(paths[0]) if len(paths) == 1 else tuple(map(str, paths))
    if isinstance(settings, CoarseToFineSettings):
        scan_map = open_map(paths, cloud_settings, cache, workers, watch, settings.prior)
        check_within(scan_map, settings.prior.within)
        return Scan(scan_map, name, cloud_settings, settings, workers, watch.seconds)
    if map_path := prepared_map_among(paths):
        raise InputError(f"{map_path}: a prepared map; the preset paper needs the cloud itself")
    with watch.stage("read"):
        cloud = open_cloud(paths, cloud_settings, workers.show)
        cloud = replace(cloud, sha256=sha256_of_files(paths))
    return scan_of(cloud, name, cloud_settings, settings, workers, watch)


def scan_of(
    cloud: CloudStream,
    name: str | tuple[str, ...],
    cloud_settings: CloudSettings,
    settings: Settings,
    workers: Workers,
    watch: Stopwatch,
) -> Scan:
    """A scan prepared anew for the method of the settings."""
    prepared: ScanMap | PaperMap
    if isinstance(settings, CoarseToFineSettings):
        how = cloud_settings.up, watch
        prepared = prepare_map(cloud, workers, *how, prior=settings.prior, has_features=False)
    else:
        with watch.stage("read"):
            points = cloud.read()
        for warning in points.warnings:
            workers.warn(warning)
        with watch.stage("prepare"):
            prepared = prepare_by_paper(points, settings)
    prepared = replace(prepared, scan_sha256=cloud.sha256)
    return Scan(prepared, name, cloud_settings, settings, workers, watch.seconds)
