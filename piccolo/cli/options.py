"""The options of localize.py, and of commands that share some. No library is imported that takes long."""

import argparse
from pathlib import Path
from typing import get_args

from .. import __version__
from ..cloud.cloud_settings import METRES, RANGES, UpAxis
from ..system.arguments import EXIF, MAX_SPEED, MAX_STEP, MIN_CONFIDENCE, NAMES, ORDER, Projection
from ..system.errors import InputError
from .command import Arguments, option

DESCRIPTION = "Find the camera poses of photos, 360-degree panoramas or others, in a coloured point cloud."
EPILOG = """\
examples:
  python localize.py --cloud scan.ply --pano query.jpg
  python localize.py --cloud scan.ply --pano query.jpg --out pose.json --overlay overlay.png
  python localize.py --cloud scan.ply --pano photos --out poses.jsonl --priors priors.csv
  ls photos/*.jpg | python localize.py --cloud scan.ply --pano - > poses.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --near 12 3 1.5 4
  python localize.py --cloud scan.ply --pano photos --relative transforms.json --out poses.jsonl
  python localize.py --cloud scan.ply --walk --pano frames --out walk.jsonl
  python localize.py --cloud scan.ply --video walk.mp4 --out walk.jsonl
  python localize.py --cloud bare.e57 --pano photos --color-scan colored.ply --out poses.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --preset paper solver=lbfgs

output: one JSON object per photo and line, in the order given (docs/RESULT.md); messages and progress go
to stderr. Ctrl-C lets the current photo finish and then stops a batch; a second Ctrl-C stops it at once.
"""
NONE = "none"
CACHE_TEXT = f"folder of prepared maps (default: in the user's cache); {NONE}: prepare the map again"
PHOTOS_OF_A_JOB = 8  # as many are localized while a process starts and opens a map
DEFAULT_EVERY = 0.5  # [s]
MIN_EVERY = 0.01  # [s]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    parser.add_argument("--version", action="version", version=f"piccolo {__version__}")
    text = "files of one coloured scan (formats: docs/USAGE.md), or a map of tools/prepare_map.py"
    add_cloud_options(parser, text)
    group = parser.add_argument_group("photos")
    text = (
        "pictures (JPEG, PNG, TIFF, WebP, HEIC): full spheres (2:1), crops with Photo Sphere metadata, or "
        "photos with a known focal length; a folder of six cube faces, or, with --rig, of the pictures taken "
        "at one instant; a folder of pictures; @FILE, a text file with one path per line; or - to read paths "
        "from stdin and answer each at once"
    )
    group.add_argument("--pano", nargs="+", default=[], help=text)
    add_panorama_reading_options(group)
    group = parser.add_argument_group("files")
    option(group, "--out FILE", "append the JSON lines to this file; a repeated command continues")
    option(group, "--overwrite", "replace the file of --out instead of continuing it")
    folder = "an existing folder if there are several photos"
    text = "the photo, the cloud seen from its pose, and a checkerboard of both; "
    option(group, "--overlay PNG", text + folder)
    text = "mask of the photo's size: white contradicts the scan, grey was not scanned, black elsewhere; "
    option(group, "--occlusion-mask PNG", text + folder)
    text = "colour the scan by the photos (.ply, .las, .laz, .e57), and localize each by the others' colours"
    option(group, "--color-scan FILE", text)
    text = "write how each photo was searched to this file: attempts, candidates, evidence (JSON lines)"
    option(group, "--trace FILE", text)
    option(group, "--cache FOLDER", CACHE_TEXT)
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
    text = f"unit of the cloud's coordinates: {', '.join(METRES)}, or its length in metres "
    option(group, "--units UNIT", f"{text}(default: as LAS names it, else m)", type=_metres_of, default=None)
    text = "axis of the cloud that points up; auto: z, or y in glTF (default auto; with preset default only)"
    group.add_argument("--up", choices=get_args(UpAxis), default="auto", help=text)
    option(group, "--ignore-colors", "localize by the shape and intensity of the scan even if it has colours")
    ranges = ["auto", *(f"{value:g}" for value in RANGES)]
    text = "full brightness of the cloud's colours (default auto: by the file, then by their values)"
    option(group, "--color-range", text, choices=ranges, default=ranges[0])
    text = "columns of text, PTS and .npy files, as x,y,z,i,r,g,b; - for others (default: by a header or "
    option(group, "--columns NAMES", text + "their values)", type=lambda names: names.split(","), default=[])


def _metres_of(text: str) -> float:
    """Return metres per unit; `text` is the name of a unit or a number."""
    try:
        return METRES[text] if text in METRES else float(text)
    except ValueError:
        wanted = f"wanted one of {', '.join(METRES)}, or a length in metres"
        raise argparse.ArgumentTypeError(f"found {text!r}, {wanted}") from None


