"""Command line: a coloured scan and 360-degree photos in, camera poses out."""

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from ..coarse_to_fine.open_map import CachePolicy
from ..confidence.confidence import LOCALIZED
from ..errors import InputError
from ..panorama import ReadOptions, read_panorama
from ..render.surfel_renderer import overlay_png
from ..result import Result
from ..runtime.atomic import check_output, write_atomically
from ..runtime.kernel_cache import is_first_use, kernel_folder
from ..runtime.threads import Workers
from ..scan import Scan, Settings, open_files
from .errors import EXIT_BAD_INPUT, checking_options, format_error, print_error, run_command
from .options import build_parser, check_arguments, cloud_settings_from, read_options_from, settings_from
from .progress import progress_bar, warn_once

EXIT_ALL_LOCALIZED, EXIT_SOME_NOT = 0, 1


def open_scan(arguments: argparse.Namespace, settings: Settings) -> Scan:
    """Read and prepare the scan, after a look at what is to be written."""
    for output in filter(None, (arguments.out, arguments.overlay)):
        check_output(output, [*arguments.cloud, *arguments.pano])
    if is_first_use() and not arguments.quiet:
        text = f"first use: compiling kernels, once (about a minute), into {kernel_folder()}"
        print(text, file=sys.stderr, flush=True)
    cache = CachePolicy(not arguments.no_cache, arguments.cache)
    workers = Workers(arguments.threads, progress_bar(arguments.quiet), warn_once(arguments.quiet))
    scan = open_files(arguments.cloud, cloud_settings_from(arguments), settings, cache, workers)
    for warning in scan.warnings:  # those of a map prepared earlier; others have been written
        workers.warn(warning)
    return scan


def report(arguments: argparse.Namespace, scan: Scan, result: Result, read_options: ReadOptions) -> None:
    """Write the overlay if one is asked for, and say what was found."""
    if arguments.overlay and result.pose is not None:
        panorama = read_panorama(Path(result.pano), read_options)
        png = overlay_png(scan.points, panorama, scan.from_world(result.pose), scan.workers)
        write_atomically(arguments.overlay, png)
    warnings = [f"warning: {warning}" for warning in result.warnings[len(scan.warnings) :]]
    for line in () if arguments.quiet else (*warnings, result.summary()):
        tqdm.write(line, file=sys.stderr)


def run(arguments: argparse.Namespace) -> int:
    """Localize every panorama, write the results, return the exit code."""
    with checking_options():
        check_arguments(arguments)
        settings, read_options = settings_from(arguments), read_options_from(arguments)
    scan, lines = open_scan(arguments, settings), list[str]()
    is_bad = some_not = False
    hidden = arguments.quiet or len(arguments.pano) == 1
    for pano in tqdm(arguments.pano, desc="panoramas", unit="", disable=hidden, file=sys.stderr):
        try:
            result = scan.localize_query(pano, read_options, settings)
            report(arguments, scan, result, read_options)
        except (OSError, InputError) as error:
            print_error(arguments, format_error(error), EXIT_BAD_INPUT)
            is_bad = True
            continue
        some_not |= result.status != LOCALIZED
        if arguments.out:
            lines.append(result.to_json() + "\n")
        else:
            print(result.to_json(), flush=True)
    if arguments.out and lines:
        write_atomically(arguments.out, "".join(lines).encode())
    if is_bad:
        return EXIT_BAD_INPUT
    return EXIT_SOME_NOT if some_not else EXIT_ALL_LOCALIZED


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
