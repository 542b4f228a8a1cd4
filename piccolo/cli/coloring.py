"""localize.py --color-scan: photos colour a scan, and are localized again by the colours of the others."""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ..batch.inputs import is_from_stdin
from ..batch.localizer import Localizer
from ..batch.results_file import write_results
from ..coloring.color_scan import LEAST_PHOTOS, check_suffix, color_map, write_colored_scan
from ..confidence.confidence import LOCALIZED
from ..localization.settings import CoarseToFineSettings
from ..opened_scan import OpenedScan
from ..result import Result
from ..scan_map.scan_map import ScanMap
from .bundle import check_new_results
from .command import check_alone
from .errors import UsageError, print_note
from .executing import choose_exit_code
from .progress import progress_bar

NUM_ROUNDS = 2  # in which photos are localized by the colours of the round before
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
    """Localize the photos, write the scan in their colours, then the results; return the exit code.

    If too few are localized to colour the scan, the results alone are written.
    """
    if not isinstance(localizer.settings, CoarseToFineSettings):
        raise UsageError("--color-scan: not an option of the preset paper")
    show = progress_bar(arguments.quiet)
    scan = open_scan()

    def localize_all() -> list[Result]:
        shown = show(iter(photos), len(photos), "photos")
        return [localizer.answer(scan, localizer.task(photo)).result for photo in shown]

    results = localize_all()
    counts = Counter(result.status for result in results)
    note = f"{arguments.color_scan} is not written: wanted {LEAST_PHOTOS} localized photos or more"
    if counts[LOCALIZED] >= LEAST_PHOTOS:
        for _ in range(NUM_ROUNDS):
            assert isinstance(scan.prepared, ScanMap)
            scan = replace(scan, prepared=color_map(scan.prepared, results, scan.workers))
            results = localize_all()
        colored = write_colored_scan(scan, results, arguments.color_scan)
        counts = Counter(result.status for result in results)
        note = f"{100.0 * colored.num_colored / max(colored.num_points, 1):.0f} % of the points coloured"
    write_results(arguments.out, results)
    for result in results:
        print_result(result, result.warnings[len(scan.warnings) :])
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    print_note(arguments, f"{len(results)} photos: {words}; {note}")
    return choose_exit_code(counts)
