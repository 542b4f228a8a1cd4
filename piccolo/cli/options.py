"""The options of localize.py: what they are, and the settings that they ask for."""

import argparse
import sys
from pathlib import Path
from typing import Any, get_args

from .. import __version__
from ..cloud.label_colors import Labels
from ..cloud.settings import METRES, CloudSettings, UpAxis
from ..coarse_to_fine.settings import CoarseToFineSettings, Prior
from ..errors import InputError
from ..panorama import ReadOptions
from ..paper.settings import Initialization, PaperSettings, PoseLoss
from ..runtime.threads import num_cores

DESCRIPTION = "Find where in a coloured point cloud 360-degree panoramas were taken."
EPILOG = """\
examples:
  python localize.py --cloud scan.ply --pano query.jpg
  python localize.py --cloud scan.ply --pano query.jpg --out pose.json --overlay overlay.png
  python localize.py --cloud scan.ply --pano photos/*.jpg --out poses.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --near 12 3 1.5 --radius 4
  python localize.py --cloud scan.ply --pano query.jpg --preset paper --solver lbfgs

output: one JSON object a panorama, one a line, in the order given; messages and progress go to stderr.
exit codes: 0 all localized, 1 some not, 2 wrong usage, 3 bad input, 4 internal error, 130 interrupted.
"""
# option, metavar, type or choices, help: settings that only one preset has, named as the setting
Option = tuple[str, str | None, type | tuple[str, ...], str]
ENGINE_OPTIONS: tuple[Option, ...] = (
    ("--num-yaws", "N", int, "rotations searched where gravity is known"),
    ("--num-rotations", "N", int, "rotations of SO(3) searched where it is not"),
    ("--max-starts", "N", int, "poses from which a descent begins, at most"),
)
PAPER_OPTIONS: tuple[Option, ...] = (
    ("--translations", "N_t", int, "start positions in free space"),
    ("--rotations", "N_r", int, "start rotations; 0: 8 yaws if gravity is known, 32 of SO(3) if not"),
    ("--loss", None, get_args(PoseLoss), "photometric: pixels of the rendered cloud, the paper's comparison"),
    ("--photometric-width", "PX", int, "of rendered cloud and panorama with the photometric loss, at most"),
    ("--initialization", None, get_args(Initialization), "loss-only: K2 poses by the loss, no histograms"),
    ("--keep-by-loss", "K1", int, "poses kept by the loss"),
    ("--keep-by-histogram", "K2", int, "poses kept by colour histograms, and refined"),
    ("--iterations", "N", int, "iterations of the solver"),
    ("--histogram-bins", "N", int, "bins a channel"),
    ("--grid-margin", "SHARE", float, "share of the box left out on each side of the grid"),
    ("--max-points", "N", int, "points used of a larger cloud"),
)
PAPER_SETTING = {
    "translations": "num_translations",
    "rotations": "num_rotations",
    "keep_by_loss": "num_by_loss",
    "keep_by_histogram": "num_by_histogram",
    "iterations": "num_iterations",
}


def build_parser() -> argparse.ArgumentParser:
    """All options. A setting that is not given stays None, and keeps its preset's default."""
    parser = argparse.ArgumentParser(
        "localize.py",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"piccolo {__version__}")
    text = "coloured scan in any format of the README, one file or several; or a map by tools/prepare_map.py"
    add_cloud_options(parser, text)
    files = parser.add_argument_group("files")
    add_panorama_options(parser)
    files.add_argument("--out", type=Path, help="write the JSON here, not to stdout")
    files.add_argument("--overlay", type=Path, help="PNG: panorama, cloud at the pose, checkerboard of both")
    files.add_argument("--cache", type=Path, metavar="FOLDER", help="of prepared maps (default the user's)")
    files.add_argument("--no-cache", action="store_true", help="prepare the map anew and keep none")
    add_method_options(parser)
    add_prior_options(parser)
    run = parser.add_argument_group("run")
    run.add_argument("--threads", type=int, default=num_cores(), metavar="N", help="(default all cores)")
    run.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    run.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_cloud_options(parser: argparse.ArgumentParser, text: str) -> None:
    """The cloud's files, described by `text`, and how to understand them."""
    group = parser.add_argument_group("cloud")
    group.add_argument("--cloud", type=Path, required=True, nargs="+", help=text)
    add_cloud_reading_options(group)


