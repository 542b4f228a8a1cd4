"""localize.py --color-scan: photos colour a scan, and are localized again by the colours of the others."""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ..batch.inputs import is_from_stdin
from ..batch.localizer import Localizer
from ..batch.results_file import write_results
from ..coloring.color_scan import LEAST_PHOTOS, PAINTED, check_suffix, localize_by_colors, write_colored_scan
from ..confidence.confidence import LOCALIZED
from ..localization.settings import CoarseToFineSettings
from ..opened_scan import OpenedScan
from ..result import Result
from ..scan_map.scan_map import ScanMap
from .bundle import check_new_results
from .command import check_alone
from .errors import UsageError, print_error, print_note
from .executing import EXIT_SOME_NOT, choose_exit_code

NOT_WITH = ("walk", "video", "relative", "jobs", "dask", "overlay", "occlusion_mask", "labels")


def check_coloring_options(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go with --color-scan."""
    if not arguments.color_scan:
        return
    check_alone(arguments, "--color-scan", NOT_WITH)
    if is_from_stdin(arguments.pano):
        raise UsageError("--color-scan: found names on stdin, wanted files or folders")
    check_suffix(arguments.color_scan)
    check_new_results(arguments)


def run_coloring(
    arguments: argparse.Namespace,
    photos: Sequence[Path],
    localizer: Localizer,
    open_scan: Callable[[], OpenedScan],
    print_result: Callable[[Result, Sequence[str]], None],
) -> int:
    """Localize the photos, write the results, then the scan in their colours; return the exit code.

    If too few are localized to colour the scan, the results alone are written, and the code is not 0.
    """
    if not isinstance(localizer.settings, CoarseToFineSettings):
        raise UsageError("--color-scan: not an option of the preset paper")
    scan = open_scan()
    assert isinstance(scan.prepared, ScanMap)

    def localize(scan_map: ScanMap, k: int) -> Result:
        return localizer.answer(replace(scan, prepared=scan_map), localizer.task(photos[k])).result

    order = scan.workers.show(iter(range(len(photos))), len(photos), "photos")
    by_shape = [localize(scan.prepared, k) for k in order]
    results = localize_by_colors(scan.prepared, by_shape, localize, scan.workers)
    write_results(arguments.out, results)
    of_scan = {*scan.warnings, PAINTED}
    for result in results:
        print_result(result, [warning for warning in result.warnings if warning not in of_scan])
    counts = Counter(result.status for result in results)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    code = choose_exit_code(counts)
    if counts[LOCALIZED] < LEAST_PHOTOS:
        why = f"{arguments.color_scan} is not written: wanted {LEAST_PHOTOS} localized photos or more"
        return print_error(arguments, f"{len(results)} photos: {words}; {why}", code or EXIT_SOME_NOT)
    colored = write_colored_scan(scan, results, arguments.color_scan)
    part = f"{100.0 * colored.num_colored / max(colored.num_points, 1):.0f} % of the points coloured"
    print_note(arguments, f"{len(results)} photos: {words}; {part}")
    return code
