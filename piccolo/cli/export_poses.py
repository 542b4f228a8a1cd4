"""Write the poses of localize.py as files of other tools: COLMAP, nerfstudio, OpenSfM, trajectories, maps."""

import argparse
import json
from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError
from ..geometry.camera_axes import CAMERA_AXES
from ..result import read_results
from ..runtime.atomic import check_output
from ..scenes.export import FORMATS, Options, Selection, export, select, true_results
from ..scenes.scene import find_scenes
from .errors import checking_options, print_note, run_command
from .parser import add_run_options, new_parser

EPILOG = """\
formats:
{formats}

examples:
  python localize.py --cloud scan.ply --pano photos/*.jpg --out poses.jsonl
  python tools/export_poses.py --results poses.jsonl --format colmap --images photos --out model
  python tools/export_poses.py --results poses.jsonl --format nerfstudio --images . --out transforms.json
  python tools/export_poses.py --results poses.jsonl --format tum --timestamps name --out poses.tum
  python tools/export_poses.py --results poses.jsonl --format geojson --crs EPSG:25832 --out poses.geojson
  python tools/export_poses.py --scenes room --format tum --out reference.tum
  python tools/export_poses.py --results *.jsonl --format gpano --images photos --out photos_with_pose

Results that are not localized are left out and counted on stderr. docs/CONVENTIONS.md has axes and angles.
A file at --out is replaced. One JSON object on stdout.
"""
OPTIONS = ("size", "offset", "axes", "timestamps", "crs")  # those that only some formats take


def build_parser() -> argparse.ArgumentParser:
    """All options. One that is not given stays None, and keeps its default."""
    formats = "\n".join(f"  {form.name:<11} {form.description}" for form in FORMATS.values())
    parser = new_parser("export_poses", __doc__, EPILOG.format(formats=formats))
    source = parser.add_mutually_exclusive_group(required=True)
    text = "JSON lines of localize.py"
    source.add_argument("--results", type=Path, default=[], nargs="+", metavar="FILE", help=text)
    text = "scenes whose true poses are written, as a reference for other tools (docs/DATASETS.md)"
    source.add_argument("--scenes", type=Path, default=[], nargs="+", metavar="FOLDER", help=text)
    parser.add_argument("--format", choices=FORMATS, required=True, help="see below")
    parser.add_argument("--out", type=Path, required=True, help="file, or new folder for colmap and gpano")
    text = "folder to which the pictures' names are written relative (default: as in the results)"
    parser.add_argument("--images", type=Path, metavar="FOLDER", help=text)
    parser.add_argument("--all", action="store_true", help="write ambiguous and not localized poses too")
    parser.add_argument("--cloud", nargs="+", default=[], metavar="PATH", help="only results of these clouds")
    group = parser.add_argument_group("of some formats")
    text = f"width and height of all pictures, not read from each ({_takers('size')})"
    group.add_argument("--size", type=int, nargs=2, metavar=("W", "H"), help=text)
    text = f"subtract this from the positions, and write it beside them ({_takers('offset')})"
    group.add_argument("--offset", type=float, nargs=3, metavar=("X", "Y", "Z"), help=text)
    text = "optical (default): right, down, forward; piccolo: forward, left, up"
    group.add_argument("--axes", choices=CAMERA_AXES, help=f"{text} ({_takers('axes')})")
    text = "index (default): 0, 1, ...; name: the number that is the picture's name"
    group.add_argument("--timestamps", choices=["index", "name"], help=f"{text} ({_takers('timestamps')})")
    text = f"of the cloud's coordinates, such as EPSG:25832 ({_takers('crs')})"
    group.add_argument("--crs", help=text)
    add_run_options(parser)
    return parser


def _takers(option: str) -> str:
    return ", ".join(form.name for form in FORMATS.values() if option in form.options)


def options_from(arguments: argparse.Namespace) -> Options:
    """The options given; one that the format does not take is refused."""
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    form = FORMATS[arguments.format]
    if foreign := [name for name in OPTIONS if name in given and name not in form.options]:
        raise InputError(f"--{foreign[0]}: not an option of the format {arguments.format}")
    if "crs" in form.options and "crs" not in given:
        raise InputError("--crs: not given, wanted the cloud's coordinate system, such as EPSG:25832")
    return Options(
        images=arguments.images,
        size=tuple(arguments.size) if arguments.size else None,
        offset=tuple(arguments.offset) if arguments.offset else None,
        axes=given.get("axes", Options.axes),
        timestamps=given.get("timestamps", Options.timestamps),
        crs=arguments.crs,
    )


def notes_on(selection: Selection) -> Iterable[str]:
    """Notes for the user: what was left out, and what may be mixed up."""
    if selection.left_out:
        num_left_out = sum(selection.left_out.values())
        reasons = ", ".join(f"{count} {reason}" for reason, count in selection.left_out.items())
        yield f"left out {num_left_out} of {num_left_out + len(selection.results)} results: {reasons}"
    if len(selection.clouds) > 1:
        num_clouds = len(selection.clouds)
        yield f"poses in {num_clouds} clouds are taken as in one coordinate system; --cloud chooses"


def run(arguments: argparse.Namespace) -> int:
    """Read, choose, write; returns the exit code."""
    with checking_options():
        options = options_from(arguments)
    results = read_results(arguments.results)
    if arguments.scenes:
        results = [result for scene in find_scenes(arguments.scenes) for result in true_results(scene)]
    if not FORMATS[arguments.format].is_folder:
        check_output(arguments.out, arguments.results)
    selection = select(results, arguments.cloud, arguments.all)
    for note in notes_on(selection):
        print_note(arguments, note)
    export(selection.results, arguments.format, arguments.out, options)
    report = {"out": str(arguments.out), "format": arguments.format, "poses": len(selection.results)}
    print(json.dumps({**report, "left_out": selection.left_out}))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
