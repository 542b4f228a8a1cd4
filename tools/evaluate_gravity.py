#!/usr/bin/env python3
"""Try the search for up: clouds turned at random, how far the answers are off, and how sure they were."""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray

from piccolo.cli.errors import UsageError, checking_options, run_command
from piccolo.cli.parser import add_run_options, new_parser
from piccolo.cli.progress import progress_bar
from piccolo.cloud import open_cloud, stream_of
from piccolo.cloud.octree import build_octree
from piccolo.cloud.readers.reader import RawCloud
from piccolo.confidence.confidence import check_confidence
from piccolo.geometry.pose import Array, rotation_from_quaternion_wxyz
from piccolo.gravity import MIN_CONFIDENCE
from piccolo.gravity.alignment import find_alignment
from piccolo.runtime.threads import Workers, num_cores
from piccolo.scenes.synthetic.buildings import BUILDINGS, make_building

RIGHT, ROUGH = 0.5, 5.0  # [deg]
THINNED = 0.04  # spacing of a scene's points, from which the search thins further [m]
EPILOG = """\
examples:
  python tools/evaluate_gravity.py --seeds 0 10 --kinds room --turns 50
  python tools/evaluate_gravity.py --seeds 0 20 --turns 2
  python tools/evaluate_gravity.py --scenes BENCH/house BENCH/hospital --turns 250

Each cloud is turned by --turns seeded rotations, uniform over all, and goes the way of align_gravity.py.
Seeds make places of each kind; scenes are folders with a cloud.ply whose z is up, thinned to 4 cm once, but
for the first --full turns. A Markdown table on stdout: right is within 0.5 degrees, rough within 5; accepted
is a confidence of --min-confidence or more.
"""


@dataclass(frozen=True)
class Answer:
    """How one trial ended."""

    error_deg: float  # between the up found and the true one
    confidence: float


@dataclass(frozen=True)
class Case:
    """A cloud with z up, to be turned."""

    name: str
    points: NDArray[np.floating[Any]]  # (N, 3) [m]
    rotations: list[Array]  # (3, 3) each


def rotations_of(seed: int, count: int) -> list[Array]:
    """Rotations (3, 3) uniform over SO(3)."""
    rng = np.random.default_rng([seed, 70])
    return [rotation_from_quaternion_wxyz(rng.normal(size=4)) for _ in range(count)]


def cases_of(arguments: argparse.Namespace) -> Iterator[Case]:
    """Every cloud with its turns."""
    for kind in arguments.kinds:
        for seed in range(*arguments.seeds):
            yield Case(kind, make_building(kind, seed)[0], rotations_of(seed, arguments.turns))
    for number, folder in enumerate(arguments.scenes):
        rotations = rotations_of(number, arguments.turns)
        cloud = open_cloud([folder / "cloud.ply"])
        full = np.concatenate([points for points, _ in cloud.chunks([])])
        yield Case(f"{folder.name}, whole", full, rotations[: arguments.full])
        thinned = build_octree(cloud.voxels(np.eye(3))).level(THINNED)[:, :3]
        yield Case(folder.name, thinned, rotations[arguments.full :])


def try_turn(points: NDArray[np.floating[Any]], R: Array) -> Answer:
    """Turn the cloud by R (3, 3) and look for up."""
    turned = np.einsum("ij,nj->ni", R, points.astype(np.float64))
    cloud = stream_of(Path("trial"), RawCloud(turned, np.full(turned.shape, 128, np.uint8)))
    finding, _ = find_alignment(cloud, "auto", along_walls=False)
    up, true_up = finding.up_scan, R[:, 2]
    sine = float(np.linalg.norm(np.cross(up, true_up)))
    return Answer(float(np.degrees(np.arctan2(sine, up @ true_up))), finding.alignment.confidence)


def answers_of(arguments: argparse.Namespace) -> dict[str, list[Answer]]:
    """All answers, case by case."""
    workers = Workers(arguments.threads, progress_bar(arguments.quiet))
    answers: dict[str, list[Answer]] = {}
    for case in cases_of(arguments):
        found = workers.each(partial(try_turn, case.points), case.rotations, case.name)
        answers.setdefault(case.name, []).extend(found)
    return answers


def print_table(answers: dict[str, list[Answer]], min_confidence: float) -> int:
    """One line a case; returns how many wrong answers were accepted."""
    print("| case | trials | right | rough | wrong | accepted | of these wrong | surest wrong |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    total = 0
    for name, rows in answers.items():
        errors = np.array([row.error_deg for row in rows])
        confidences = np.array([row.confidence for row in rows])
        is_wrong, is_accepted = errors > ROUGH, confidences >= min_confidence
        false = int(np.count_nonzero(is_wrong & is_accepted))
        cells = [
            len(rows),
            np.count_nonzero(errors <= RIGHT),
            np.count_nonzero((errors > RIGHT) & ~is_wrong),
            np.count_nonzero(is_wrong),
            np.count_nonzero(is_accepted),
            false,
            f"{confidences[is_wrong].max():.2f}" if is_wrong.any() else "",
        ]
        print(f"| {name} | {' | '.join(map(str, cells))} |")
        total += false
    return total


def run(arguments: argparse.Namespace) -> int:
    """Try all clouds, print the table."""
    with checking_options():
        check_confidence(arguments.min_confidence)
    if min(arguments.seeds) < 0 or min(arguments.turns, arguments.threads) < 1 or arguments.full < 0:
        raise UsageError("--seeds, --turns, --full, --threads: found a negative number or no turn or thread")
    return int(print_table(answers_of(arguments), arguments.min_confidence) > 0)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = new_parser("evaluate_gravity", __doc__, EPILOG, "0 no wrong answer was accepted, 1 some were")
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[0, 0])
    parser.add_argument(
        "--kinds", nargs="+", choices=BUILDINGS, default=list(BUILDINGS), help="(default all)"
    )
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], metavar="FOLDER")
    parser.add_argument("--turns", type=int, default=5, metavar="N", help="of each cloud (default 5)")
    parser.add_argument("--full", type=int, default=3, metavar="N", help="turns of whole scenes (default 3)")
    parser.add_argument("--min-confidence", type=float, default=MIN_CONFIDENCE, metavar="X")
    parser.add_argument("--threads", type=int, default=num_cores(), metavar="N")
    add_run_options(parser)
    return run_command(parser, argv, run)


if __name__ == "__main__":
    raise SystemExit(main())
