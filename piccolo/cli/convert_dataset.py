"""Write research datasets, or your own panoramas with known poses, as scenes that tools/evaluate.py reads."""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from ..errors import InputError
from ..runtime.threads import Show, Workers, num_cores
from ..scenes.datasets import DATASETS
from ..scenes.datasets.checking import Check, check_scene
from ..scenes.datasets.model import Plan, Request
from ..scenes.datasets.poses import AXES, DIRECTIONS
from ..scenes.datasets.writing import Written, write_scene
from ..scenes.scene import read_scene
from .errors import EXIT_BAD_INPUT, EXIT_BAD_USAGE, complain, guarded
from .progress import shown

PROGRAM = "convert_dataset.py"
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
exit codes: 0 done, 1 --check found poses that don't fit the pictures, 2 wrong usage, 3 bad input, 4 internal
error, 130 interrupted.
"""


def build_parser() -> argparse.ArgumentParser:
    """All options; those that one dataset alone has are in its own subparser."""
    about = "\n".join(f"  {name:<14} {dataset.about}" for name, dataset in DATASETS.items())
    how = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        PROGRAM, description=__doc__, epilog=EPILOG.format(datasets=about), formatter_class=how
    )
    subparsers = parser.add_subparsers(dest="dataset", required=True, metavar="DATASET")
    for name, dataset in DATASETS.items():
        subparser = subparsers.add_parser(name, description=dataset.about, formatter_class=how)
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
    text = "hold N panoramas of each scene against its cloud, also of those there already (default 0)"
    parser.add_argument("--check", type=int, default=0, metavar="N", help=text)
    images = parser.add_mutually_exclusive_group()
    text = "link to the panoramas where they are (default: a copy can take 100 GB)"
    images.add_argument("--link", action="store_const", const="symlink", dest="transfer", help=text)
    text = "copy the panoramas, so that the scenes can be moved and the dataset removed"
    images.add_argument("--copy", action="store_const", const="copy", dest="transfer", help=text)
    parser.set_defaults(transfer="symlink")
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def add_stanford_options(parser: argparse.ArgumentParser) -> None:
    """Areas and labels."""
    parser.add_argument("--areas", nargs="+", default=[], metavar="N", help="only these, 1 to 6")
    text = "clouds from Annotations with a label a point, and labels/ of the panoramas"
    parser.add_argument("--labels", action="store_true", help=text)


def add_mpo_options(parser: argparse.ArgumentParser) -> None:
    """The motions."""
    parser.add_argument("--seed", type=int, default=0, help="of the random motions (default 0)")


def add_generic_options(parser: argparse.ArgumentParser) -> None:
    """Where things are, and what the list does not say of its poses."""
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


def request_from(arguments: argparse.Namespace) -> Request:
    """What the options ask for."""
    given = vars(arguments)
    names = ("labels", "seed", "poses", "cloud", "images", "axes", "direction")
    own = {name: given[name] for name in names if name in given}
    return Request(arguments.folder, areas=frozenset(given.get("areas", ())), **own)


def chosen(plans: tuple[Plan, ...], rooms: list[str]) -> list[Plan]:
    """The plans of some rooms, or all."""
    counts = Counter(plan.name for plan in plans)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"--from: found the scene {twice[0]} twice, wanted it once")
    names = {plan.name.split("/")[-1] for plan in plans}
    if missing := [room for room in rooms if room not in names]:
        raise InputError(f"--rooms: found no {missing[0]}, wanted one of {', '.join(sorted(names))}")
    return [plan for plan in plans if not rooms or plan.name.split("/")[-1] in rooms]


def tell(notes: Iterable[str], arguments: argparse.Namespace) -> None:
    """Lines for the user, unless he wants quiet."""
    for note in notes if not arguments.quiet else ():
        tqdm.write(f"{PROGRAM}: {note}", file=sys.stderr)


def report(plan: Plan, written: Written, check: Check | None) -> dict[str, object]:
    """The line on stdout."""
    return {
        "scene": plan.name,
        "folder": str(written.folder),
        "status": "there already" if written.num_points is None else "written",
        "points": written.num_points,
        "queries": written.num_queries,
        **({"fits": check.is_passed, "check": [asdict(fit) for fit in check.fits]} if check else {}),
    }


def convert(arguments: argparse.Namespace, show: Show) -> int:
    """Write the scenes one by one; returns the exit code."""
    listing = DATASETS[arguments.dataset].listing(request_from(arguments))
    plans = chosen(listing.plans, arguments.rooms)
    tell(listing.notes, arguments)
    # bad input goes before a bad fit
    return max((convert_scene(plan, arguments, show) for plan in plans), default=0)


def convert_scene(plan: Plan, arguments: argparse.Namespace, show: Show) -> int:
    """Write a scene, check it, and print its line; returns the exit code."""
    try:
        written = write_scene(plan, arguments.out, arguments.transfer, show)
        check = None
        if arguments.check:
            scene = read_scene(written.folder, plan.name)
            check = check_scene(scene, arguments.check, Workers(num_cores(), show), show)
    except InputError as error:
        return complain(PROGRAM, arguments.debug, f"{plan.name}: {error}", EXIT_BAD_INPUT)
    tell(written.warnings, arguments)
    print(json.dumps(report(plan, written, check)), flush=True)
    if check and not check.is_passed:
        return complain(PROGRAM, False, f"{plan.name}: {check.advice}", EXIT_BAD_FIT)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = build_parser().parse_args(argv)
    for name in ("check", "seed"):
        if getattr(arguments, name, 0) < 0:
            text = f"--{name}: found {getattr(arguments, name)}, wanted 0 or more"
            return complain(PROGRAM, arguments.debug, text, EXIT_BAD_USAGE)

    return guarded(PROGRAM, arguments.debug, lambda: convert(arguments, shown(arguments.quiet)))
