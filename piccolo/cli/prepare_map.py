"""Prepare a cloud once: the map file that localize.py takes in place of the cloud."""

import argparse
import json
from pathlib import Path

from ..coarse_to_fine.map_file import save_map
from ..pipeline import CachePolicy, open_map
from ..runtime.atomic import check_output
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers, num_cores
from .errors import guarded
from .options import add_cloud_options, cloud_settings_from, parse
from .progress import shown, warned

EPILOG = """\
example:
  python tools/prepare_map.py --cloud scan.ply --out scan.map
  python localize.py --cloud scan.map --pano query.jpg

localize.py prepares and caches a map by itself; this tool is for maps that are copied, or made beforehand.
One JSON object on stdout says what was made.
exit codes: 0 done, 2 wrong usage, 3 bad input, 4 internal error, 130 interrupted.
"""


def prepare(arguments: argparse.Namespace) -> dict[str, object]:
    """Build and write the map; returns what was made."""
    check_output(arguments.out, arguments.cloud)

    watch = Stopwatch()
    workers = Workers(num_cores(), shown(arguments.quiet), warned(arguments.quiet))
    cloud_settings = cloud_settings_from(arguments)
    scan_map = open_map(arguments.cloud, cloud_settings, CachePolicy(is_used=False), workers, watch)
    save_map(scan_map, arguments.out)
    return {
        "map": str(arguments.out),
        "points": len(scan_map.points),
        "candidates": len(scan_map.centers),
        "seconds": {stage: round(seconds, 3) for stage, seconds in watch.seconds.items()},
        "warnings": list(scan_map.warnings),
    }


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_cloud_options(parser, "coloured scan, as for localize.py")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the map")
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    arguments = parse(parser, argv)

    def run() -> int:
        print(json.dumps(prepare(arguments)))
        return 0

    return guarded("prepare_map.py", arguments.debug, run)
