"""The options of localize.py: what they are, and the settings that they ask for."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from .. import __version__
from ..batch.frame_times import EXIF, NAMES, ORDER
from ..batch.localizer import Localizer
from ..camera.files import read_calibration, read_rig
from ..cloud.crs import check_crs
from ..cloud.settings import METRES, CloudSettings, UpAxis
from ..errors import InputError
from ..geometry.colors import Labels
from ..localization.settings import CoarseToFineSettings
from ..opened_scan import Settings
from ..panorama import ReadOptions
from ..panorama.model import Projection
from ..paper.settings import PaperSettings
from ..scan_map.open_map import CachePolicy
from ..scan_map.prior import Prior
from ..walk.frames import MAX_SPEED
from .command import check_least, option

DESCRIPTION = "Find where in a coloured point cloud 360-degree panoramas were taken."
EPILOG = """\
examples:
  python localize.py --cloud scan.ply --pano query.jpg
  python localize.py --cloud scan.ply --pano query.jpg --out pose.json --overlay overlay.png
  python localize.py --cloud scan.ply --pano photos --out poses.jsonl --priors priors.csv
  ls photos/*.jpg | python localize.py --cloud scan.ply --pano - > poses.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --near 12 3 1.5 4
  python localize.py --cloud scan.ply --walk --pano frames --out walk.jsonl
  python localize.py --cloud scan.ply --video walk.mp4 --every 0.5s --out walk.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --preset paper solver=lbfgs

output: one JSON object a panorama, one a line, in the order given (docs/RESULT.md); messages and progress go
to stderr. Ctrl-C ends a batch after the photo at work, a second one at once.
"""
PRESETS: dict[str, type[Settings]] = {"default": CoarseToFineSettings, "paper": PaperSettings}
ONLY_DEFAULT = ("near", "height", "heading", "within", "refine_focal")
NONE = "none"
PHOTOS_OF_A_JOB = 8  # as many are localized while a process starts and opens a map
DEFAULT_EVERY = "0.5s"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    parser.add_argument("--version", action="version", version=f"piccolo {__version__}")
    text = (
        "coloured scan in any format of docs/USAGE.md, one file or several; or a map by tools/prepare_map.py"
    )
    add_cloud_options(parser, text)
    group = parser.add_argument_group("panorama")
    text = (
        "JPEG, PNG, TIFF, WebP, HEIC: 2:1, a crop with Photo Sphere metadata, a photo with a focal length; "
        "a folder of six cube faces, or with --rig of the pictures of one instant; "
        "or a folder of pictures, @FILE with a path a line, or - for paths on stdin, answered as they come"
    )
    group.add_argument("--pano", nargs="+", default=[], help=text)
    add_panorama_reading_options(group)
    group = parser.add_argument_group("files")
    option(group, "--out FILE", "append each JSON line here; the same command goes on where it stopped")
    option(group, "--overwrite", "begin --out again, whatever is in it")
    text = "panorama, cloud at the pose, checkerboard of both; of several panoramas a folder of PNGs"
    option(group, "--overlay PNG", text)
    text = "of the photo's size: white what contradicts the scan, grey what was not scanned, else black; "
    option(group, "--occlusion-mask PNG", text + "of several a folder")
    text = f"of prepared maps (default the user's); {NONE}: prepare the map again, and do not keep it"
    option(group, "--cache FOLDER", text)
    add_method_options(parser)
    add_prior_options(parser)
    add_walk_options(parser)
    add_execution_options(parser)


def add_cloud_options(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the cloud's files, described by `text`, and how to read them."""
    group = parser.add_argument_group("cloud")
    group.add_argument("--cloud", type=Path, required=True, nargs="+", help=text)
    add_cloud_reading_options(group)


def add_cloud_reading_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of reading a cloud's files."""
    text = f"of the cloud's coordinates: {', '.join(METRES)}, or a number of metres (default m)"
    option(group, "--units UNIT", text, type=_metres_of, default=None)
    text = "up axis of the cloud; auto is the file's: z, in glTF y (default auto; preset default)"
    group.add_argument("--up", choices=get_args(UpAxis), default="auto", help=text)
    option(group, "--intensity-as-gray", "of clouds without colours")
    text = "semantic labels in place of colours: of the points (PLY, LAS, LAZ, PCD), PNG panoramas of labels"
    option(group, "--labels", text)
    option(group, "--ignore-labels N ...", "labels left out of the cloud, and masked in panoramas")


def _metres_of(text: str) -> float:
    """Return metres per unit; `text` is the name of a unit or a number."""
    try:
        return METRES[text] if text in METRES else float(text)
    except ValueError:
        wanted = f"wanted one of {', '.join(METRES)}, or metres a unit"
        raise argparse.ArgumentTypeError(f"found {text!r}, {wanted}") from None


def add_panorama_reading_options(group: argparse._ArgumentGroup) -> None:
    """Add what the files of the panoramas do not say."""
    text = "horizontal field of view, of a part of the sphere about the horizon or as --projection says"
    option(group, "--fov DEG", text)
    text = "of the picture (default equirectangular; of a photo with EXIF's focal length pinhole)"
    group.add_argument("--projection", choices=get_args(Projection), help=text)
    option(group, "--focal PX", "of a pinhole photo, in its own pixels, known to 1 %%", type=float)
    text = "the focal length is a guess, within 20 %%: find it, and k1 if the model has it; takes three times"
    option(group, "--refine-focal", text)
    text = "calibration: COLMAP's cameras.txt, OpenSfM's camera_models.json, or JSON of docs/CAMERAS.md"
    option(group, "--camera FILE", text)
    text = "cameras whose pictures, a folder, are one query: COLMAP's rig_config.json, or our JSON"
    option(group, "--rig FILE", text)
    text = "down, in the camera's axes (+x image centre, +y left, +z up), of any length: 0 0 -1 is upright"
    option(group, "--gravity-vector X Y Z", text)
    text = "white where the panorama is to be ignored; or a folder of masks with the panoramas' names"
    option(group, "--mask FILE", text)
    text = "ignore the cap of this half angle straight down: tripod, car roof"
    group.add_argument("--mask-nadir", type=float, default=0.0, metavar="DEG", help=text)
    text = "the cloud's system, such as EPSG:25832, for photos with GPS, which are searched about it first"
    default = f"(default: what LAS, LAZ or E57 say); {NONE}: leave GPS positions aside"
    option(group, "--crs CRS", f"{text} {default}")


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """Add the preset and its settings."""
    group = parser.add_argument_group("method")
    text = "default: prepared views, all positions searched; paper: Kim et al., ICCV 2021, Algorithm 1; then "
    text += "its settings by name, such as solver=lbfgs loss=photometric (docs/API.md)"
    group.add_argument("--preset", nargs="+", default=["default"], metavar="NAME", help=text)
    text = "known: camera upright, the cloud's z up; unknown: any rotation; auto: both (default auto)"
    group.add_argument("--gravity", choices=["auto", "known", "unknown"], help=text)
    text = f"a pose with less is not called localized (default {CoarseToFineSettings().min_confidence})"
    option(group, "--min-confidence X", text)


def add_prior_options(parser: argparse.ArgumentParser) -> None:
    """Add what the user knows beforehand."""
    title = "prior knowledge (preset default); a pose that contradicts it is not localized"
    group = parser.add_argument_group(title)
    text = "CSV: name and any of x, y, z, radius, heading, tolerance, height, within; before the options here"
    option(group, "--priors FILE", text)
    option(group, "--near X Y Z RADIUS", "the camera is within RADIUS of this position [m]")
    option(group, "--height MIN MAX", "above the floor [m]")
    option(group, "--heading DEG", "of the image centre, clockwise from the cloud's +y, within 20 degrees")
    text = "only in these scans of a map that tools/prepare_map.py --add has put together"
    option(group, "--within NAME ...", text)


def add_walk_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of walks."""
    group = parser.add_argument_group("walks")
    text = "the panoramas are frames of one walk, in this order, each of which narrows the others"
    option(group, "--walk", text)
    option(group, "--video FILE", "a walk's video, in place of --pano")
    text = f"of a video, such as 0.5s or 1m: the sharpest frame each time (default {DEFAULT_EVERY})"
    option(group, "--every STEP", text)
    text = f"of the frames: {EXIF}, {NAMES} (the last number in each, seconds), {ORDER}, or a CSV file with "
    text += f"columns name and time [s] (default {EXIF} if it tells them apart, else {ORDER})"
    option(group, "--times SOURCE", text)
    text = f"of the camera [m/s] (default {MAX_SPEED:g}); where only the order of the frames is known, [m] "
    option(group, "--max-speed X", text + "from one to the next (default by what is found of them)")
    text = "the path on the scan from above, coloured by its frames' confidence: .png, .svg, .pdf or .dxf"
    option(group, "--plan FILE", text)


def add_execution_options(parser: argparse.ArgumentParser, default_jobs: int | None = None) -> None:
    """Add the options of processes, threads and memory; by default as many processes as are worth it."""
    group = parser.add_argument_group("execution")
    text = "1"
    if default_jobs is None:
        text = f"one a core, where memory is enough and each has {PHOTOS_OF_A_JOB} photos or more; "
        text += "1 with names on stdin or --threads"
    option(group, "--jobs N", f"processes over one prepared map (default {text})", default=default_jobs)
    text = "work on a Dask cluster: its scheduler's address or file, or local, of --jobs processes here"
    option(group, "--dask ADDRESS", text)
    option(group, "--threads N", "of each process (default the cores, divided among --jobs)")
    text = "that may be taken in all; with --dask ADDRESS by each worker (default 80 %% of what is free)"
    option(group, "--max-memory GB", text)


def read_options_from(arguments: argparse.Namespace) -> ReadOptions:
    """Return the options of add_panorama_reading_options."""
    if arguments.camera and arguments.rig:
        raise InputError("--camera, --rig: wanted only one of them")
    calibration = read_calibration(arguments.camera) if arguments.camera else None
    return ReadOptions(
        fov_deg=arguments.fov,
        mask=arguments.mask,
        mask_nadir_deg=arguments.mask_nadir,
        labels=_labels_from(arguments),
        use_gps=arguments.crs != NONE,
        projection=arguments.projection,
        focal_px=arguments.focal,
        calibration=read_rig(arguments.rig) if arguments.rig else calibration,
        gravity_vector=tuple(arguments.gravity_vector) if arguments.gravity_vector else None,
        refine_focal=arguments.refine_focal,
    )


def cloud_settings_from(arguments: argparse.Namespace) -> CloudSettings:
    """Return the options of add_cloud_reading_options."""
    scale = METRES["m"] if arguments.units is None else arguments.units
    crs = vars(arguments).get("crs")  # not of commands without photos
    if crs == NONE:
        crs = None
    if crs:
        check_crs(crs)
    return CloudSettings(scale, arguments.up, arguments.intensity_as_gray, _labels_from(arguments), crs)


def _labels_from(arguments: argparse.Namespace) -> Labels | None:
    """Return how labels are to be read, None for colours."""
    if arguments.ignore_labels and not arguments.labels:
        raise InputError("--ignore-labels: only with --labels")
    return Labels(tuple(sorted(set(arguments.ignore_labels or ())))) if arguments.labels else None


def cache_from(arguments: argparse.Namespace) -> CachePolicy:
    """Return where prepared maps are kept."""
    is_used = arguments.cache != Path(NONE)
    return CachePolicy(is_used, arguments.cache if is_used else None)


def localizer_from(arguments: argparse.Namespace, paths: tuple[Path, ...] = ()) -> Localizer:
    """Return what localizes photos in the scan of some files as the options ask for."""
    settings = settings_from(arguments)
    cloud_settings = cloud_settings_from(arguments)
    return Localizer(paths, settings, cloud_settings, read_options_from(arguments), cache_from(arguments))


def settings_from(arguments: argparse.Namespace) -> Settings:
    """Return the settings that the options ask for; an option of the other preset is refused."""
    name, *words = arguments.preset
    if name not in PRESETS:
        raise InputError(f"--preset: found {name!r}, wanted {' or '.join(PRESETS)}")
    given = parse_settings(name, words)
    asked = {"gravity": arguments.gravity, "min_confidence": arguments.min_confidence}
    given |= {name: value for name, value in asked.items() if value is not None}
    options = vars(arguments)
    if name == "paper":
        foreign = [option for option in ONLY_DEFAULT if options.get(option) not in (None, False)]
        foreign += ["up"] if arguments.up != "auto" else []
        if foreign:
            raise InputError(f"--{foreign[0].replace('_', '-')}: not an option of the preset paper")
    else:
        given["prior"] = prior_from(options)
    return PRESETS[name](**given)


def prior_from(options: dict[str, Any]) -> Prior:
    """Return what the options of add_prior_options say of all photos; nothing of a command without them."""
    within = tuple(options.get("within") or ())
    given: dict[str, Any] = {"within": within, "heading_deg": options.get("heading")}
    if near := options.get("near"):
        given |= {"near_world": tuple(near[:3]), "radius": near[3]}
    if height := options.get("height"):
        given["height"] = tuple(height)
    return Prior(**given)


def parse_settings(preset: str, words: Sequence[str]) -> dict[str, Any]:
    """Return the settings of a preset that are written as NAME=VALUE."""
    hints = {name: hint for name, hint in get_type_hints(PRESETS[preset]).items() if name != "prior"}
    given: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        if name not in hints:
            raise InputError(f"--preset {preset}: found {word!r}, wanted NAME=VALUE of {', '.join(hints)}")
        hint = hints[name]
        choices: dict[str, Any] = {choice: choice for choice in get_args(hint)}
        if hint is bool:
            choices = {"true": True, "false": False}
        try:
            given[name] = choices[text] if choices else hint(text)
        except (KeyError, ValueError) as error:
            wanted = f"one of {', '.join(choices)}" if choices else hint.__name__
            raise InputError(f"--preset {preset}: found {word!r}, wanted {wanted}") from error
    return given


def check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse values that are wrong whatever the files hold."""
    check_least(arguments, threads=1, jobs=1)
    if arguments.overwrite and not arguments.out:
        raise InputError("--overwrite: only with --out")
