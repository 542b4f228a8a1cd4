"""Colour a scan by photos that were localized in it."""

from argparse import ArgumentParser

from ..api.opening import open_files
from ..api.result_files import read_results
from ..api.scan_coloring import check_colored_suffix, write_colored_scan
from ..api.values import CoarseToFineSettings
from ..cli.command import Arguments, check_outputs, checking_options, command, option
from ..cli.options import CACHE_TEXT, add_cloud_options
from ..cli.settings_given import cache_from, cloud_settings_from

EPILOG = """\
examples:
  python tools/color_scan.py --cloud bare.e57 --results poses.jsonl --out colored.e57
  python tools/color_scan.py --cloud old.laz --results poses.jsonl --out colored.laz

The photos are aligned with each other first, on the surfaces of the scan, and their exposures are balanced.
A point gets the weighted median of the photos that see it: by the cosine of the angle to its surface,
divided by the squared distance. Passers-by, whom other photos contradict, give no colour, best where three
photos or more see a place. Points that no photo sees are black. PLY has the number of photos of each
point as the property `photos`, LAS and LAZ as user data. Prints one JSON object to stdout.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    option(parser, "--results FILE ...", "results of localize.py, JSON lines", required=True)
    add_cloud_options(parser, "files of the scan in which the photos were localized")
    option(parser, "--out FILE", "the scan in colours: .ply, .las, .laz or .e57", required=True)
    option(parser, "--cache FOLDER", CACHE_TEXT)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, align, paint, write; returns the exit code."""
    with checking_options():
        settings = cloud_settings_from(arguments)
        check_colored_suffix(arguments.out)
    check_outputs({"--out": arguments.out}, [*arguments.cloud, *arguments.results])
    results = read_results(arguments.results)
    method = CoarseToFineSettings()
    scan = open_files(arguments.cloud, settings, method, cache_from(arguments), arguments.workers())
    arguments.warn(scan.warnings)
    scan_map, _ = scan.require_default_method("colours", method)
    colored = write_colored_scan(arguments.cloud, scan_map, settings, results, arguments.out, scan.workers)
    line = {"out": str(arguments.out), "photos": colored.num_photos, "points": colored.num_points}
    line["colored_points"] = colored.num_colored
    arguments.report({}, line)
    return 0
