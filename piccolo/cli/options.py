"""The options of localize.py: what they are, and the settings that they ask for."""

import argparse
from pathlib import Path
from typing import Any, get_args

from .. import __version__
from ..camera.files import read_calibration, read_rig
from ..cloud.crs import check_crs
from ..cloud.settings import METRES, CloudSettings, UpAxis
from ..errors import InputError
from ..geometry.colors import Labels
from ..localization.settings import CoarseToFineSettings
from ..panorama import ReadOptions
from ..panorama.model import Projection
from ..paper.settings import Initialization, PaperSettings, PoseLoss
from ..scan_map.prior import Prior
from .command import check_least
from .executing import add_execution_options
from .parser import add_run_options, new_parser
from .walking import add_walk_options

DESCRIPTION = "Find where in a coloured point cloud 360-degree panoramas were taken."
EPILOG = """\
examples:
  python localize.py --cloud scan.ply --pano query.jpg
  python localize.py --cloud scan.ply --pano query.jpg --out pose.json --overlay overlay.png
  python localize.py --cloud scan.ply --pano photos --out poses.jsonl --priors priors.csv
  ls photos/*.jpg | python localize.py --cloud scan.ply --pano - > poses.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --near 12 3 1.5 --radius 4
  python localize.py --cloud scan.ply --walk --pano frames --out walk.jsonl
  python localize.py --cloud scan.ply --video walk.mp4 --every 0.5s --out walk.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --preset paper --solver lbfgs

output: one JSON object a panorama, one a line, in the order given (docs/RESULT.md); messages and progress go
to stderr. Ctrl-C ends a batch after the photo at work, a second one at once.
--help-paper shows the options of the preset paper.
"""
# Settings that only one preset has, each with an option of its name: option, metavar, type or choices, help.
Option = tuple[str, str | None, type | tuple[str, ...], str]
NUM_ROTATIONS: Option = (
    "--num-rotations", "N", int,
    "rotations of SO(3) searched where gravity is unknown; preset paper: N_r, 0 for 8 yaws or 32 of SO(3)",
)  # fmt: skip
DEFAULT_OPTIONS: tuple[Option, ...] = (
    ("--num-yaws", "N", int, "rotations searched where gravity is known"),
    NUM_ROTATIONS,
    ("--max-starts", "N", int, "poses from which a descent begins, at most"),
)
PAPER_ONLY: tuple[Option, ...] = (
    ("--num-translations", "N_t", int, "start positions in free space"),
    ("--loss", None, get_args(PoseLoss), "photometric: pixels of the rendered cloud, the paper's comparison"),
    ("--photometric-width", "PX", int, "of rendered cloud and panorama with the photometric loss, at most"),
    ("--initialization", None, get_args(Initialization), "loss-only: K2 poses by the loss, no histograms"),
    ("--num-by-loss", "K1", int, "poses kept by the loss"),
    ("--num-by-histogram", "K2", int, "poses kept by colour histograms, and refined"),
    ("--num-iterations", "N", int, "iterations of the solver"),
    ("--histogram-bins", "N", int, "bins a channel"),
    ("--grid-margin", "FRACTION", float, "fraction of the box left out on each side of the grid"),
    ("--max-points", "N", int, "points used of a larger cloud"),
    ("--no-visibility", None, bool, "see through walls"),
)
PAPER_OPTIONS = (NUM_ROTATIONS, *PAPER_ONLY)
PRIORS = ("near", "radius", "height", "heading", "heading_tolerance", "within")


