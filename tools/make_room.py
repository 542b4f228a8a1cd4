#!/usr/bin/env python3
"""Make a seeded furnished room: a coloured scan of it, and panoramas with true poses."""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from exit_codes import guarded
from piccolo import scenes
from piccolo.cloud.ply_writing import vertex_rows, write_ply
from piccolo.errors import InputError
from piccolo.files import write_atomically
from piccolo.synthetic.world import (
    VARIANTS,
    Query,
    World,
    check_num_points,
    check_width,
    make_query,
    make_world,
    scan_world,
)
from piccolo.threads import Workers, num_cores

EPILOG = """\
examples:
  python tools/make_room.py --out room --seed 3
  python tools/make_room.py --out flats --rooms 16 --points 2000000 --panoramas 4 --variants clean photo

Writes FOLDER/cloud.ply, FOLDER/images/VARIANT_K.jpg and FOLDER/queries.json with the true poses.
clean: as scanned; tilt: the camera turned anyhow; photo: other exposure, white balance, gamma, blur, noise;
change: furniture moved and added. One JSON object on stdout says what was written.
exit codes: 0 done, 2 wrong usage, 3 bad input, 4 internal error, 130 interrupted.
"""


def build_parser() -> argparse.ArgumentParser:
    """All options."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="made if it is not there")
    parser.add_argument("--seed", type=int, default=0, help="equal seeds, equal bits (default 0)")
    parser.add_argument("--points", type=int, default=300_000, help="(default 300000)")
    parser.add_argument("--panoramas", type=int, default=3, help="of each variant (default 3)")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["clean"], help="(default clean)")
    parser.add_argument("--width", type=int, default=2048, help="of the panoramas [px] (default 2048)")
    parser.add_argument("--size", type=float, nargs=3, default=[6.0, 5.0, 2.7], metavar=("X", "Y", "Z"),
                        help="of a room [m] (default 6 5 2.7)")  # fmt: skip
    parser.add_argument("--rooms", type=int, default=1, help="side by side, at most 64 (default 1)")
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def write_query(folder: Path, name: str, query: Query) -> scenes.Query:
    """Write the image of a query and return what queries.json has of it."""
    image = folder / "images" / f"{name}.jpg"
    bgr = cv2.cvtColor(query.rgb, cv2.COLOR_RGB2BGR)
    quality = 70 if query.variant == "photo" else 95
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    write_atomically(image, bytes(encoded))
    return scenes.Query(image, query.variant, query.pose)


def write_world(arguments: argparse.Namespace, world: World, workers: Workers) -> dict[str, object]:
    """Write everything and return what was written."""
    folder: Path = arguments.out
    check_num_points(world, arguments.points)
    check_width(arguments.width)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    points, colors = scan_world(world, arguments.points, workers)
    write_ply(folder / scenes.CLOUD_NAME, vertex_rows(points, colors))
    queries = [
        write_query(folder, f"{v}_{k}", make_query(world, k, v, arguments.width, workers))
        for v in dict.fromkeys(arguments.variants)
        for k in range(arguments.panoramas)
    ]
    scenes.write_queries(folder, queries)
    return {"folder": str(folder), "points": len(points), "queries": len(queries), "seed": arguments.seed}


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = build_parser().parse_args(argv)

    def show(values: Iterator[Any], total: int | None, label: str) -> Iterator[Any]:
        return iter(tqdm(values, label, total, leave=False, disable=arguments.quiet, file=sys.stderr))

    def run() -> int:
        if arguments.panoramas < 0 or arguments.seed < 0:
            raise InputError("--panoramas, --seed: found a negative number, wanted 0 or more")
        world = make_world(arguments.seed, np.array(arguments.size), arguments.rooms)
        print(json.dumps(write_world(arguments, world, Workers(num_cores(), show))))
        return 0

    return guarded("make_room.py", arguments.debug, run)


if __name__ == "__main__":
    sys.exit(main())
