"""The map of a cloud: read from a prepared file, read from the cache, or prepared now."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..cloud.cloud_settings import BY_FILE, IN_COLORS, CloudSettings, R_z_from_axis
from ..cloud.stream import open_cloud, read_crs
from ..geometry.points import LocalCloud, pack_points
from ..geometry.pose import rotate_points
from ..system.errors import InputError
from ..system.files.cache import (
    cache_root,
    digest_of_sources,
    in_words,
    mark_used,
    own_folder,
    sha256_of_files,
)
from ..system.jobs.threads import Stopwatch, Workers
from .camera_positions import Ball
from .map_file import FORMAT, NAME, is_map_file, load_map, save_map
from .scan_addition import add_scan
from .scan_map import ScanMap, name_scan, prepare_map

FOLDER = "piccolo-maps"  # within the folder that the user names
# Folders of the package whose code makes a map. When one of their files has changed, maps are prepared anew.
MAKERS = ("cloud", "geometry", "local_features", "photo/panorama", "scan_map", "views")


@dataclass(frozen=True)
class CachePolicy:
    """Whether prepared maps are kept in a cache, and where."""

    is_used: bool = True
    folder: Path | None = None  # that the user names; None: the user's cache


def open_map(
    paths: Sequence[Path],
    cloud_settings: CloudSettings,
    cache: CachePolicy,
    workers: Workers,
    watch: Stopwatch,
    part: Ball | None = None,
) -> ScanMap:
    """Return the map of a cloud's files, from the cache or prepared now; or read a prepared map.

    `paths` may be a single prepared map instead of a cloud's files. `part`, a ball of the world, is used only
    if the scan is too large as a whole: then only that part is prepared.
    """
    map_path = find_prepared_map(paths)
    if map_path:
        bare = replace(cloud_settings, crs=None)
        if len(paths) > 1 or bare not in (BY_FILE, replace(BY_FILE, scale=1.0)):
            raise InputError(f"{map_path}: found a prepared map, wanted it alone, without options for clouds")
        with watch.stage("read"):
            return load_map(map_path, cache.is_used)

    digest = ""
    if all(path.is_file() for path in paths):  # others are refused when the cloud is opened
        with watch.stage("read"):
            digest = sha256_of_files(paths, cache.is_used)

    def build() -> ScanMap:
        with watch.stage("read"):
            cloud = open_cloud(paths, cloud_settings, workers.show)
        up = cloud_settings.up
        scan_map = prepare_map(cloud, workers, up, watch, part)
        return replace(scan_map, scan_sha256=digest, crs=read_crs(paths))

    key = content_key(digest, cloud_settings) if digest else ""
    if not (cache.is_used and key):
        return build()
    scan_map, warning = open_cached_map(cache.folder, key, digest, build, watch)
    if not warning:
        return scan_map
    workers.warn(warning)
    return replace(scan_map, warnings=(*scan_map.warnings, warning))


def write_map(scan_map: ScanMap, path: Path) -> None:
    """Write a map to a file. Raise InputError if it covers only a part of a scan."""
    if scan_map.is_partial:
        raise InputError(f"{path}: found a map prepared within `near` only, wanted a whole map")
    save_map(scan_map, path)


def extend_map(
    map_path: Path,
    paths: Sequence[Path],
    cloud_settings: CloudSettings,
    name: str,
    workers: Workers,
    watch: Stopwatch,
) -> ScanMap:
    """Return a prepared map with another scan added, called `name`.

    If the map's own scan has no name, it is named after the map's file.
    """
    if not find_prepared_map([map_path]):
        found = "no prepared map" if map_path.exists() else "no such file"
        raise InputError(f"{map_path}: found {found}, wanted a map of tools/prepare_map.py")
    if path := find_prepared_map(paths):
        raise InputError(f"{path}: found a prepared map, wanted the files of a scan to add")
    if cloud_settings.up != "auto":
        raise InputError("`up`: not with `add`; a scan is added in the axes of the map")
    with watch.stage("read"):
        old = load_map(map_path)
        if old.has_shape:
            raise InputError(f"{map_path}: `add`: found a map without colours, wanted one with them")
        cloud = open_cloud(paths, replace(cloud_settings, channels=IN_COLORS.channels), workers.show)
        digest = sha256_of_files(paths)
        crs = read_crs(paths)
    if crs and old.crs and crs != old.crs:
        workers.warn(f"{paths[0]}: names another coordinate system than the map; the map's is used")
    old = old if old.scan_names else name_scan(old, map_path.stem)
    both = "\n".join(sorted([old.scan_sha256, digest]))
    added = add_scan(old, cloud, name, workers, watch)
    return replace(added, scan_sha256=hashlib.sha256(both.encode()).hexdigest(), crs=old.crs or crs)


def find_prepared_map(paths: Sequence[Path]) -> Path | None:
    """Return the first of some files that is a prepared map, or None."""
    return next((path for path in paths if path.is_file() and is_map_file(path)), None)


def scan_sha256_of(paths: Sequence[Path], cache: CachePolicy) -> str:
    """Return the digest of a scan's files; for a prepared map, of the files it was made from."""
    map_path = find_prepared_map(paths)
    if map_path:
        return load_map(map_path, cache.is_used).scan_sha256
    return sha256_of_files(paths, cache.is_used)


