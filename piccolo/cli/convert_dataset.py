"""Write research datasets, or your own panoramas with known poses, as scenes that tools/evaluate.py reads."""

import argparse
import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from ..errors import InputError
from ..runtime.threads import Show, Workers, num_cores
from ..scenes.datasets import DATASETS
from ..scenes.datasets.checking import Check, check_scene
from ..scenes.datasets.model import ConvertOptions, SceneSpec
from ..scenes.datasets.poses import AXES, DIRECTIONS
from ..scenes.datasets.writing import Written, write_scene
from ..scenes.scene import read_scene
from .errors import EXIT_BAD_INPUT, UsageError, print_error, print_note, run_command
from .parser import HelpFormatter, add_run_options, new_parser
from .progress import progress_bar

EXIT_BAD_FIT = 1
EPILOG = """\
datasets:
{datasets}

examples:
  python tools/convert_dataset.py stanford2d3ds --from data/stanford --out scenes --areas 1 3 --check 3
  python tools/convert_dataset.py omniscenes --from data/omniscenes --out scenes --rooms weddingHall_1
  python tools/convert_dataset.py generic --from my/photos --out scenes --check 3

Writes OUT/SCENE/cloud.ply, images/ (links to the dataset's own, or copies), labels/ and queries.json. What
they hold, and how each dataset's folders and poses are understood, is in docs/DATASETS.md. A scene that is
there already is left as it is. A scene with a damaged file is left out and named on stderr, and the others go
on. One JSON object a scene on stdout.
"""


def build_parser() -> argparse.ArgumentParser:
    """All options; those that one dataset alone has are in its own subparser."""
    description = "\n".join(f"  {name:<14} {dataset.description}" for name, dataset in DATASETS.items())
    parser = new_parser(
        "convert_dataset",
        __doc__,
        EPILOG.format(datasets=description),
        "0 done, 1 --check found poses that don't fit the panoramas",
    )
    subparsers = parser.add_subparsers(dest="dataset", required=True, metavar="DATASET")
    for name, dataset in DATASETS.items():
        subparser = subparsers.add_parser(
            name, description=dataset.description, formatter_class=HelpFormatter
        )
        add_common_options(subparser)
        if name in OWN_OPTIONS:
            OWN_OPTIONS[name](subparser)
    return parser


def add_common_options(parser: argparse.ArgumentParser) -> None:
    """What every dataset has."""
    parser.add_argument(
        "--from", type=Path, required=True, metavar="FOLDER", dest="folder", help="the dataset"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="made if it is not there")
    text = "only these, by the last part of a scene's name: office_1, weddingHall_1, a house"
    parser.add_argument("--rooms", nargs="+", default=[], metavar="NAME", help=text)
    text = "compare N panoramas of each scene with its cloud, also of those there already (default 0)"
    parser.add_argument("--check", type=int, default=0, metavar="N", help=text)
    images = parser.add_mutually_exclusive_group()
    text = "link to the panoramas where they are (default: a copy can take 100 GB)"
    images.add_argument("--link", action="store_const", const="symlink", dest="transfer", help=text)
    text = "copy the panoramas, so that the scenes can be moved and the dataset removed"
    images.add_argument("--copy", action="store_const", const="copy", dest="transfer", help=text)
    parser.set_defaults(transfer="symlink")
    add_run_options(parser)


def add_stanford_options(parser: argparse.ArgumentParser) -> None:
    """Areas and labels."""
    parser.add_argument("--areas", nargs="+", default=[], metavar="N", help="only these, 1 to 6")
    text = "clouds from Annotations with a label a point, and labels/ of the panoramas"
    parser.add_argument("--labels", action="store_true", help=text)


def add_mpo_options(parser: argparse.ArgumentParser) -> None:
    """The random transforms."""
    parser.add_argument("--seed", type=int, default=0, help="of the random transforms (default 0)")