def build_parser() -> argparse.ArgumentParser:
    """All options. A setting that is not given stays None, and keeps its preset's default."""
    parser = new_parser("localize", DESCRIPTION, EPILOG, "0 all localized, 1 some not")
    parser.add_argument("--version", action="version", version=f"piccolo {__version__}")
    text = "coloured scan in any format of the README, one file or several; or a map by tools/prepare_map.py"
    add_cloud_options(parser, text)
    files = parser.add_argument_group("files")
    add_panorama_options(parser)
    text = "append each JSON line here as it comes; the same command again goes on where it stopped"
    files.add_argument("--out", type=Path, metavar="FILE", help=text)
    files.add_argument("--overwrite", action="store_true", help="begin --out anew, whatever is in it")
    text = "PNG: panorama, cloud at the pose, checkerboard of both; of several panoramas a folder of PNGs"
    files.add_argument("--overlay", type=Path, metavar="PNG", help=text)
    text = "PNG of the photo's size: white what contradicts the scan, grey what was not scanned, else black"
    files.add_argument("--occlusion-mask", type=Path, metavar="PNG", help=f"{text}; of several a folder")
    files.add_argument("--cache", type=Path, metavar="FOLDER", help="of prepared maps (default the user's)")
    files.add_argument("--no-cache", action="store_true", help="prepare the map again, and do not keep it")
    add_method_options(parser)
    add_prior_options(parser)
    add_walk_options(parser)
    add_execution_options(parser)
    add_run_options(parser)
    return parser


def add_cloud_options(parser: argparse.ArgumentParser, text: str) -> None:
    """The cloud's files, described by `text`, and how to read them."""
    group = parser.add_argument_group("cloud")
    group.add_argument("--cloud", type=Path, required=True, nargs="+", help=text)
    add_cloud_reading_options(group)


def add_cloud_reading_options(group: argparse._ArgumentGroup) -> None:
    """How to read a cloud's files."""
    unit = group.add_mutually_exclusive_group()
    unit.add_argument("--units", choices=list(METRES), help="of the cloud's coordinates (default m)")
    unit.add_argument("--scale", type=float, metavar="S", help="metres per unit of the cloud, in place of it")
    text = "up axis of the cloud; auto is the file's: z, in glTF y (default auto; preset default)"
    group.add_argument("--up", choices=get_args(UpAxis), default="auto", help=text)
    text = "of clouds without colours"
    group.add_argument("--intensity-as-gray", action="store_true", help=text)
    text = (
        "semantic labels in place of colours: of the points (PLY, LAS, LAZ, PCD), and PNG panoramas of labels"
    )
    group.add_argument("--labels", action="store_true", help=text)
    text = "labels to ignore: left out of the cloud, masked in panoramas"
    group.add_argument("--ignore-labels", type=int, nargs="+", metavar="N", help=text)


def add_panorama_options(parser: argparse.ArgumentParser) -> None:
    """The panoramas' files, and how to read them."""
    group = parser.add_argument_group("panorama")
    text = (
        "JPEG, PNG, TIFF, WebP, HEIC: 2:1, a crop with Photo Sphere metadata, a photo with a focal length; "
        "a folder of six cube faces, or with --rig of the pictures of one instant; "
        "or a folder of pictures, @FILE with a path a line, or - for paths on stdin, answered as they come"
    )
    group.add_argument("--pano", nargs="+", default=[], help=text)
    add_panorama_reading_options(group)


def add_panorama_reading_options(group: argparse._ArgumentGroup) -> None:
    """What the files of the panoramas do not tell."""
    text = "horizontal field of view, of a part of the sphere about the horizon or as --projection says"
    group.add_argument("--fov", type=float, metavar="DEG", help=text)
    text = "of the picture (default equirectangular; of a photo with EXIF's focal length pinhole)"
    group.add_argument("--projection", choices=get_args(Projection), help=text)
    text = "focal length of a pinhole photo, in its own pixels, known to 1 %%"
    group.add_argument("--focal", type=float, metavar="PX", help=text)
    text = (
        "the focal length is a guess, within 20 %%: find it, and k1 if the model has it; three times as slow"
    )
    group.add_argument("--refine-focal", action="store_true", help=text)
    text = "calibration: COLMAP's cameras.txt, OpenSfM's camera_models.json, or JSON of docs/CAMERAS.md"
    group.add_argument("--camera", type=Path, metavar="FILE", help=text)
    text = "cameras whose pictures, a folder, are one query: COLMAP's rig_config.json, or our JSON"
    group.add_argument("--rig", type=Path, metavar="FILE", help=text)
    text = "down, in the camera's axes (+x image centre, +y left, +z up), of any length: 0 0 -1 is upright"
    group.add_argument("--gravity-vector", type=float, nargs=3, metavar=("X", "Y", "Z"), help=text)
    text = (
        "picture, white where the panorama is to be ignored; or a folder of masks with the panoramas' names"
    )
    group.add_argument("--mask", type=Path, help=text)
    text = "ignore the cap of this half angle straight down: tripod, car roof"
    group.add_argument("--mask-nadir", type=float, default=0.0, metavar="DEG", help=text)
    text = "the picture is a strip or grid of cube faces in this order, such as rludfb"
    group.add_argument("--cube-order", metavar="LETTERS", help=text)
    text = "the cloud's system, such as EPSG:25832, for photos with GPS (default: what LAS, LAZ or E57 say)"
    group.add_argument("--crs", metavar="CRS", help=text)
    text = "leave GPS positions in the pictures aside (default: each is searched about first)"
    group.add_argument("--no-gps", action="store_true", help=text)


