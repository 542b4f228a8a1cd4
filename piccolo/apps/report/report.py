"""Write a web page of results: plans of the storeys, photos as spheres, the scan seen from their poses."""

from argparse import ArgumentParser
from collections import Counter
from dataclasses import fields
from pathlib import Path

from ...cli.command import (
    Arguments,
    UsageError,
    check_distinct,
    check_suffix,
    checking_options,
    command,
    option,
)
from ...cli.options import CACHE_TEXT, add_cloud_options
from ...cli.settings_given import cache_from, cloud_settings_from
from ...scan_map.open_map import open_map
from ...system.errors import InputError, import_optional
from ...system.files.atomic import check_output
from ...system.jobs.threads import Stopwatch, num_cores
from .build import WIDTH, ReportSettings, build_report
from .plan_file import DXF, SUFFIXES, write_plan_file
from .site import check_folder, collect_entries

EPILOG = """\
examples:
  python tools/report.py --results poses.jsonl --cloud scan.ply --out report
  python tools/report.py --results monday.jsonl tuesday.jsonl --cloud house.map --out report \\
      --title "12 High Street" --storeys Cellar "Ground floor" "First floor"
  python tools/report.py --results poses.jsonl --cloud scan.ply --out report.html --self-contained
  python tools/report.py --results poses.jsonl --cloud scan.ply --plan plan.dxf

FOLDER/index.html opens from disk in any browser, without a server or internet access. A repeated command
continues where it was stopped and writes only changed parts. --plan writes plans that need no browser.
Control points of --own-plan: a CSV file with the columns u, v (pixels of the image) and x, y (metres, in the
scan's coordinates), and two rows or more. Prints one JSON object to stdout.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    option(parser, "--results FILE ...", "results of localize.py, JSON lines", required=True)
    add_cloud_options(parser, "coloured scan as for localize.py, or a map of tools/prepare_map.py")
    option(parser, "--out FOLDER", "folder of the report: new, empty, or an earlier report")
    option(parser, "--self-contained", "write one HTML file to --out; at most 50 photos")
    option(parser, "--title TEXT", "title of the page (default: the scan's name)")
    option(parser, "--storeys NAME ...", "names of the storeys, the lowest first", default=[])
    option(parser, "--images FOLDER", "folder of the photos, if they have been moved since")
    option(parser, "--full-size", f"keep the size of the photos (default: at most {WIDTH} px wide)")
    text = "show this image as the plan of storey K (1: the lowest); control points in CSV, see below"
    option(parser, "--own-plan K IMAGE CSV", text, type=str, nargs=3, action="append", default=[])
    option(parser, "--crs EPSG", "coordinate system of a scan that names none, for the north arrow")
    option(parser, "--plan FILE", "write camera positions and walks on the plans: .png, .svg, .pdf or .dxf")
    option(parser, "--force", "show results of another scan too, with a note on the page")
    option(parser, "--jobs N", "photos that are processed at the same time", default=num_cores())
    option(parser, "--cache FOLDER", CACHE_TEXT)


def report_settings_from(arguments: Arguments) -> ReportSettings:
    """Return what the options ask for; those that make no sense are refused."""
    arguments.check_least(jobs=1)
    if not (arguments.out or arguments.plan):
        raise UsageError("--out, --plan: found none of them, wanted one or both")
    check_suffix("--plan", arguments.plan, SUFFIXES)
    if arguments.self_contained:
        check_suffix("--out", arguments.out, (".html", ".htm"))
    for number, *_ in arguments.own_plan:
        if not number.isdecimal():
            raise UsageError(f"--own-plan: found storey {number!r}, wanted a number, 1 for the lowest")
    own_plans = {int(k): (image, csv) for k, image, csv in arguments.own_plan}
    names = {f.name for f in fields(ReportSettings)}
    given = {name: value for name, value in vars(arguments).items() if name in names and value is not None}
    return ReportSettings(own_plans=own_plans, **given)


def check_report_files(arguments: Arguments) -> None:
    """Refuse, before any work, what could not be written, or would replace an input."""
    own = [Path(name) for _, *names in arguments.own_plan for name in names]
    inputs = [*arguments.results, *arguments.cloud, *own]
    check_distinct({"--out": arguments.out, "--plan": arguments.plan}, inputs)
    if arguments.plan:
        check_output(arguments.plan)
        import_optional("--plan", "ezdxf" if arguments.plan.suffix.lower() == DXF else "matplotlib", "plans")
    if arguments.out:
        (check_output if arguments.self_contained else check_folder)(arguments.out)
    if arguments.images and not arguments.images.is_dir():
        raise InputError(f"{arguments.images}: found no folder, wanted that of the photos")


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, draw, write; returns the exit code."""
    with checking_options():
        settings = report_settings_from(arguments)
        cloud_settings = cloud_settings_from(arguments)
    check_report_files(arguments)
    entries = collect_entries(arguments.results)
    workers = arguments.workers(arguments.jobs)
    cache = cache_from(arguments)
    scan_map = open_map(arguments.cloud, cloud_settings, cache, workers, Stopwatch())
    line: dict[str, object] = {"photos": len(entries)}
    if arguments.plan:
        line["plan"] = str(arguments.plan)
        line["storeys"] = write_plan_file(entries, scan_map, arguments.plan, settings)
    if arguments.out:
        report = build_report(entries, scan_map, arguments.out, settings, workers)
        arguments.warn(report.warnings)
        line["out"] = str(arguments.out)
        line["url"] = report.page.resolve().as_uri()
        line["storeys"] = len(report.document["storeys"])
    line |= Counter(entry.result.status for entry in entries)
    arguments.report({"--plan": arguments.plan}, line)
    return 0
