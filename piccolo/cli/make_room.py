"""Make a seeded furnished room: a coloured scan of it, and panoramas with true poses."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ..cloud.ply_writer import vertex_rows, write_ply
from ..runtime.atomic import write_atomically
from ..runtime.threads import Workers, num_cores
from ..scenes import scene as scenes
from ..scenes.datasets.labels import write_labels
from ..scenes.synthetic.world import (
    VARIANTS,
    Query,
    World,
    check_num_points,
    check_width,
    make_labels,
    make_query,
    make_world,
    scan_world,
)
from .errors import UsageError, checking_options, run_command
from .parser import add_run_options, new_parser
from .progress import progress_bar

EPILOG = """\
examples:
  python tools/make_room.py --out room --seed 3
  python tools/make_room.py --out rooms --scenes 25 --panoramas 2 --labels
  python tools/make_room.py --out flats --rooms 16 --points 2000000 --panoramas 4 --variants clean photo

Writes FOLDER/cloud.ply, FOLDER/images/VARIANT_K.jpg and FOLDER/queries.json with the true poses.
clean: as scanned; tilt: the camera in any orientation; photo: other exposure, white balance, gamma, blur
and noise; change: furniture moved and added. With --labels the points have a label too, and each panorama
a picture of labels, FOLDER/labels/VARIANT_K.png. One JSON object a scene on stdout.
"""


def build_parser() -> argparse.ArgumentParser:
    """All options."""
    parser = new_parser("make_room", __doc__, EPILOG)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="made if it is not there")
    parser.add_argument("--seed", type=int, default=0, help="equal seeds, equal bits (default 0)")
    parser.add_argument("--points", type=int, default=300_000, help="(default 300000)")
    parser.add_argument("--panoramas", type=int, default=3, help="of each variant (default 3)")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["clean"], help="(default clean)")
    parser.add_argument("--width", type=int, default=2048, help="of the panoramas [px] (default 2048)")
    parser.add_argument("--size", type=float, nargs=3, default=[6.0, 5.0, 2.7], metavar=("X", "Y", "Z"),
                        help="of a room [m] (default 6 5 2.7)")  # fmt: skip
    parser.add_argument("--rooms", type=int, default=1, help="side by side, at most 64 (default 1)")
    text = "label each point and pixel by its kind of surface, for localize.py --labels"
    parser.add_argument("--labels", action="store_true", help=text)
    text = "a number of scenes, FOLDER/000 on, of the seeds from --seed on (default: one, in FOLDER itself)"
    parser.add_argument("--scenes", type=int, default=0, metavar="N", help=text)
    add_run_options(parser)
    return parser


def write_query(folder: Path, name: str, query: Query) -> scenes.Query:
    """Write the image of a query and return what queries.json has of it."""
    image = folder / "images" / f"{name}.jpg"
    bgr = cv2.cvtColor(query.rgb, cv2.COLOR_RGB2BGR)
    quality = 70 if query.variant == "photo" else 95
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    write_atomically(image, bytes(encoded))
    return scenes.Query(image, query.variant, query.pose)


def write_world(
    arguments: argparse.Namespace, world: World, folder: Path, workers: Workers
) -> dict[str, object]:
    """Write one scene and return what was written."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    points, colors, labels = scan_world(world, arguments.points, workers)
    rows = vertex_rows(points, colors, labels.astype(np.int32) if arguments.labels else None)
    write_ply(folder / scenes.CLOUD_NAME, rows)
    queries = []
    for v in dict.fromkeys(arguments.variants):
        for k in range(arguments.panoramas):
            query = make_query(world, k, v, arguments.width, workers)
            written = write_query(folder, f"{v}_{k}", query)
            if arguments.labels:
                path = folder / "labels" / f"{v}_{k}.png"
                path.parent.mkdir(exist_ok=True)
                write_labels(path, make_labels(world, k, query, workers))
                written = replace(written, labels=path)
            queries.append(written)
    scenes.write_queries(folder, queries)
    return {"folder": str(folder), "points": len(points), "queries": len(queries), "seed": world.seed}


def run(arguments: argparse.Namespace) -> int:
    """Make and write all scenes."""
    if min(arguments.panoramas, arguments.seed, arguments.scenes) < 0:
        raise UsageError("--panoramas, --seed, --scenes: found a negative number, wanted 0 or more")
    workers = Workers(num_cores(), progress_bar(arguments.quiet))
    for number in range(max(1, arguments.scenes)):
        with checking_options():
            check_width(arguments.width)
            world = make_world(arguments.seed + number, np.array(arguments.size), arguments.rooms)
            check_num_points(world, arguments.points)
        folder = arguments.out / f"{number:03}" if arguments.scenes else arguments.out
        print(json.dumps(write_world(arguments, world, folder, workers)), flush=True)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
