"""A report in one call: what `piccolo.write_report` is."""

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

from ..cloud.settings import METRES, CloudSettings, UpAxis
from ..errors import InputError
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import ProgressCallback, Workers, no_progress, num_cores, progress_to
from ..scan import File, Scan
from ..scan_map.open_map import CachePolicy, open_map
from ..scan_map.scan_map import ScanMap
from .build import WIDTH, ReportSettings, build_report
from .entries import read_entries
from .own_plan import OwnPlan


def write_report(  # noqa: PLR0913  options by name
    results: File | Sequence[File],
    scan: File | Sequence[File] | Scan,
    out: File,
    *,
    title: str = "",
    storeys: Sequence[str] = (),
    images: File | None = None,
    full_size: bool = False,
    self_contained: bool = False,
    own_plans: Mapping[int, tuple[File, File]] | None = None,
    crs: str = "",
    force: bool = False,
    units: str = "m",
    up: UpAxis = "auto",
    cache: bool | File = True,
    num_threads: int | None = None,
    progress: ProgressCallback | None = None,
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
    title
        Of the page; by default the scan's name.
    storeys
        Names, the lowest first.
    images
        Folder of the photos, where they are no more at the results' paths.
    full_size
        Spheres as wide as the photos, in place of 2048 px at most.
    self_contained
        `out` is one HTML file, of at most 50 photos.
    own_plans
        By storey, 1 the lowest: an image, and a CSV of control points.
    crs
        The scan's coordinate system, if it does not name it.
    force
        Show results of another scan too; the page says so.
    units, up, cache, num_threads, progress
        As in `open_scan`; the first three only for files.

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
    show = progress_to(progress) if progress else no_progress
    workers = Workers(num_cores() if num_threads is None else num_threads, show)
    settings = ReportSettings(
        title=title,
        storey_names=tuple(storeys),
        images=None if images is None else Path(images),
        width=None if full_size else WIDTH,
        is_self_contained=self_contained,
        own_plans=tuple(OwnPlan(k, Path(image), Path(csv)) for k, (image, csv) in (own_plans or {}).items()),
        crs=crs,
        is_forced=force,
    )
    if isinstance(scan, Scan):
        scan_map = scan.prepared
    else:
        if units not in METRES:
            raise InputError(f"units: found {units!r}, wanted one of {', '.join(METRES)}")
        policy = CachePolicy(cache is not False, None if isinstance(cache, bool) else Path(cache))
        scan_map = open_map(_paths(scan), CloudSettings(METRES[units], up), policy, workers, Stopwatch())
    if not isinstance(scan_map, ScanMap):
        raise InputError("write_report: found a scan of the preset paper, wanted one of the default method")
    return build_report(read_entries(_paths(results)), scan_map, Path(out), settings, workers).page


def _paths(files: File | Sequence[File]) -> list[Path]:
    return [Path(files)] if isinstance(files, str | PathLike) else [Path(file) for file in files]
