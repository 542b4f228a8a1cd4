"""A report in one call: what `piccolo.write_report` is."""

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TypedDict, Unpack

from ..cloud.settings import METRES, CloudSettings, UpAxis
from ..errors import InputError
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import ProgressCallback, Workers, no_progress, num_cores, progress_to
from ..query_options import File, refuse_unknown
from ..scan import Scan
from ..scan_map.open_map import CachePolicy, open_map
from ..scan_map.scan_map import ScanMap
from .build import WIDTH, ReportSettings, build_report
from .entries import read_entries
from .plan_image import OwnPlan


class ReportOptions(TypedDict, total=False):
    """What `write_report` may be told; all may be left out."""

    title: str  # of the page; by default the scan's name
    storeys: Sequence[str]  # names, the lowest first
    images: File  # folder of the photos, where they are no more at the results' paths
    full_size: bool  # spheres as wide as the photos, in place of 2048 px at most
    self_contained: bool  # `out` is one HTML file, of at most 50 photos
    own_plans: Mapping[int, tuple[File, File]]  # by storey, 1 the lowest: an image, CSV of control points
    crs: str  # the scan's coordinate system, if it does not name it
    force: bool  # show results of another scan too; the page says so
    units: str  # of the scan's coordinates, as in `open_scan`; these three only for files
    up: UpAxis
    cache: bool | File
    num_threads: int  # all cores if not given
    progress: ProgressCallback  # is told (what is done, how many are done, of how many or None)


def write_report(
    results: File | Sequence[File],
    scan: File | Sequence[File] | Scan,
    out: File,
    **options: Unpack[ReportOptions],
) -> Path:
    """Write a page that shows results on plans, and each photo over the scan; returns the page's path.

    Parameters
    ----------
    results
        Path of a file of JSON lines by localize.py, or several.
    scan
        Path of the scan, or of a map by tools/prepare_map.py, or several; or a Scan that is open.
    out
        Folder, new, empty or with an earlier report, of which only what has changed is made again.
    **options
        See ReportOptions.

    Raises
    ------
    InputError
        A file can't be read, results are of another scan, the folder holds something else, or an option means
        nothing.

    Examples
    --------
    >>> import piccolo
    >>> scan = piccolo.open_scan("room/cloud.ply")
    >>> result = scan.localize("room/images/clean_0.jpg")
    >>> _ = Path("one.jsonl").write_text(result.to_json())
    >>> piccolo.write_report("one.jsonl", scan, "report", storeys=["Ground floor"])
    PosixPath('report/index.html')
    """
    refuse_unknown(options, ReportOptions, "write_report")
    callback = options.get("progress")
    show = progress_to(callback) if callback else no_progress
    workers = Workers(options.get("num_threads", num_cores()), show)
    own_plans = options.get("own_plans", {})
    settings = ReportSettings(
        title=options.get("title", ""),
        storey_names=tuple(options.get("storeys", ())),
        images=Path(options["images"]) if "images" in options else None,
        width=None if options.get("full_size") else WIDTH,
        is_self_contained=options.get("self_contained", False),
        own_plans=tuple(OwnPlan(k, Path(image), Path(csv)) for k, (image, csv) in own_plans.items()),
        crs=options.get("crs", ""),
        is_forced=options.get("force", False),
    )
    scan_map = scan.prepared if isinstance(scan, Scan) else _map_of(_paths(scan), options, workers)
    if not isinstance(scan_map, ScanMap):
        raise InputError("write_report: found a scan of the preset paper, wanted one of the default method")
    return build_report(read_entries(_paths(results)), scan_map, Path(out), settings, workers).page


def _map_of(paths: Sequence[Path], options: ReportOptions, workers: Workers) -> ScanMap:
    if (units := options.get("units", "m")) not in METRES:
        raise InputError(f"units: found {units!r}, wanted one of {', '.join(METRES)}")
    cache = options.get("cache", True)
    policy = CachePolicy(cache is not False, None if isinstance(cache, bool) else Path(cache))
    cloud_settings = CloudSettings(METRES[units], options.get("up", "auto"))
    return open_map(paths, cloud_settings, policy, workers, Stopwatch())


def _paths(files: File | Sequence[File]) -> list[Path]:
    return [Path(files)] if isinstance(files, str | PathLike) else [Path(file) for file in files]
