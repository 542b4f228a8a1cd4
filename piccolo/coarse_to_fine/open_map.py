"""The map of a cloud: prepared already, from the cache, or made now."""

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from ..cloud import open_cloud
from ..cloud.settings import IN_METRES, CloudSettings
from ..cloud.soa import LocalCloud, pack_points
from ..errors import InputError
from ..geometry.point_transforms import rotate_points
from ..gravity import R_z_from_axis
from ..runtime.cache import cache_root, mark_used, remove_stale
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .map_file import FORMAT, is_map_file, load_map, save_map
from .scan_map import ScanMap, prepare_map
from .settings import NOTHING_KNOWN, Prior

NAME = re.compile(r"[0-9a-f]{32}\.piccolo-map")  # of a file in the cache
# What makes a map: folders of the package. The cache makes maps anew when one of their files has changed.
MAKERS = ("cloud", "coarse_to_fine", "geometry", "gravity", "panorama")


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
    prior: Prior = NOTHING_KNOWN,
) -> ScanMap:
    """The map of a cloud's files: prepared already, from the cache, or built now.

    A prepared map may stand in place of the files. The prior is asked where the scan is too large as a whole.
    """
    map_path = prepared_map_among(paths)
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
        scan_map = prepare_map(cloud, workers, cloud_settings.up, watch, prior=prior)
        return replace(scan_map, has_labels=cloud_settings.labels is not None)

    if not (cache.is_used and all(path.is_file() for path in paths)):
        return build()
    with watch.stage("read"):
        key = content_key(paths, cloud_settings)
    return cached_map(cache.folder, key, build, watch)


def prepared_map_among(paths: Sequence[Path]) -> Path | None:
    """The first of some files that is a prepared map."""
    return next((path for path in paths if path.is_file() and is_map_file(path)), None)


def content_key(paths: Sequence[Path], settings: CloudSettings) -> str:
    """Name for the map of a cloud's files: by what is in them and the settings, wherever they lie."""
    digests = sorted(_file_digest(path) for path in paths)
    digest = hashlib.sha256(" ".join([FORMAT, sources_digest(), repr(settings), *digests]).encode())
    return digest.hexdigest()[:32]


@cache
def sources_digest() -> str:
    """Digest of the sources by which a map is made."""
    digest = hashlib.sha256()
    for folder in MAKERS:
        for path in sorted((Path(__file__).parents[1] / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def cached_map(folder: Path | None, key: str, build: Callable[[], ScanMap], watch: Stopwatch) -> ScanMap:
    """The map named `key` of a cache folder, or built and put there; the user's cache if `folder` is None.

    Two processes may build one map at once: each writes its own file whole, the last stays, both are equal.
    """
    folder = folder or cache_root() / "maps"
    path = folder / f"{key}.piccolo-map"
    if path.exists():
        try:
            with watch.stage("read"):
                scan_map = load_map(path)
        except InputError:
            path.unlink(missing_ok=True)
        else:
            mark_used(path)
            return scan_map
    scan_map = build()
    if scan_map.is_partial:
        return scan_map
    with watch.stage("prepare"):
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale(folder, NAME)
        save_map(scan_map, path)
    return scan_map


def open_points(paths: Sequence[Path], settings: CloudSettings, workers: Workers) -> LocalCloud:
    """All points of a cloud's files, or the voxels of the prepared map that stands in place of them."""
    if prepared_map_among(paths):
        m = open_map(paths, settings, CachePolicy(is_used=False), workers, Stopwatch())
        return LocalCloud(m.points, m.R_map_from_world, m.origin_world, m.warnings)
    cloud = open_cloud(paths, settings, workers.show).read()
    R_local_from_world = R_z_from_axis(settings.up)
    points = rotate_points(cloud.points.astype(np.float64), R_local_from_world).astype(np.float32)
    packed = pack_points(points, cloud.colors)
    return LocalCloud(packed, R_local_from_world, cloud.origin_world, cloud.warnings)
