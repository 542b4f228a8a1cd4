"""Prepare a cloud once: the map file that localize.py takes in place of the cloud."""

import argparse
import json
from pathlib import Path

from ..coarse_to_fine.map_file import save_map
from ..coarse_to_fine.open_map import CachePolicy, open_map
from ..runtime.atomic import check_output
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers, num_cores
from .errors import checking_options, run_command
from .options import add_cloud_options, cloud_settings_from
from .parser import add_run_options, new_parser
from .progress import progress_bar, warn_once

EPILOG = """\
example:
  python tools/prepare_map.py --cloud scan.ply --out scan.map
  python localize.py --cloud scan.map --pano query.jpg

localize.py prepares and caches a map by itself; this tool is for maps that are copied, or made beforehand.
One JSON object on stdout describes the map.
"""


def run(arguments: argparse.Namespace) -> int:
    """Build and write the map; returns the exit code."""
    with checking_options():
        cloud_settings = cloud_settings_from(arguments)
    check_output(arguments.out, arguments.cloud)
    watch = Stopwatch()
    workers = Workers(num_cores(), progress_bar(arguments.quiet), warn_once(arguments.quiet))
    scan_map = open_map(arguments.cloud, cloud_settings, CachePolicy(is_used=False), workers, watch)
    save_map(scan_map, arguments.out)
    report = {
        "map": str(arguments.out),
        "points": len(scan_map.points),
        "candidates": len(scan_map.centers),
        "seconds": {stage: round(seconds, 3) for stage, seconds in watch.seconds.items()},
        "warnings": list(scan_map.warnings),
    }
    print(json.dumps(report))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = new_parser("prepare_map", __doc__, EPILOG)
    add_cloud_options(parser, "coloured scan, as for localize.py")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the map")
    add_run_options(parser)
    return run_command(parser, argv, run)