def add_cloud_reading_options(group: argparse._ArgumentGroup) -> None:
    """How to understand a cloud's files."""
    unit = group.add_mutually_exclusive_group()
    unit.add_argument("--units", choices=list(METRES), help="of the cloud's coordinates (default m)")
    unit.add_argument("--scale", type=float, metavar="S", help="metres per unit of the cloud, in place of it")
    text = "axis of the cloud that points up, not to be found out (default auto; preset default)"
    group.add_argument("--up", choices=get_args(UpAxis), default="auto", help=text)
    text = "of clouds without colours"
    group.add_argument("--intensity-as-gray", action="store_true", help=text)
    text = (
        "semantic labels in place of colours: of the points (PLY, LAS, LAZ, PCD), and PNG panoramas of such"
    )
    group.add_argument("--labels", action="store_true", help=text)
    text = "labels that say nothing: left out of the cloud, masked in panoramas"
    group.add_argument("--ignore-labels", type=int, nargs="+", metavar="N", help=text)


def add_panorama_options(parser: argparse.ArgumentParser) -> None:
    """The panoramas' files, and how to understand them."""
    group = parser.add_argument_group("panorama")
    text = "JPEG, PNG, TIFF or WebP: 2:1, or a crop with Photo Sphere metadata; or a folder of six cube faces"
    group.add_argument("--pano", type=Path, required=True, nargs="+", help=text)
    add_panorama_reading_options(group)


def add_panorama_reading_options(group: argparse._ArgumentGroup) -> None:
    """What the pictures do not say of themselves."""
    text = "horizontal field of view of a part of the sphere, its middle row the horizon"
    group.add_argument("--fov", type=float, metavar="DEG", help=text)
    text = "picture, white where the panorama is to be ignored, or a folder of such named as the panoramas"
    group.add_argument("--mask", type=Path, help=text)
    text = "ignore the cap of this half angle straight down: tripod, car roof"
    group.add_argument("--mask-nadir", type=float, default=0.0, metavar="DEG", help=text)
    text = "the picture is a strip or grid of cube faces in this order, such as rludfb"
    group.add_argument("--cube-order", metavar="LETTERS", help=text)


def read_options_from(arguments: argparse.Namespace) -> ReadOptions:
    """What add_panorama_options asked for."""
    pictures = arguments.fov, arguments.mask, arguments.mask_nadir, arguments.cube_order
    return ReadOptions(*pictures, labels_from(arguments))


def cloud_settings_from(arguments: argparse.Namespace) -> CloudSettings:
    """What add_cloud_options asked for."""
    scale = METRES[arguments.units or "m"] if arguments.scale is None else arguments.scale
    return CloudSettings(scale, arguments.up, arguments.intensity_as_gray, labels_from(arguments))


def labels_from(arguments: argparse.Namespace) -> Labels | None:
    """How labels are to be read, None for colours."""
    if arguments.ignore_labels and not arguments.labels:
        raise InputError("--ignore-labels: found without --labels, wanted both")
    return Labels(tuple(sorted(set(arguments.ignore_labels or ())))) if arguments.labels else None