def add_generic_options(parser: argparse.ArgumentParser) -> None:
    """Where the files are, and the convention of the poses where the list has no column for it."""
    text = "the list (default poses.csv, .json, .txt or .tum of --from)"
    parser.add_argument("--poses", type=Path, metavar="FILE", help=text)
    parser.add_argument("--cloud", type=Path, metavar="FILE", help="(default the one cloud in --from)")
    text = "pictures named by the times of a trajectory (default images of --from)"
    parser.add_argument("--images", type=Path, metavar="FOLDER", help=text)
    text = "the camera's, where the list has no such column: piccolo is forward, left, up; optical is right, "
    text += "down, forward; opengl is right, up, back"
    parser.add_argument("--axes", choices=AXES, help=text)
    text = "where the list has none: what a row's [R | t] takes camera coordinates to, or from"
    parser.add_argument("--direction", choices=DIRECTIONS, help=text)


OWN_OPTIONS = {
    "stanford2d3ds": add_stanford_options,
    "mpo": add_mpo_options,
    "generic": add_generic_options,
}


def convert_options_from(arguments: argparse.Namespace) -> ConvertOptions:
    """The options of one dataset, as far as its subparser has them."""
    given = vars(arguments)
    names = ("labels", "seed", "poses", "cloud", "images", "axes", "direction")
    own = {name: given[name] for name in names if name in given}
    return ConvertOptions(arguments.folder, areas=frozenset(given.get("areas", ())), **own)


def chosen(specs: tuple[SceneSpec, ...], rooms: list[str]) -> list[SceneSpec]:
    """The scenes of some rooms, or all."""
    counts = Counter(spec.name for spec in specs)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"--from: found the scene {twice[0]} twice")
    names = {spec.name.split("/")[-1] for spec in specs}
    if missing := [room for room in rooms if room not in names]:
        raise InputError(f"--rooms: found no {missing[0]}, wanted one of {', '.join(sorted(names))}")
    return [spec for spec in specs if not rooms or spec.name.split("/")[-1] in rooms]


def report(spec: SceneSpec, written: Written, check: Check | None) -> dict[str, object]:
    """The JSON object of a scene."""
    return {
        "scene": spec.name,
        "folder": str(written.folder),
        "status": "there already" if written.num_points is None else "written",
        "points": written.num_points,
        "queries": written.num_queries,
        **({"fits": check.is_passed, "check": [asdict(c) for c in check.panoramas]} if check else {}),
    }


def run(arguments: argparse.Namespace) -> int:
    """Write the scenes one by one; returns the exit code."""
    for name in ("check", "seed"):
        if getattr(arguments, name, 0) < 0:
            raise UsageError(f"--{name}: found {getattr(arguments, name)}, wanted 0 or more")
    found = DATASETS[arguments.dataset].list_scenes(convert_options_from(arguments))
    specs = chosen(found.specs, arguments.rooms)
    for note in found.notes:
        print_note(arguments, note)
    show = progress_bar(arguments.quiet)
    # bad input goes before a bad fit
    return max((convert_scene(spec, arguments, show) for spec in specs), default=0)


def convert_scene(spec: SceneSpec, arguments: argparse.Namespace, show: Show) -> int:
    """Write a scene, check it, and print its line; returns the exit code."""
    try:
        written = write_scene(spec, arguments.out, arguments.transfer, show)
        check = None
        if arguments.check:
            scene = read_scene(written.folder, spec.name)
            check = check_scene(scene, arguments.check, Workers(num_cores(), show), show)
    except InputError as error:
        return print_error(arguments, f"{spec.name}: {error}", EXIT_BAD_INPUT)
    for warning in written.warnings:
        print_note(arguments, warning)
    print(json.dumps(report(spec, written, check)), flush=True)
    if check and not check.is_passed:
        return print_error(arguments, f"{spec.name}: {check.advice}", EXIT_BAD_FIT)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