def read_options_from(arguments: argparse.Namespace) -> ReadOptions:
    """The options of add_panorama_options."""
    pictures = arguments.fov, arguments.mask, arguments.mask_nadir, arguments.cube_order
    if arguments.camera and arguments.rig:
        raise InputError("--camera, --rig: wanted only one of them")
    calibration = read_calibration(arguments.camera) if arguments.camera else None
    return ReadOptions(
        *pictures,
        labels_from(arguments),
        not arguments.no_gps,
        arguments.projection,
        arguments.focal,
        read_rig(arguments.rig) if arguments.rig else calibration,
        tuple(arguments.gravity_vector) if arguments.gravity_vector else None,
        arguments.refine_focal,
    )


def cloud_settings_from(arguments: argparse.Namespace) -> CloudSettings:
    """The options of add_cloud_options."""
    scale = METRES[arguments.units or "m"] if arguments.scale is None else arguments.scale
    crs = vars(arguments).get("crs")  # not of commands without photos
    if crs:
        check_crs(crs)
    return CloudSettings(scale, arguments.up, arguments.intensity_as_gray, labels_from(arguments), crs)


def labels_from(arguments: argparse.Namespace) -> Labels | None:
    """How labels are to be read, None for colours."""
    if arguments.ignore_labels and not arguments.labels:
        raise InputError("--ignore-labels: only with --labels")
    return Labels(tuple(sorted(set(arguments.ignore_labels or ())))) if arguments.labels else None


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """The preset and its settings; those of the preset `paper` are shown by --help-paper only."""
    group = parser.add_argument_group("method")
    text = "default: prepared views, all positions searched; paper: Kim et al., ICCV 2021, Algorithm 1"
    group.add_argument("--preset", choices=["default", "paper"], default="default", help=text)
    text = "known: camera upright, the cloud's z up; unknown: any rotation; auto: both (default auto)"
    group.add_argument("--gravity", choices=["auto", "known", "unknown"], help=text)
    text = "of the descent (default gauss-newton, with the preset paper adam)"
    group.add_argument("--solver", choices=["gauss-newton", "lbfgs", "adam"], help=text)
    text = f"a pose with less is not called localized (default {CoarseToFineSettings().min_confidence})"
    group.add_argument("--min-confidence", type=float, metavar="X", help=text)
    add_options(group, DEFAULT_OPTIONS, CoarseToFineSettings())
    add_options(group, PAPER_ONLY, PaperSettings(), is_hidden=True)
    text = "show the options of the preset paper and exit"
    group.add_argument("--help-paper", action=PaperHelp, nargs=0, help=text)


def add_options(
    group: argparse._ArgumentGroup,
    options: tuple[Option, ...],
    defaults: CoarseToFineSettings | PaperSettings,
    is_hidden: bool = False,
) -> None:
    """Options that have the names of settings."""
    for option, metavar, kind, text in options:
        setting = setting_of(option)
        default = "" if kind is bool else f" (default {getattr(defaults, setting)})"
        shown = argparse.SUPPRESS if is_hidden else text + default
        if kind is bool:
            group.add_argument(option, action="store_const", const=False, dest=setting, help=shown)
        elif isinstance(kind, tuple):
            group.add_argument(option, choices=kind, help=shown)
        else:
            group.add_argument(option, type=kind, metavar=metavar, help=shown)


