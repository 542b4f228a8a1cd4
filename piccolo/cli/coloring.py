"""localize.py --color-scan: photos colour a scan, and are localized again by the colours of the others."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ..batch.inputs import is_from_stdin
from ..batch.localizer import Localizer
from ..coloring import color_scan
from ..coloring.color_scan import LEAST_PHOTOS, PAINTED
from ..confidence.confidence import LOCALIZED
from ..files.line_file import Journal
from ..opened_scan import OpenedScan
from ..panorama.photo import sha256_of
from ..result import Result
from ..scan_map.scan_map import ScanMap
from .command import check_alone
from .errors import UsageError
from .together import Job, Report

NOT_WITH = ("walk", "video", "relative", "jobs", "dask", "overlay", "occlusion_mask", "labels")


def check_coloring_options(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go with --color-scan."""
    if not arguments.color_scan:
        return
    check_alone(arguments, "--color-scan", NOT_WITH)
    if is_from_stdin(arguments.pano):
        raise UsageError("--color-scan: found names on stdin, wanted files or folders")
    color_scan.check_suffix(arguments.color_scan)


def make_coloring_job(
    arguments: argparse.Namespace,
    photos: Sequence[Path],
    localizer: Localizer,
    scan: OpenedScan,
    print_result: Callable[[Result, Sequence[str]], None],
) -> Job:
    """Return the job of localizing photos in the colours of the others, and of colouring the scan by them.

    If too few are localized to colour the scan, the results alone are written.
    """
    scan_map = scan.prepared
    assert isinstance(scan_map, ScanMap)
    given = {str(path): localizer.ask(path)[0] for path in photos}
    more = {"colors": "those of the other photos"}

    def localize(shown: ScanMap, k: int) -> Result:
        result = localizer.answer(replace(scan, prepared=shown), localizer.task(photos[k])).result
        return replace(result, settings={**result.settings, **more})

    def run(journal: Journal) -> list[Result]:
        steps = (f"shape: {path} {sha256_of(path, localizer.photo.instant)}" for path in photos)
        by_shape = journal.recall(steps, lambda _, text: Result.from_json(text))
        left = range(len(by_shape), len(photos))
        for k in scan.workers.show(iter(left), len(left), "photos"):
            by_shape.append(localize(scan_map, k))
            path = photos[k]
            color_scan.keep_step(journal, f"shape: {path} {by_shape[k].source.pano_sha256}", by_shape[k])
        return color_scan.localize_by_colors(scan_map, by_shape, localize, scan.workers, journal)

    def report(results: Sequence[Result]) -> Report:
        of_scan = {*scan.warnings, PAINTED}
        for result in results:
            print_result(result, [warning for warning in result.warnings if warning not in of_scan])
        if sum(result.status == LOCALIZED for result in results) < LEAST_PHOTOS:
            why = f"; {arguments.color_scan} is not written: wanted {LEAST_PHOTOS} localized photos or more"
            return Report(why, is_whole=False)
        colored = color_scan.write_colored_scan(scan, results, arguments.color_scan)
        part = 100.0 * colored.num_colored / max(colored.num_points, 1)
        return Report(f"; {part:.0f} % of the points coloured")

    fields = localizer.expect(scan_map.scan_sha256, more)
    return Job("photos", given, fields, run, report, arguments.color_scan)