def add_panorama_reading_options(group: argparse._ArgumentGroup) -> None:
    """Add what the files of the panoramas do not say."""
    text = "horizontal field of view: of a photo with --projection; alone, of a crop of the sphere"
    option(group, "--fov DEG", text, dest="fov_deg")
    text = "projection of the picture (default equirectangular; pinhole if EXIF has a focal length)"
    group.add_argument("--projection", choices=get_args(Projection), help=text)
    text = "focal length of a pinhole photo, in its pixels, known to 1 %%"
    option(group, "--focal PX", text, type=float, dest="focal_px")
    text = "refine the focal length (known within 20 %%) and k1, if the model has it; takes 3 times longer"
    option(group, "--refine-focal", text)
    text = "calibration: of COLMAP, OpenSfM, nerfstudio, OpenCV and others, or JSON as in docs/CAMERAS.md; "
    text += "of a model's cameras each photo takes its own; or a folder with NAME.camera.json for each photo"
    option(group, "--camera FILE", text)
    text = "calibration of a rig: COLMAP's rig_config.json, or JSON of docs/CAMERAS.md; a query is a folder"
    option(group, "--rig FILE", text)
    text = "down in camera axes (+x image centre, +y left, +z up), of any length; 0 0 -1: upright camera"
    option(group, "--gravity-vector X Y Z", text)
    text = "mask whose white pixels are ignored; or a folder of masks, named like the photos"
    option(group, "--mask FILE", text)
    text = "ignore a cap of this half angle around straight down, with the tripod or the car"
    option(group, "--mask-nadir DEG", text, default=0.0, dest="mask_nadir_deg")
    text = "coordinate system of the cloud, such as EPSG:25832; photos with GPS are searched near there first"
    default = f"(default: the one in LAS, LAZ or E57 files); {NONE}: ignore GPS"
    option(group, "--crs CRS", f"{text} {default}")


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """Add the preset and its settings."""
    group = parser.add_argument_group("method")
    text = "default: search of all positions on prepared views; paper: Kim et al., ICCV 2021, Algorithm 1; "
    text += "then settings as NAME=VALUE, such as solver=lbfgs (docs/API.md)"
    group.add_argument("--preset", nargs="+", default=["default"], metavar="NAME", help=text)
    text = "known: the camera was upright and z of the cloud is up; unknown: any rotation; auto: try both "
    text += "(default auto)"
    group.add_argument("--gravity", choices=["auto", "known", "unknown"], help=text)
    text = "how exact a pose must be, in position and rotation: confidence is the probability that it is "
    group.add_argument(
        "--accuracy", nargs="+", type=float, metavar=("METRES", "DEGREES"), help=f"{text}(default 0.1 5)"
    )
    text = f"confidence from which a pose is localized (default {MIN_CONFIDENCE})"
    option(group, "--min-confidence X", text)


def add_prior_options(parser: argparse.ArgumentParser) -> None:
    """Add what the user knows beforehand."""
    title = "prior knowledge (preset default only); a pose that contradicts it is not localized"
    group = parser.add_argument_group(title)
    text = "CSV file of priors per photo: name and any of x, y, z, radius, heading, tolerance, height, "
    text += (
        "within, gravity_x, gravity_y, gravity_z, or NavVis' pano-poses.csv; they take precedence over the "
    )
    text += "options for all photos"
    option(group, "--priors FILE", text)
    option(group, "--near X Y Z RADIUS", "the camera was within RADIUS of this position [m]")
    option(group, "--height MIN MAX", "height of the camera above the floor [m]")
    text = "heading of the image centre, clockwise from the cloud's +y; within 20 degrees"
    option(group, "--heading DEG", text)
    text = "the camera was in one of these scans of a map made with tools/prepare_map.py --add"
    option(group, "--within NAME ...", text)


def add_walk_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of walks, and of photos that belong together in another way."""
    group = parser.add_argument_group("photos together")
    text = "relative poses of the photos, which are then localized together: COLMAP's images.txt or .bin, "
    text += (
        "hloc's, Metashape's cameras.xml, JSON of OpenSfM, OpenMVG or Meshroom (of any scale), or in metres "
    )
    text += (
        "a transforms.json (nerfstudio, phone apps), TUM trajectory or table with the photos' names as times"
    )
    option(group, "--relative FILE", text)
    text = "the photos were taken at one place or on a short way, such as by a phone that is turned around: "
    option(group, "--together", text + "those that show the same are localized together, in any order")
    text = "the photos are frames of one walk, in this order, and constrain each other"
    option(group, "--walk", text)
    text = "video of a walk, or with --together of one place, or its chapters in order, instead of --pano"
    option(group, "--video FILE ...", text)
    text = "seconds from one frame of a video to the next, the sharpest around each time "
    option(group, "--every S", f"{text}(default {DEFAULT_EVERY})")
    text = f"times of the frames: {EXIF}, {NAMES} (the last number in each name [s]), {ORDER}, or CSV file "
    text += f"with the columns name and time [s] (default {EXIF} if its times differ, else {ORDER})"
    option(group, "--times SOURCE", text)
    text = f"maximum speed of the camera [m/s] (default {MAX_SPEED:g}); if only the order is known, "
    option(group, "--max-speed X", text + f"maximum distance between frames [m] (default {MAX_STEP:g})")
    text = "odometry of the camera [m], by which a walk tells identical places apart: TUM or KITTI "
    option(group, "--odometry FILE", text + "trajectory, or transforms.json (ARKit)")


def add_execution_options(parser: argparse.ArgumentParser, default_jobs: int | None = None) -> None:
    """Add the options of processes, threads and memory; by default as many processes as are worth it."""
    group = parser.add_argument_group("execution")
    text = ""
    if default_jobs is None:
        text = f" (default one per core, if memory suffices and each gets {PHOTOS_OF_A_JOB} photos or more; "
        text += "1 with paths on stdin or --threads)"
    option(group, "--jobs N", f"processes that use one prepared map{text}", default=default_jobs)
    text = "run on a Dask cluster: address or file of its scheduler"
    option(group, "--dask ADDRESS", text)
    option(group, "--threads N", "threads of each process (default: the cores divided by --jobs)")
    text = "memory limit of all processes, or of each --dask worker (default 80 %% of the free memory)"
    option(group, "--max-memory GB", text)


def check_arguments(arguments: Arguments) -> None:
    """Refuse values that are wrong whatever the files hold."""
    arguments.check_least(threads=1, jobs=1, every=MIN_EVERY)
    if arguments.overwrite and not arguments.out:
        raise InputError("--overwrite: only with --out")
