"""Make a seeded furnished room: a coloured scan of it, and panoramas with true poses."""

import argparse
import itertools
import json
from pathlib import Path

import numpy as np

from ..camera import Calibration
from ..camera.files import read_cameras
from ..cloud.ply_writer import vertex_rows, write_ply
from ..render.surfel_renderer import encode_image
from ..runtime.atomic import write_atomically
from ..runtime.threads import Workers, num_cores
from ..scenes import scene as scenes
from ..scenes.datasets.files import write_labels
from ..scenes.synthetic.photographs import check_can_be_made, make_photos
from ..scenes.synthetic.world import (
    VARIANTS,
    World,
    check_num_points,
    check_width,
    make_labels,
    make_query,
    make_world,
    scan_world,
)
from .command import check_least, command, option
from .errors import checking_options
from .outputs import check_folder_name
from .progress import progress_bar

QUALITY = {"photo": 70}  # of a variant's JPEGs
EPILOG = """\
examples:
  python tools/make_room.py --out room --seed 3
  python tools/make_room.py --out photos --camera cameras.txt
  python tools/make_room.py --out flats --rooms 16 --points 2000000 --panoramas 4 --variants clean photo

Writes FOLDER/cloud.ply, FOLDER/images/VARIANT_K.jpg and FOLDER/queries.json with the true poses.
clean: as scanned; tilt: the camera in any orientation; photo: other exposure, white balance, gamma, blur
and noise; change: furniture moved and added. With --labels the points have a label too, and each panorama
a picture of labels, FOLDER/labels/VARIANT_K.png. With --camera queries.json has the camera of each picture,
which evaluate.py takes; the pictures of a rig are a folder. One JSON object a scene on stdout.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--out FOLDER", "made if it is not there", required=True)
    option(parser, "--seed N", "equal seeds, equal bits", default=0)
    option(parser, "--points N", default=300_000)
    option(parser, "--panoramas N", "of each variant", default=3)
    option(parser, "--variants", nargs="+", choices=VARIANTS, default=["clean"])
    option(parser, "--width PX", "of the panoramas", default=2048)
    text = "calibration or rig (docs/CAMERAS.md) that takes the pictures, in place of spheres"
    option(parser, "--camera FILE", text)
    option(parser, "--size X Y Z", "of a room [m]", default=[6.0, 5.0, 2.7])
    option(parser, "--rooms N", "side by side, at most 256", default=1)
    option(parser, "--labels", "label points and pixels by their kind of surface, for localize.py --labels")
    option(parser, "--scenes N", "write N scenes, FOLDER/000 on, of the seeds from --seed on", default=0)


def write_panorama(
    arguments: argparse.Namespace, world: World, folder: Path, number: tuple[str, int], workers: Workers
) -> scenes.Query:
    """Write a sphere, variant and index its `number`, with its labels if asked for."""
    v, k = number
    query = make_query(world, k, v, arguments.width, workers)
    image, path = folder / "images" / f"{v}_{k}.jpg", folder / "labels" / f"{v}_{k}.png"
    write_atomically(image, encode_image(query.rgb, ".jpg", QUALITY.get(v, 95)))
    if arguments.labels:
        path.parent.mkdir(exist_ok=True)
        write_labels(path, make_labels(world, k, query, workers))
    return scenes.Query(image, v, query.pose, path if arguments.labels else None)


def write_photo(
    cameras: Calibration, world: World, folder: Path, number: tuple[str, int], workers: Workers
) -> scenes.Query:
    """Write what a camera takes, or of a rig the pictures of one instant, as a folder."""
    v, k = number
    pictures, pose = make_photos(world, number, cameras, workers)
    image = folder / "images" / (f"{v}_{k}" if cameras.is_rig else f"{v}_{k}.jpg")
    for name, rgb in pictures:
        path = image / name if name else image
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, encode_image(rgb, path.suffix, QUALITY.get(v, 95)))
    return scenes.Query(image, v, pose, cameras=cameras.mounts)


def write_world(
    arguments: argparse.Namespace,
    world: World,
    folder: Path,
    cameras: Calibration | None,
    workers: Workers,
) -> dict[str, object]:
    """Write one scene and return what was written."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    points, colors, labels = scan_world(world, arguments.points, workers)
    rows = vertex_rows(points, colors, labels.astype(np.int32) if arguments.labels else None)
    write_ply(folder / scenes.CLOUD_NAME, rows)
    numbers = list(itertools.product(dict.fromkeys(arguments.variants), range(arguments.panoramas)))
    if cameras is None:
        queries = [write_panorama(arguments, world, folder, number, workers) for number in numbers]
    else:
        queries = [write_photo(cameras, world, folder, number, workers) for number in numbers]
    scenes.write_queries(folder, queries)
    return {"folder": str(folder), "points": len(points), "queries": len(queries), "seed": world.seed}


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Make and write all scenes."""
    check_least(arguments, panoramas=0, seed=0, scenes=0)
    check_folder_name("--out", arguments.out)
    cameras = read_cameras(arguments.camera) if arguments.camera else None
    if cameras is not None:
        with checking_options():
            check_can_be_made(cameras, arguments.labels)
    workers = Workers(num_cores(), progress_bar(arguments.quiet))
    for number in range(max(1, arguments.scenes)):
        with checking_options():
            check_width(arguments.width)
            world = make_world(arguments.seed + number, np.array(arguments.size), arguments.rooms)
            check_num_points(world, arguments.points)
        folder = arguments.out / f"{number:03}" if arguments.scenes else arguments.out
        print(json.dumps(write_world(arguments, world, folder, cameras, workers)), flush=True)
    return 0