def setting_of(option: str) -> str:
    """The name of an option's setting."""
    return option.removeprefix("--").replace("-", "_").replace("no_visibility", "use_visibility")


class PaperHelp(argparse.Action):
    """Print the options of the preset `paper`, and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *values: object) -> None:
        """See argparse.Action."""
        usage = f"{parser.prog} --preset paper [option ...]"
        paper = argparse.ArgumentParser(usage=usage, add_help=False)
        add_options(paper.add_argument_group("options of the preset paper"), PAPER_OPTIONS, PaperSettings())
        paper.print_help()
        parser.exit()


def add_prior_options(parser: argparse.ArgumentParser) -> None:
    """What the user knows beforehand."""
    group = parser.add_argument_group(
        "prior knowledge (preset default); a pose that contradicts it is not localized"
    )
    text = "CSV: name and any of x, y, z, radius, heading, tolerance, height, within; before the options here"
    group.add_argument("--priors", type=Path, metavar="FILE", help=text)
    group.add_argument("--near", type=float, nargs=3, metavar=("X", "Y", "Z"), help="rough position [m]")
    group.add_argument("--radius", type=float, metavar="M", help="the camera is within M metres of --near")
    group.add_argument("--height", type=float, nargs=2, metavar=("MIN", "MAX"), help="above the floor [m]")
    text = "of the image centre, clockwise from the cloud's +y"
    group.add_argument("--heading", type=float, metavar="DEG", help=text)
    group.add_argument("--heading-tolerance", type=float, metavar="DEG", help="(default 20)")
    text = "only in these scans of a map that tools/prepare_map.py --add has put together"
    group.add_argument("--within", nargs="+", metavar="NAME", help=text)


def settings_from(arguments: argparse.Namespace) -> CoarseToFineSettings | PaperSettings:
    """The settings that the options ask for; an option of the other preset is refused."""
    given = {k: v for k, v in vars(arguments).items() if v is not None}
    shared = {name: given[name] for name in ("gravity", "solver", "min_confidence") if name in given}
    if arguments.preset == "paper":
        foreign = [option for option, *_ in DEFAULT_OPTIONS if option != NUM_ROTATIONS[0]]
        foreign += ["--" + name.replace("_", "-") for name in PRIORS]
        foreign += ["--up"] if arguments.up != "auto" else []
        foreign += ["--refine-focal"] if given.get("refine_focal") else []
    else:
        foreign = [option for option, *_ in PAPER_ONLY]
    if wrong := [option for option in foreign if setting_of(option) in given]:
        raise InputError(f"{wrong[0]}: not an option of the preset {arguments.preset}")
    if arguments.preset == "paper":
        return paper_settings_from(arguments, **shared)
    prior = Prior(
        near_world=tuple(given["near"]) if "near" in given else None,
        radius=given.get("radius"),
        height=tuple(given["height"]) if "height" in given else None,
        heading_deg=given.get("heading"),
        heading_tolerance_deg=given.get("heading_tolerance", Prior.heading_tolerance_deg),
        within=tuple(given.get("within", ())),
    )
    own = {name: given[name] for option, *_ in DEFAULT_OPTIONS if (name := setting_of(option)) in given}
    return CoarseToFineSettings(prior=prior, **shared, **own)


def paper_settings_from(arguments: argparse.Namespace, **more: Any) -> PaperSettings:
    """The settings of the preset `paper` by PAPER_OPTIONS, and `more`."""
    given = {setting_of(option): getattr(arguments, setting_of(option)) for option, *_ in PAPER_OPTIONS}
    return PaperSettings(**{name: value for name, value in given.items() if value is not None}, **more)


def check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse values that are wrong whatever the files hold."""
    check_least(arguments, threads=1, jobs=1)
    cloud_settings_from(arguments)
    if arguments.overwrite and not arguments.out:
        raise InputError("--overwrite: only with --out")
    if arguments.heading_tolerance is not None and arguments.heading is None and not arguments.priors:
        raise InputError("--heading-tolerance: only with --heading or --priors")
    if arguments.cache and arguments.no_cache:
        raise InputError("--cache, --no-cache: only one of them")