def parse(parser: argparse.ArgumentParser, argv: list[str] | None) -> argparse.Namespace:
    """The options given; argparse alone would take the value of `--up -y` for an option."""
    words: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        if words[-1:] == ["--up"]:
            words[-1] = f"--up={word}"
        else:
            words.append(word)
    return parser.parse_args(words)


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """The preset and its settings."""
    group = parser.add_argument_group("method")
    text = "default: prepared views, all positions searched; paper: Kim et al., ICCV 2021, Algorithm 1"
    group.add_argument("--preset", choices=["default", "paper"], default="default", help=text)
    text = "known: camera upright and the cloud level; unknown: any rotation; auto: both (default auto)"
    group.add_argument("--gravity", choices=["auto", "known", "unknown"], help=text)
    text = "of the descent (default gauss-newton, with the preset paper adam)"
    group.add_argument("--solver", choices=["gauss-newton", "lbfgs", "adam"], help=text)
    text = f"below it a pose is not called localized (default {CoarseToFineSettings().min_confidence})"
    group.add_argument("--min-confidence", type=float, metavar="X", help=text)
    for title, options, settings in (
        ("preset default", ENGINE_OPTIONS, CoarseToFineSettings()),
        ("preset paper", PAPER_OPTIONS, PaperSettings()),
    ):
        group = parser.add_argument_group(title)
        for option, metavar, kind, text in options:
            name = option[2:].replace("-", "_")
            default = getattr(settings, PAPER_SETTING.get(name, name))
            checked: dict[str, Any] = {"choices": kind} if isinstance(kind, tuple) else {"type": kind}
            group.add_argument(option, **checked, metavar=metavar, help=f"{text} (default {default})")
    group.add_argument("--no-visibility", action="store_const", const=True, help="see through walls")


def add_prior_options(parser: argparse.ArgumentParser) -> None:
    """What the user knows beforehand."""
    group = parser.add_argument_group("prior knowledge (preset default); each narrows the search")
    group.add_argument("--near", type=float, nargs=3, metavar=("X", "Y", "Z"), help="rough position [m]")
    group.add_argument("--radius", type=float, metavar="M", help="the camera is within M metres of --near")
    group.add_argument("--height", type=float, nargs=2, metavar=("MIN", "MAX"), help="above the floor [m]")
    text = "of the image centre, clockwise from the cloud's +y"
    group.add_argument("--heading", type=float, metavar="DEG", help=text)
    group.add_argument("--heading-tolerance", type=float, metavar="DEG", help="(default 20)")


def settings_from(arguments: argparse.Namespace) -> CoarseToFineSettings | PaperSettings:
    """The settings that the options ask for; an option of the other preset is refused."""
    given = {k: v for k, v in vars(arguments).items() if v is not None}
    own, other = ENGINE_OPTIONS, PAPER_OPTIONS
    if arguments.preset == "paper":
        own, other = other, own
    foreign = [option for option, *_ in other if option[2:].replace("-", "_") in given]
    priors = [n for n in ("near", "radius", "height", "heading", "heading_tolerance") if n in given]
    if arguments.preset == "default":
        foreign += ["--no-visibility"] if "no_visibility" in given else []
    else:
        foreign += ["--" + name.replace("_", "-") for name in priors]
        foreign += ["--up"] if arguments.up != "auto" else []
    if foreign:
        raise InputError(f"{foreign[0]}: not an option of the preset {arguments.preset}")
    names = ["gravity", "solver", "min_confidence", *(option[2:].replace("-", "_") for option, *_ in own)]
    chosen = {PAPER_SETTING.get(n, n): given[n] for n in names if n in given}
    if arguments.preset == "paper":
        return PaperSettings(use_visibility="no_visibility" not in given, **chosen)
    prior = Prior(
        near_world=tuple(given["near"]) if "near" in given else None,
        radius=given.get("radius"),
        height=tuple(given["height"]) if "height" in given else None,
        heading_deg=given.get("heading"),
        heading_tolerance_deg=given.get("heading_tolerance", Prior.heading_tolerance_deg),
    )
    return CoarseToFineSettings(prior=prior, **chosen)


def check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse values that no file could make right."""
    if arguments.threads < 1:
        raise InputError(f"--threads: found {arguments.threads}, wanted at least 1")
    cloud_settings_from(arguments)
    if arguments.overlay and len(arguments.pano) > 1:
        raise InputError(f"--overlay: found {len(arguments.pano)} panoramas, wanted one")
    if arguments.cache and arguments.no_cache:
        raise InputError("--cache, --no-cache: found both, wanted one of them or none")
