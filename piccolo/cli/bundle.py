"""localize.py --relative: photos with known poses relative to each other, localized as one camera."""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from ..batch.localizer import Localizer
from ..batch.relative_poses import find_scale, read_relative_poses
from ..batch.results_file import WAYS, write_results
from ..files.atomic import is_stream
from ..jobs.stopwatch import Stopwatch
from ..localization.settings import CoarseToFineSettings
from ..opened_scan import OpenedScan
from ..result import Result
from .command import check_alone
from .errors import UsageError, print_note
from .executing import choose_exit_code

NOT_WITH = ("walk", "video", "jobs", "dask", "overlay", "occlusion_mask", "priors", "refine_focal")


def check_bundle_options(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go with --relative."""
    if arguments.relative:
        check_alone(arguments, "--relative", NOT_WITH)


def check_new_results(arguments: argparse.Namespace) -> None:
    """Refuse a file of --out that has results, without --overwrite: all are written at once."""
    out = arguments.out
    if out and not is_stream(out) and out.exists() and out.stat().st_size and not arguments.overwrite:
        raise UsageError(f"--out: {out} has results already; {WAYS}")


def run_bundle(
    arguments: argparse.Namespace,
    photos: Sequence[Path],
    localizer: Localizer,
    open_scan: Callable[[], OpenedScan],
    print_result: Callable[[Result, Sequence[str]], None],
) -> int:
    """Localize the photos together, write their results at once, return the exit code."""
    if not isinstance(localizer.settings, CoarseToFineSettings):
        raise UsageError("--relative: not an option of the preset paper")
    check_new_results(arguments)
    poses = read_relative_poses(arguments.relative, photos)
    watch = Stopwatch()
    with watch.stage("all"):
        scan = open_scan()
        scale = find_scale(arguments.relative)
        given = [localizer.ask(path)[0] for path in photos]
        results = scan.localize_bundle(given, poses, localizer.settings, scale)
    write_results(arguments.out, results)
    for result in results:
        print_result(result, result.warnings[len(scan.warnings) :])
    counts = Counter(result.status for result in results)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    print_note(arguments, f"{len(results)} photos together in {watch.seconds['all']:.0f} s: {words}")
    return choose_exit_code(counts)
