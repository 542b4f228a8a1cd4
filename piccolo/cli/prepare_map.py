"""Prepare the map of a cloud: a file that localize.py takes instead of the cloud."""

from argparse import ArgumentParser

from ..scan_map.open_map import CachePolicy, extend_map, open_map, write_map
from ..scan_map.scan_map import check_name, name_scan
from ..system.jobs.threads import Stopwatch
from .command import Arguments, check_outputs, checking_options, command, option
from .options import add_cloud_options
from .settings_given import cloud_settings_from

EPILOG = """\
example:
  python tools/prepare_map.py --cloud scan.ply --out scan.map
  python localize.py --cloud scan.map --pano query.jpg
  python tools/prepare_map.py --cloud 1.ply --name "Storey 1" --out house.map
  python tools/prepare_map.py --add house.map --cloud 2.e57 --name "Storey 2" --out house.map
  python localize.py --cloud house.map --pano query.jpg --within "Storey 2"

localize.py prepares and caches maps by itself; use this tool to keep a map as a file, or to make it earlier.
Prints one JSON object that describes the map to stdout.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan as for localize.py")
    text = "add the scan to this map with the same coordinate system; only changed parts are prepared again"
    option(parser, "--add FILE", text)
    text = "name of the scan (building, storey, room), for results and --within (default: the file's name)"
    option(parser, "--name NAME", text)
    option(parser, "--out FILE", "file of the map; - is stdout", required=True)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Build and write the map; returns the exit code."""
    with checking_options():
        cloud_settings = cloud_settings_from(arguments)
    outputs = {"--out": arguments.out}
    check_outputs(outputs, arguments.cloud)
    name = arguments.cloud[0].stem if arguments.name is None else arguments.name
    check_name(name, ())
    watch = Stopwatch()
    workers = arguments.workers()
    if arguments.add:
        scan_map = extend_map(arguments.add, arguments.cloud, cloud_settings, name, workers, watch)
    else:
        no_cache = CachePolicy(is_used=False)
        scan_map = open_map(arguments.cloud, cloud_settings, no_cache, workers, watch)
        if arguments.name is not None or not scan_map.scan_names:  # a map keeps its names
            scan_map = name_scan(scan_map, name)
    write_map(scan_map, arguments.out)
    report = {
        "map": str(arguments.out),
        "scans": scan_map.scan_names,
        "points": len(scan_map.points),
        "candidates": len(scan_map.centers),
        "seconds": {stage: round(seconds, 3) for stage, seconds in watch.seconds.items()},
        "warnings": list(scan_map.warnings),
    }
    arguments.report(outputs, report)
    return 0