def content_key(scan_sha256: str, settings: CloudSettings) -> str:
    """Return the name of a map in the cache, by the contents of the scan's files and the settings.

    It also depends on the map's format, the code that makes maps, and whether pyproj is installed, which
    knows the units of coordinate systems; not on paths.
    """
    has_pyproj = str(find_spec("pyproj") is not None)
    parts = [FORMAT, digest_of_sources(MAKERS), repr(replace(settings, crs=None)), has_pyproj, scan_sha256]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:32]


def open_cached_map(
    folder: Path | None, key: str, scan_sha256: str, build: Callable[[], ScanMap], watch: Stopwatch
) -> tuple[ScanMap, str]:
    """Return a map from the cache, or build it and keep it there; with a warning of one line, or "".

    The cache is in `folder`, or the user's if that is None. If the cache fails, the warning says so, and the
    map is returned but may not be kept. Two processes may build the same map at once: each writes the whole
    file, and both files are equal.
    """
    warning = ""
    try:
        kept_in = own_folder(folder / FOLDER if folder else cache_root() / "maps", NAME)
        path = kept_in / f"{key}.piccolo-map"
        if path.exists():
            with watch.stage("read"):
                mark_used(path)
                scan_map = load_map(path, remembers=True)
            if scan_map.scan_sha256 == scan_sha256:
                return scan_map, ""
            warning = f"{path}: found the map of another scan; it is prepared again"
    except InputError as error:
        warning = f"{error}; it is prepared again"
    except OSError as error:
        return build(), f"{in_words(error)}; the prepared map is not kept"
    scan_map = build()
    if scan_map.is_partial:
        return scan_map, ""
    try:
        with watch.stage("prepare"):
            save_map(scan_map, path)
    except OSError as error:
        return scan_map, f"{kept_in}: {error.strerror or error}; the prepared map is not kept"
    return scan_map, warning


def open_points(paths: Sequence[Path], settings: CloudSettings, workers: Workers) -> LocalCloud:
    """Return all points of a cloud's files, or the finest voxels of a prepared map, in the map's frame."""
    if find_prepared_map(paths):
        m = open_map(paths, settings, CachePolicy(is_used=False), workers, Stopwatch())
        return LocalCloud(m.R_map_from_world, m.origin_world, m.points, m.warnings)
    cloud = open_cloud(paths, settings, workers.show).read()
    R_map_from_world = R_z_from_axis(settings.up, cloud.up)
    points = rotate_points(cloud.points.astype(np.float64), R_map_from_world).astype(np.float32)
    packed = pack_points(points, cloud.colors)
    return LocalCloud(R_map_from_world, cloud.origin_world, packed, cloud.warnings)
