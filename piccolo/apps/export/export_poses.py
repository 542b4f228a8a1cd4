"""Write the poses of localize.py for other tools: COLMAP, nerfstudio, OpenSfM, trajectories, maps."""

from argparse import ArgumentParser
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...api.result_files import check_scan, digest_of_scan, read_results
from ...api.values import Result
from ...cli.command import Arguments, check_distinct, checking_options, command, option
from ...geometry.pose import CAMERA_AXES
from ...system.errors import InputError
from .faces import FACES
from .formats import FORMATS, export
from .posed_images import Options, SelectedResults, offset_file, select_results
from .reconstructions import points_file
from .scan_points import open_scan_of

_FORMATS = "\n".join(f"  {form.name:<11} {form.description}" for form in FORMATS.values())
EPILOG = f"""\
formats:
{_FORMATS}

examples:
  python tools/export_poses.py --results poses.jsonl --format colmap --images photos --out model
  python tools/export_poses.py --results poses.jsonl --format colmap --points 200000 --faces 6 --out splat
  python tools/export_poses.py --results poses.jsonl --format colmap --into sparse/0 --out sparse/1
  python tools/export_poses.py --results poses.jsonl --format geojson --crs EPSG:25832 --out poses.geojson

Results that are not localized are left out and counted on stderr, and so are pictures that a format can't
hold: for example with a blank in the name (colmap), or a sphere stored rotated (nerfstudio). --faces writes a
folder: images, masks if anything is masked (black is ignored), and sparse/0 or transforms.json; photos are
copied into it.
In csv, a path that a spreadsheet would take for a formula gets a leading apostrophe. Axes and angles:
docs/CONVENTIONS.md. A file at --out is replaced; - is stdout. Prints one JSON object to stdout (to stderr if
the poses go there).
"""
EXIT_LEFT_OUT = 1
EXIT_CODES = "0 done, 1 pictures that the format can't hold were left out"
# options that only some formats take
OPTIONS = ("size", "offset", "axes", "timestamps", "crs", "points", "faces", "into")


def add_arguments(parser: ArgumentParser) -> None:
    """All options. One that is not given stays None, and keeps its default."""
    option(parser, "--results FILE ...", "results of localize.py, JSON lines", required=True)
    option(parser, "--format", "format of the poses, see below", choices=FORMATS, required=True)
    option(
        parser, "--out FILE", "file of the poses; for colmap, gpano and --faces a new folder", required=True
    )
    option(parser, "--images FOLDER", "write picture names relative to this folder (default: as in results)")
    option(parser, "--all", "also write poses that are ambiguous or not localized")
    option(parser, "--cloud PATH ...", "only results of these clouds", default=[])
    option(parser, "--force", "also take results of clouds with other contents than --cloud")
    group = parser.add_argument_group("options of some formats")
    option(group, "--size W H", f"size of all pictures, which are then not opened ({_takers('size')})")
    text = f"subtract this from positions, and write it to a file next to --out ({_takers('offset')})"
    option(group, "--offset X Y Z", text)
    text = "camera axes: optical (default): right, down, forward; piccolo: forward, left, up"
    option(group, "--axes", f"{text} ({_takers('axes')})", choices=CAMERA_AXES)
    text = "index (default): 0, 1, ...; name: the number that is the picture's name; walk: the frames' times"
    option(group, "--timestamps", f"{text} ({_takers('timestamps')})", choices=["index", "name", "walk"])
    option(group, "--crs EPSG", f"coordinate system of the cloud, such as EPSG:25832 ({_takers('crs')})")
    text = f"also write N points of the scan that the pictures show, at most ({_takers('points')})"
    option(group, "--points N", text)
    text = "write pinhole pictures of spheres: 6 as of a cube, 8 around the horizon, 14 also at "
    option(group, "--faces N", f"{text}the cube's corners ({_takers('faces')})", choices=FACES)
    text = "folder of a model in the scan's coordinates, of which --out is a copy with the pictures added"
    option(group, "--into FOLDER", f"{text} ({_takers('into')})")


def _takers(option: str) -> str:
    return ", ".join(form.name for form in FORMATS.values() if option in form.options)


def options_from(arguments: Arguments) -> Options:
    """Return the options given; one that the format does not take is refused."""
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    form = FORMATS[arguments.format]
    if foreign := [name for name in OPTIONS if name in given and name not in form.options]:
        raise InputError(f"--{foreign[0]}: not an option of the format {arguments.format}")
    if "crs" in form.options and "crs" not in given:
        raise InputError("--crs: not given, wanted the cloud's coordinate system, such as EPSG:25832")
    own: dict[str, Any] = {name: given[name] for name in ("images", *OPTIONS) if name in given}
    own |= {name: tuple(own[name]) for name in ("size", "offset") if name in own}
    return Options(**own)


def notes_on(selection: SelectedResults) -> Iterable[str]:
    """Yield notes for the user: what was left out, and what may be mixed up."""
    if selection.left_out:
        num_left_out = sum(selection.left_out.values())
        reasons = ", ".join(f"{count} {reason}" for reason, count in selection.left_out.items())
        yield f"left out {num_left_out} of {num_left_out + len(selection.results)} results: {reasons}"
    if (num_clouds := len(selection.clouds)) > 1:
        yield f"poses in {num_clouds} clouds are assumed to be in one coordinate system; --cloud selects"


def check_content(arguments: Arguments, results: Sequence[Result]) -> Iterable[str]:
    """Yield notes on results of other clouds than those chosen; without --force they are refused."""
    for cloud in dict.fromkeys(result.cloud for result in results if result.cloud_name in arguments.cloud):
        paths = [Path(path) for path in ([cloud] if isinstance(cloud, str) else cloud)]
        if all(path.is_file() for path in paths):
            own = [result for result in results if result.cloud == cloud]
            digest = digest_of_scan(paths)
            if note := check_scan(own, digest, own[0].cloud_name, arguments.force):
                yield note


@command(__file__, __doc__, EPILOG, add_arguments, EXIT_CODES)
def main(arguments: Arguments) -> int:
    """Read, choose, write; returns the exit code."""
    with checking_options():
        options = options_from(arguments)
    results = read_results(arguments.results)
    beside = offset_file(arguments.out) if options.offset else None
    points = points_file(arguments.out) if options.points and arguments.format == "nerfstudio" else None
    outputs = {"--out": arguments.out, "the offset": beside, "the points": points}
    files = {Path(name) for result in results for name in (result.pano, result.cloud_name)}
    check_distinct(outputs, [*arguments.results, *files])
    selection = select_results(results, arguments.cloud, arguments.all)
    for note in (*notes_on(selection), *check_content(arguments, selection.results)):
        arguments.note(note)
    if options.points is not None:
        options = replace(options, scan=open_scan_of(selection.results, arguments.workers()))
    left_out = export(selection.results, arguments.format, arguments.out, options)
    counts = {reason: len(names) for reason, names in left_out.items()}
    for reason, names in left_out.items():
        arguments.note(f"left out {len(names)}, the first {names[0]}: {reason}")
    num_poses = len(selection.results) - sum(counts.values())
    report = {"out": str(arguments.out), "format": arguments.format, "poses": num_poses}
    arguments.report(outputs, {**report, "left_out": {**selection.left_out, **counts}})
    return EXIT_LEFT_OUT if left_out else 0
