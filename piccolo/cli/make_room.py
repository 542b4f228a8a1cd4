"""Make a seeded furnished room: a coloured scan of it, and panoramas with true poses."""

import argparse
import itertools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..camera import Calibration
from ..camera.files import read_cameras
from ..cloud.ply_writer import vertex_rows, write_ply
from ..files.atomic import write_atomically
from ..jobs.threads import Workers, num_cores
from ..optional import import_optional
from ..scenes import scene as scenes
from ..scenes.datasets.files import write_labels
from ..scenes.synthetic.office import Office
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
from ..views.pictures import encode_image
from .command import check_least, command, option
from .errors import checking_options
from .making_walks import add_walk_options, building_of, check_walk_usage, write_walks
from .outputs import check_folder_name
from .progress import progress_bar

QUALITY = {"photo": 70}  # of a variant's JPEGs
ROOM_POINTS = 300_000  # of all rooms side by side
PART_POINTS = (
    120_000  # of each part of a building; with 30,000 the better scanned of exact twins was called sure
)
EPILOG = """\
examples:
  python tools/make_room.py --out room --seed 3
  python tools/make_room.py --out photos --camera cameras.txt
  python tools/make_room.py --out flats --rooms 16 --points 2000000 --panoramas 4 --variants clean photo
  python tools/make_room.py --out walk --rooms 64 --storeys 2 --twins 0.3 --walk 300 --people 3 --blur

Writes FOLDER/cloud.ply, FOLDER/images/VARIANT_K.jpg and FOLDER/queries.json with the true poses.
clean: as scanned; tilt: the camera in any orientation; photo: other exposure, white balance, gamma, blur
and noise; change: furniture moved and added. With --labels the points have a label too, and each panorama
a picture of labels, FOLDER/labels/VARIANT_K.png. With --camera queries.json has the camera of each picture,
which evaluate.py takes; the pictures of a rig are a folder. One JSON object a scene on stdout.
With --storeys the rooms stand along corridors of equal doors between halls with stairs. With --walk a person
carries the camera through it: FOLDER/images/VARIANT_walk_K_FRAME.jpg with walk and time in queries.json, and
FOLDER/VARIANT_walk_K_poses.tum (optical axes). Frames of --bad-frames are black, mirrored or of elsewhere,
each a variant, with "answerable": false: right is to refuse them.
"""


class Made(NamedTuple):
    """What a scene is made of."""

    world: World
    office: Office | None  # that the world is of
    num_points: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--out FOLDER", "made if it is not there", required=True)
    option(parser, "--seed N", "equal seeds, equal bits", default=0)
    text = f"(default {ROOM_POINTS}, in a building {PART_POINTS} a room and stretch of corridor)"
    option(parser, "--points N", text)
    option(parser, "--panoramas N", "of each variant", default=3)
    option(parser, "--variants", nargs="+", choices=VARIANTS, default=["clean"])
    option(parser, "--width PX", "of the panoramas", default=2048)
    text = "calibration or rig (docs/CAMERAS.md) that takes the pictures, in place of spheres"
    option(parser, "--camera FILE", text)
    option(parser, "--size X Y Z", "of a room [m]", default=[6.0, 5.0, 2.7])
    option(parser, "--rooms N", "at most 256", default=1)
    option(parser, "--labels", "label points and pixels by their kind of surface, for localize.py --labels")
    option(parser, "--scenes N", "write N scenes, FOLDER/000 on, of the seeds from --seed on", default=0)
    add_walk_options(parser)


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


def write_queries(
    arguments: argparse.Namespace, world: World, folder: Path, cameras: Calibration | None, workers: Workers
) -> list[scenes.Query]:
    """Write single photos, of each variant as many."""
    numbers = list(itertools.product(dict.fromkeys(arguments.variants), range(arguments.panoramas)))
    if cameras is None:
        return [write_panorama(arguments, world, folder, number, workers) for number in numbers]
    return [write_photo(cameras, world, folder, number, workers) for number in numbers]


def write_world(
    arguments: argparse.Namespace, made: Made, folder: Path, cameras: Calibration | None, workers: Workers
) -> dict[str, object]:
    """Write one scene and return what was written."""
    world, office = made.world, made.office
    (folder / "images").mkdir(parents=True, exist_ok=True)
    points, colors, labels = scan_world(world, made.num_points, workers)
    rows = vertex_rows(points, colors, labels.astype(np.int32) if arguments.labels else None)
    write_ply(folder / scenes.CLOUD_NAME, rows)
    if office is not None and arguments.walk:
        queries = write_walks(arguments, office, folder, workers)
    else:
        queries = write_queries(arguments, world, folder, cameras, workers)
    corners = [room.corner.tolist() for room in world.rooms[: office.num_rooms]] if office else []
    source = {"source": {"corners": corners, "copies": office.copies.tolist()}} if office else {}
    scenes.write_queries(folder, queries, **source)
    return {"folder": str(folder), "points": len(points), "queries": len(queries), "seed": world.seed}


def made_of(arguments: argparse.Namespace, seed: int) -> Made:
    """The rooms of a seed, and what was asked for of them; a UsageError if that makes no sense."""
    with checking_options():
        check_width(arguments.width)
        office = building_of(arguments, seed)
        world = office.world if office else make_world(seed, np.array(arguments.size), arguments.rooms)
        num_points = PART_POINTS * len(world.rooms) if office else ROOM_POINTS
        num_points = num_points if arguments.points is None else arguments.points
        check_num_points(world, num_points)
    return Made(world, office, num_points)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Make and write all scenes."""
    check_least(arguments, panoramas=0, seed=0, scenes=0, storeys=0, walks=1)
    check_folder_name("--out", arguments.out)
    cameras = read_cameras(arguments.camera) if arguments.camera else None
    if cameras is not None:
        with checking_options():
            check_can_be_made(cameras, arguments.labels)
    with checking_options():
        check_walk_usage(arguments)
    if arguments.video:
        import_optional("--video", "av", "video")
    workers = Workers(num_cores(), progress_bar(arguments.quiet))
    for number in range(max(1, arguments.scenes)):
        made = made_of(arguments, arguments.seed + number)
        folder = arguments.out / f"{number:03}" if arguments.scenes else arguments.out
        print(json.dumps(write_world(arguments, made, folder, cameras, workers)), flush=True)
    return 0
